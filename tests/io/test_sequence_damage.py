"""Broken, truncated and malicious sequence files: one sentence, quickly, in little memory."""

import time
import tracemalloc

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.sequence import read_sequence
from sonosweep.io.sequence_scan import read_plus, trajectory_from_sequence
from sonosweep.io.sequence_write import write_sequence
from sonosweep.scan import Calibration, Scan

from .damage import assert_one_sentence, assert_reads_or_explains, damaged
from .plus_files import shift, some_pixels, write_mha, write_nrrd

# A broken header of a few kB must not make us reserve more than its guard lets through:
# a million entries of 16 numbers of 8 bytes, a few times over.
LARGEST_MEMORY_BYTES = 1 << 30
LONGEST_S = 2.0  # of this thread, for a file of a few kB, with type checks switched on
ABSURD = ["0", "-1", "1", "7", "1000000000000", "99999999999999999999", "nan", "1e3", "", "x"]

FIELDS = [
    "NDims",
    "DimSize",
    "Kinds",
    "ElementType",
    "ElementNumberOfChannels",
    "CompressedData",
    "CompressedDataSize",
    "HeaderSize",
    "ElementSpacing",
    "UltrasoundImageOrientation",
    "UltrasoundImageType",
    "BinaryDataByteOrderMSB",
    "Seq_Frame0000_Timestamp",
    "Seq_Frame0002_ImageToReferenceTransform",
    "Seq_Frame99_Timestamp",
    "Seq_Frame999999999999_ProbeToTrackerTransform",
    "ImageToProbeTransform",
    "Seq_Frame0001_ImageToReferenceTransformStatus",
    "Seq_Frame0000_ImageStatus",
    "Sonosweep_spacing_mm",
    "Sonosweep_latency_s",
    "Sonosweep_region_px",
]


def small_file(folder, suffix, compress):
    """Write a small tracked sweep and return its bytes and path."""
    scan = Scan(
        "a",
        some_pixels(),
        Calibration((0.2, 0.1)),
        torch.arange(3, dtype=torch.float64),
        torch.eye(4, dtype=torch.float64).repeat(3, 1, 1),
    )
    path = folder / f"a{suffix}"
    write_sequence(scan, path, compress)
    return path.read_bytes(), path


@given(data=st.data())
@settings(max_examples=200)
@pytest.mark.parametrize("suffix", [".igs.mha", ".igs.mhd", ".igs.nrrd", ".seq.nrrd"])
def test_damaged_sequences_are_read_or_explained(tmp_path_factory, suffix, data):
    """Cut short, bytes flipped or never a sequence: a scan or one sentence comes out."""
    whole, path = small_file(tmp_path_factory.mktemp("damage"), suffix, data.draw(st.booleans()))
    path.write_bytes(data.draw(damaged(whole)))

    assert_reads_or_explains(lambda: read_plus(path))


@given(
    lines=st.lists(
        st.tuples(
            st.sampled_from(FIELDS),
            st.lists(st.sampled_from([*ABSURD, "domain", "list", "True"]), max_size=5)
            | st.just([shift(0)])
            | st.just(["nan"] * 16),
        ),
        min_size=1,
        max_size=4,
    ),
    compress=st.booleans(),
)
@settings(max_examples=300)
def test_absurd_headers_are_read_or_explained(tmp_path_factory, lines, compress):
    """Any value of any field, whole or in pieces, costs little time and memory."""
    path = tmp_path_factory.mktemp("header") / "a.mha"
    write_mha(
        path,
        some_pixels(),
        {"Seq_Frame0000_ImageToReferenceTransform": shift(1)}
        | {name: " ".join(words) for name, words in lines},
        compress=compress,
    )

    assert_cheap(lambda: assert_reads_or_explains(lambda: read_plus(path)))


@given(
    sizes=st.lists(st.sampled_from(ABSURD[:6]), min_size=2, max_size=4),
    kinds=st.lists(
        st.sampled_from(["domain", "list", "vector", "RGB-color", "???", "none"]), max_size=4
    ),
    encoding=st.sampled_from(["raw", "gz", "bz2", "ascii", ""]),
    skip=st.sampled_from(["0", "-1", "-2", "10"]),
)
@example(
    sizes=["5", "4", "1000000000000"], kinds=["domain"] * 2 + ["list"], encoding="gz", skip="0"
)
def test_absurd_nrrd_headers_are_read_or_explained(tmp_path_factory, sizes, kinds, encoding, skip):
    """Likewise for NRRD."""
    path = tmp_path_factory.mktemp("header") / "a.nrrd"
    fields = {
        "sizes": " ".join(sizes),
        "dimension": str(len(sizes)),
        "byte skip": skip,
        "encoding": encoding,
    }
    write_nrrd(path, some_pixels(), " ".join(kinds), {}, "gz", fields)

    assert_cheap(lambda: assert_reads_or_explains(lambda: read_plus(path)))


def assert_cheap(act) -> None:
    """Check the time and memory that something takes."""
    tracemalloc.start()
    start = time.thread_time()
    try:
        act()
        used = time.thread_time() - start
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert used < LONGEST_S
    assert peak < LARGEST_MEMORY_BYTES


@pytest.mark.parametrize(
    "size",
    ["1 1 99999999999", "99999999999 1 3", "5 4 1000000", "0 0 1000000000000", "0 0 4"],
)
def test_a_header_that_promises_too_much_is_refused_at_once(tmp_path, size):
    """Room is reserved for what is in the file, not for what it says."""
    path = write_mha(
        tmp_path / "a.mha",
        some_pixels(),
        {"DimSize": size, "Seq_Frame0000_ProbeToTrackerTransform": shift(1)},
        compress=True,
    )

    def refuse():
        with pytest.raises(FormatError):
            read_sequence(path)

    assert_cheap(refuse)


def test_a_million_frames_that_nobody_describes_are_refused(tmp_path):
    """One transform for a million one-pixel frames would be 128 MB of nothing."""
    fields = {f"Seq_Frame0000_Probe{k}ToTrackerTransform": shift(1) for k in range(30)}
    path = write_mha(tmp_path / "a.mha", some_pixels(1_000_000, 1, 1), fields)

    with pytest.raises(FormatError, match="describes far fewer"):
        read_sequence(path)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"Seq_Frame0003_Timestamp": "1"}, "describes frame 3 but states 3 frames"),
        ({"Seq_Frame0001_Timestamp": "noon"}, "Timestamp of frame 1 in .* is no number: 'noon'"),
        ({"Seq_Frame0001_AToBTransform": "1 2 3"}, "AToBTransform of frame 1 .* not 16 numbers"),
        ({"ImageToProbeTransform": "1 2 3"}, "ImageToProbeTransform in .* not 16 numbers"),
        ({"Kinds": "domain domain domain"}, "is a volume, not a sequence"),
        ({"Kinds": "domain list list"}, "no sequence of 2D frames"),
        ({"Kinds": "domain list"}, "expected one per dimension"),
        (
            {"NDims": "4", "DimSize": "5 2 2 3", "Kinds": "domain domain domain list"},
            "no sequence of 2D frames",
        ),
        ({"CompressedData": "True", "CompressedDataSize": "9999"}, "was cut off"),
        ({"CompressedData": "True"}, "damaged"),
        ({"DimSize": "5 4 0"}, "holds no frame"),
    ],
)
def test_what_is_wrong_is_said_with_its_value(tmp_path, fields, message):
    """One sentence each for what people meet."""
    path = write_mha(tmp_path / "a.mha", some_pixels(), fields)

    with pytest.raises(FormatError, match=message) as caught:
        read_plus(path).frames[0]
    assert_one_sentence(caught.value)


def test_a_cut_stream_is_told_when_its_frames_are_asked_for(tmp_path):
    """Opening inflates nothing, so a stream that ends early is found at the first frame."""
    path = write_mha(tmp_path / "a.mha", some_pixels(), compress=True)
    path.write_bytes(path.read_bytes()[:-20])
    frames = read_sequence(path).frames
    assert frames is not None

    with pytest.raises(FormatError, match="bytes short of the 5 x 4 x 3"):
        frames[0]


@pytest.mark.parametrize("suffix", [".png", ".mha.gz", ""])
def test_other_files_are_no_sequences(tmp_path, suffix):
    """The suffixes that are read are listed."""
    with pytest.raises(FormatError, match="must end with one of"):
        read_sequence(tmp_path / f"a{suffix}")


def test_damage_to_a_real_recording_is_explained(tmp_path, recordings):
    """A sweep of 3.7 MB with its header or its stream cut or overwritten."""
    whole = (recordings / "plus_bone_l14" / "BoneUltrasound_L14.igs.mha").read_bytes()
    header = whole.index(b"LOCAL")
    path = tmp_path / "a.igs.mha"
    generator = torch.Generator().manual_seed(0)

    def place(below: int) -> int:
        return int(torch.randint(below, (1,), generator=generator))

    explained = 0
    for k in range(24):
        broken = bytearray(whole)
        if k % 3 == 0:
            broken = broken[: place(len(whole))]
        else:
            reach = header if k % 3 == 1 else len(whole)
            for _ in range(5):
                broken[place(reach)] = place(256)
        path.write_bytes(broken)
        try:
            frames = read_plus(path).frames
            assert frames[0].shape == frames.shape[1:]
        except SonosweepError as error:
            assert_one_sentence(error)
            explained += 1

    # A cut or a changed stream never passes its checksum; a changed digit in a header may.
    assert explained >= 16


def test_damage_to_a_real_tracker_recording_is_explained(tmp_path, recordings):
    """4 MB of text without pixels, cut and overwritten."""
    folder = recordings / "plus_watertank_temporal"
    whole = (folder / "WaterTankBottomTranslationTrackerBuffer.igs.mha").read_bytes()
    path = tmp_path / "a.igs.mha"
    for cut in (0, 100, 5000, len(whole) // 2, whole.index(b"ElementDataFile")):
        path.write_bytes(whole[:cut])

        with pytest.raises(FormatError):
            trajectory_from_sequence(read_sequence(path), image="Probe")

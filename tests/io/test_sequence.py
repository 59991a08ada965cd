"""Sequence files as PLUS, IGSIO, 3D Slicer and Ibis write them."""

import pickle
import time
import zlib

import numpy as np
import pytest
import torch

from sonosweep.errors import FormatError, ScanError
from sonosweep.io import pixel_data
from sonosweep.io.sequence import read_sequence

from .damage import LARGEST_RESIDENT_MB, resident_mb_after
from .plus_files import IDENTITY, shift, some_pixels, write_mha, write_nrrd


def test_the_real_bone_sweep_is_all_there(recordings):
    """21 frames of 616 x 820, three tools seen in each, as its README says."""
    sequence = read_sequence(recordings / "plus_bone_l14" / "BoneUltrasound_L14.igs.mha")

    assert sequence.frames is not None
    assert sequence.timestamps_s is not None
    assert sequence.frames.shape == (21, 616, 820)
    assert sequence.name == "BoneUltrasound_L14"
    assert {b for _, b in sequence.transforms} == {"Tracker"}
    assert all(bool(t.valid.all()) for t in sequence.transforms.values())
    matrix = sequence.transforms[("Probe", "Tracker")].matrices[0]
    assert matrix[0].tolist() == [0.853646, -0.501315, 0.141319, 257.956]
    assert float(sequence.timestamps_s[0]) == 232.542071
    # The ultrasound is in columns 176 to 642; outside there is next to nothing.
    image = sequence.frames[20]
    assert image[:, 176:642].mean() > 20 * image[:, 660:].mean()
    assert sequence.spacing_mm is None


def test_the_real_tracker_recording_has_poses_and_no_images(recordings):
    """5000 samples whose DimSize is 0 0 5000."""
    folder = recordings / "plus_watertank_temporal"
    sequence = read_sequence(folder / "WaterTankBottomTranslationTrackerBuffer.igs.mha")

    assert sequence.frames is None
    assert sequence.count == 5000
    assert sequence.image_valid is not None
    assert not bool(sequence.image_valid.any())
    assert sequence.frame_fields["FrameNumber"][4999] != ""
    assert sequence.timestamps_s is not None
    assert bool((sequence.timestamps_s.diff() > 0).all())


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", ["uint8", "int16"])
def test_pixels_come_back_frame_by_frame(tmp_path, compress, channels, dtype):
    """Gray or colour, packed or not, an index gives a frame and a slice a stack."""
    pixels = some_pixels(channels=channels).astype(dtype)
    path = write_mha(tmp_path / "a.igs.mha", pixels, compress=compress)

    frames = read_sequence(path).frames

    assert frames is not None
    assert frames.shape == pixels.shape
    assert frames.dtype == pixels.dtype
    np.testing.assert_array_equal(frames[1], pixels[1])
    np.testing.assert_array_equal(frames[-1], pixels[-1])
    np.testing.assert_array_equal(frames[::-2], pixels[::-2])


def test_big_endian_pixels_are_turned(tmp_path):
    """The most significant byte may come first."""
    pixels = some_pixels().astype("int16")
    path = write_mha(tmp_path / "a.mha", pixels, {"BinaryDataByteOrderMSB": "True"})
    path.write_bytes(path.read_bytes()[: -pixels.nbytes] + pixels.astype(">i2").tobytes())

    frames = read_sequence(path).frames

    assert frames is not None
    np.testing.assert_array_equal(frames[:], pixels)
    assert frames.dtype.isnative


def test_a_frame_may_be_kept_and_changed(tmp_path):
    """What an index gives is the caller's own."""
    frames = read_sequence(write_mha(tmp_path / "a.mha", some_pixels())).frames
    assert frames is not None

    frames[0][:] = 0

    np.testing.assert_array_equal(frames[0], some_pixels()[0])


@pytest.mark.parametrize(
    ("fields", "without"),
    [
        ({}, ("Kinds",)),
        ({"Kinds": "domain domain time"}, ()),
        ({}, ("UltrasoundImageType",)),
        ({"UltrasoundImageType": "BRIGHTNESSBRIGHTNESS"}, ()),
        ({"UltrasoundImageOrientation": "MFA"}, ()),
        ({"NDims": "4", "DimSize": "5 4 1 3", "Kinds": "domain domain domain list"}, ()),
        ({}, ("ElementNumberOfChannels", "ElementSpacing")),
        ({"TimestampBaseline": "12", "CalibrationTransform": IDENTITY}, ()),
    ],
    ids=["no kinds", "time", "no type", "type twice", "MFA", "one slice", "bare", "ibis"],
)
def test_every_dialect_gives_the_same_frames(tmp_path, fields, without):
    """Versions of PLUS and Slicer differ in what they write, not in what they mean."""
    path = write_mha(tmp_path / "a.mha", some_pixels(), fields, without)

    sequence = read_sequence(path)

    assert sequence.frames is not None
    assert sequence.frames.shape == (3, 4, 5)
    assert sequence.image_type == "BRIGHTNESS"
    np.testing.assert_array_equal(sequence.frames[2], some_pixels()[2])


def test_an_unmarked_first_image_is_mirrored_back(tmp_path):
    """A UF file is a mirror image, whether it says so or is said to be."""
    stated = write_mha(tmp_path / "a.mha", some_pixels(), {"UltrasoundImageOrientation": "UF"})
    unstated = write_mha(tmp_path / "b.mha", some_pixels(), {"UltrasoundImageOrientation": "??"})

    mirrored, told = read_sequence(stated).frames, read_sequence(unstated, "uf").frames
    untold = read_sequence(unstated).frames

    assert mirrored is not None
    assert told is not None
    assert untold is not None
    np.testing.assert_array_equal(mirrored[0], some_pixels()[0][:, ::-1])
    np.testing.assert_array_equal(told[0], mirrored[0])
    np.testing.assert_array_equal(untold[0], some_pixels()[0])
    with pytest.raises(ScanError, match="unknown image orientation 'left'"):
        read_sequence(stated, "left")


def test_lines_of_rf_keep_their_orientation(tmp_path):
    """PLUS keeps RF lines along the rows (FM), which is not turned to MF."""
    fields = {"UltrasoundImageOrientation": "FM", "UltrasoundImageType": "RF_REAL"}
    path = write_mha(tmp_path / "a.mha", some_pixels().astype("int16"), fields)

    frames = read_sequence(path).frames

    assert frames is not None
    assert frames.shape == (3, 4, 5)


def test_transforms_are_found_under_every_name(tmp_path):
    """With suffix or without, with status or without, spaced or not, of a tool or of none."""
    fields = {
        "Seq_Frame0000_ProbeToTrackerTransform": shift(1),
        "Seq_Frame0000_ProbeToTrackerTransformStatus": "OK",
        "Seq_Frame0001_ProbeToTrackerTransform": shift(2),
        "Seq_Frame0001_ProbeToTrackerTransformStatus": "out_of_view",
        "Seq_Frame0000_StylusTipToStylus": shift(3),
        "Seq_Frame0000_ToolToTrackerTransform ": shift(4, 1e-5),
        "Seq_Frame0002_CustomTransform": shift(5),
        "Seq_Frame0002_Note": "Probe To Table",
        "Seq_Frame0002_GoToPlace": "upstairs",
    }
    sequence = read_sequence(write_mha(tmp_path / "a.mha", some_pixels(), fields))

    assert list(sequence.transforms) == [
        ("Probe", "Tracker"),
        ("StylusTip", "Stylus"),
        ("Tool", "Tracker"),
        ("Custom", ""),
    ]
    probe = sequence.transforms[("Probe", "Tracker")]
    assert probe.statuses == ("OK", "OUT_OF_VIEW", "MISSING")
    assert probe.valid.tolist() == [True, False, False]
    assert bool(torch.isnan(probe.matrices[2]).all())
    assert float(sequence.transforms[("Tool", "Tracker")].matrices[0, 1, 3]) == 1e-5
    assert sequence.transforms[("Custom", "")].valid.tolist() == [False, False, True]
    assert sequence.frame_fields["GoToPlace"] == ("", "", "upstairs")


def test_a_header_line_needs_no_blank_after_its_sign(tmp_path):
    """One version of PLUS wrote 'Transform =1 0 0'."""
    path = write_mha(
        tmp_path / "a.mha", some_pixels(), {"Seq_Frame0000_ProbeToTrackerTransform": shift(1)}
    )
    path.write_bytes(path.read_bytes().replace(b"Transform = 1", b"Transform =1"))

    assert ("Probe", "Tracker") in read_sequence(path).transforms


def test_a_tool_out_of_sight_may_have_no_numbers(tmp_path):
    """Microsoft's library wrote 1.#QNAN for what the tracker did not see."""
    words = " ".join(["-1.#IND"] * 12 + ["0 0 0 1"])
    fields = {
        "Seq_Frame0000_ProbeToTrackerTransform": words,
        "Seq_Frame0000_ProbeToTrackerTransformStatus": "MISSING",
    }

    sequence = read_sequence(write_mha(tmp_path / "a.mha", some_pixels(), fields))

    assert not bool(sequence.transforms[("Probe", "Tracker")].valid.any())


def test_more_than_ten_thousand_frames_have_longer_numbers(tmp_path):
    """%04d grows beyond frame 9999."""
    fields = {f"Seq_Frame{k:04d}_Timestamp": str(k / 10) for k in range(10_500)}
    path = write_mha(tmp_path / "a.mha", some_pixels(10_500, 1, 1), fields)

    sequence = read_sequence(path)

    assert sequence.timestamps_s is not None
    assert float(sequence.timestamps_s[10_400]) == 1040


def test_frames_without_image_are_marked(tmp_path):
    """PLUS stores a blank frame and says that it is none."""
    path = write_mha(tmp_path / "a.mha", some_pixels(), {"Seq_Frame0001_ImageStatus": "INVALID"})

    sequence = read_sequence(path)

    assert sequence.image_valid is not None
    assert sequence.image_valid.tolist() == [True, False, True]


@pytest.mark.parametrize("compress", [True, False])
def test_pixels_may_be_in_a_second_file(tmp_path, compress):
    """A .mhd names its .raw or .zraw, which lies beside it."""
    pixels = some_pixels()
    data = zlib.compress(pixels.tobytes()) if compress else pixels.tobytes()
    whole = write_mha(tmp_path / "a.mha", pixels, compress=compress).read_bytes()
    (tmp_path / "b.raw").write_bytes(data)
    header = whole[: -len(data)].replace(b"LOCAL", b"b.raw")
    (tmp_path / "a.igs.mhd").write_bytes(header)

    frames = read_sequence(tmp_path / "a.igs.mhd").frames

    assert frames is not None
    np.testing.assert_array_equal(frames[:], pixels)


def test_spacing_is_believed_where_it_is_not_one(tmp_path):
    """1 is PLUS's word for a pixel; anything else is another program's millimetres."""
    path = write_mha(tmp_path / "a.mha", some_pixels(), {"ElementSpacing": "0.2 0.1 1"})

    assert read_sequence(path).spacing_mm == (0.2, 0.1)


@pytest.mark.parametrize("encoding", ["raw", "gz"])
@pytest.mark.parametrize("sign", ["", "="])
def test_the_nrrd_of_igsio(tmp_path, encoding, sign):
    """The same fields as keys; the status of the image is called Status."""
    keys = {
        "ultrasound image orientation": "UF",
        "ultrasound image type": "BRIGHTNESS",
        "Seq_Frame0000_ProbeToTrackerTransform": shift(1),
        "Seq_Frame0000_ProbeToTrackerTransformStatus": "OK",
        "Seq_Frame0000_Timestamp": "1.5",
        "Seq_Frame0001_Status": "INVALID",
    }
    path = write_nrrd(tmp_path / "a.igs.nrrd", some_pixels(), "domain domain list", keys, encoding)
    if not sign:
        path.write_bytes(path.read_bytes().replace(b"orientation:=", b"orientation: "))

    sequence = read_sequence(path)

    assert sequence.frames is not None
    assert sequence.image_valid is not None
    np.testing.assert_array_equal(sequence.frames[2], some_pixels()[2][:, ::-1])
    assert sequence.image_valid.tolist() == [True, False, True]
    assert sequence.transforms[("Probe", "Tracker")].valid.tolist() == [True, False, False]
    assert sequence.header == {}


@pytest.mark.parametrize("list_first", [True, False])
@pytest.mark.parametrize("encoding", ["raw", "gz"])
def test_the_sequences_of_core_slicer(tmp_path, list_first, encoding):
    """Volumes of one slice, the list axis last (now) or first (5.8), times as index values."""
    pixels = some_pixels()
    stored = np.moveaxis(pixels[:, None], 0, -1) if list_first else pixels[:, None]
    axis = 0 if list_first else 3
    directions = "(0.2,0,0) (0,0.1,0) (0,0,0.5)"
    path = write_nrrd(
        tmp_path / "a.seq.nrrd",
        np.ascontiguousarray(stored),
        "list domain domain domain" if list_first else "domain domain domain list",
        {
            "DataNodeClassName": "vtkMRMLScalarVolumeNode",
            f"axis {axis} index type": "numeric",
            f"axis {axis} index values": "0 0.05 0.11",
        },
        encoding,
        {
            "space": "left-posterior-superior",
            "space directions": f"none {directions}" if list_first else f"{directions} none",
        },
    )

    sequence = read_sequence(path)

    assert sequence.frames is not None
    assert sequence.timestamps_s is not None
    np.testing.assert_array_equal(sequence.frames[:], pixels)
    np.testing.assert_array_equal(sequence.frames[1], pixels[1])
    assert sequence.timestamps_s.tolist() == [0, 0.05, 0.11]
    assert sequence.spacing_mm == (0.2, 0.1)
    assert sequence.name == "a"


def test_colour_in_nrrd_is_the_fastest_axis(tmp_path):
    """IGSIO calls it vector."""
    pixels = some_pixels(channels=3)
    path = write_nrrd(tmp_path / "a.igs.nrrd", pixels, "vector domain domain list", {})

    frames = read_sequence(path).frames

    assert frames is not None
    np.testing.assert_array_equal(frames[:], pixels)


def test_a_detached_nrrd_names_its_pixels(tmp_path):
    """A .nhdr has no pixels and needs no empty line."""
    pixels = some_pixels()
    (tmp_path / "a.raw").write_bytes(b"skip" + pixels.tobytes())
    (tmp_path / "a.igs.nhdr").write_text(
        "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 5 4 3\nkinds: domain domain list\n"
        "encoding: raw\nbyte skip: -1\ndata file: a.raw\n"
    )

    frames = read_sequence(tmp_path / "a.igs.nhdr").frames

    assert frames is not None
    np.testing.assert_array_equal(frames[:], pixels)


@pytest.mark.parametrize("suffix", [".mha", ".nrrd"])
def test_large_streams_are_inflated_to_disk(tmp_path, monkeypatch, suffix):
    """Beyond the limit the same pixels come from a temporary file, which then vanishes."""
    monkeypatch.setattr(pixel_data, "LARGEST_IN_MEMORY_BYTES", 10)
    monkeypatch.setattr(pixel_data, "CHUNK_BYTES", 7)
    monkeypatch.setattr(pixel_data.tempfile, "tempdir", str(tmp_path / "room"))
    (tmp_path / "room").mkdir()
    if suffix == ".mha":
        path = write_mha(tmp_path / "a.mha", some_pixels(), compress=True)
    else:
        path = write_nrrd(tmp_path / "a.nrrd", some_pixels(), "domain domain list", {}, "gz")

    frames = read_sequence(path).frames

    assert frames is not None
    np.testing.assert_array_equal(frames[1], some_pixels()[1])
    np.testing.assert_array_equal(frames[:], some_pixels())
    del frames
    assert list((tmp_path / "room").iterdir()) == []


def test_frames_travel_to_another_process(tmp_path):
    """A worker opens the file for itself; what was inflated stays behind."""
    frames = read_sequence(write_mha(tmp_path / "a.mha", some_pixels(), compress=True)).frames
    assert frames is not None
    assert frames[0].size

    text = pickle.dumps(frames)

    assert len(text) < 1000
    np.testing.assert_array_equal(pickle.loads(text)[:], some_pixels())


def test_a_file_that_changes_under_us_is_noticed(tmp_path):
    """Pixels of the new file must not be taken for those of the old."""
    path = write_mha(tmp_path / "a.mha", some_pixels())
    frames = read_sequence(path).frames
    assert frames is not None

    write_mha(path, some_pixels(4))

    with pytest.raises(FormatError, match="changed after it was opened"):
        frames[0]


def test_opening_four_gigabytes_takes_little_memory(tmp_path):
    """Raw frames are read one by one; the file here is sparse and takes no disk."""
    path = write_mha(tmp_path / "a.mha", some_pixels(1), {"DimSize": "1024 1024 4096"})
    with path.open("rb+") as file:
        file.truncate(path.stat().st_size - some_pixels(1).nbytes + (4096 << 20))

    used = resident_mb_after(
        "from sonosweep.io.sequence import read_sequence\n"
        "frames = read_sequence(path).frames\n"
        "total = sum(int(frames[k].sum()) for k in range(0, 4096, 99))",
        path,
    )

    assert used < LARGEST_RESIDENT_MB


def test_a_large_stream_is_read_in_little_memory(tmp_path):
    """400 MB of compressed frames is never in memory at once."""
    frame = zlib.compressobj(1)
    data = b"".join([frame.compress(bytes(1 << 20)) for _ in range(400)]) + frame.flush()
    fields = {"DimSize": "1024 1024 400", "CompressedData": "True"}
    path = write_mha(tmp_path / "a.mha", some_pixels(1), fields)
    path.write_bytes(path.read_bytes()[: -some_pixels(1).nbytes] + data)

    used = resident_mb_after(
        "from sonosweep.io.sequence import read_sequence\n"
        "frames = read_sequence(path).frames\n"
        "assert all(not frames[k].any() for k in range(0, 400, 7))",
        path,
    )

    assert used < LARGEST_RESIDENT_MB


def test_opening_inflates_nothing(recordings):
    """Looking at a header costs milliseconds, whatever lies behind it."""
    path = recordings / "plus_watertank_temporal" / "WaterTankBottomTranslationVideoBuffer.igs.mha"
    read_sequence(path)  # the first call imports and compiles

    start = time.thread_time()
    sequence = read_sequence(path)
    opening = time.thread_time() - start
    start = time.thread_time()
    assert sequence.frames is not None
    assert sequence.frames[0].shape == (616, 820)
    inflating = time.thread_time() - start

    # 101 MB take a hundred times as long to inflate as 800 lines to read.
    assert opening < inflating

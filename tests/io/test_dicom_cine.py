"""Ultrasound cine: pixels, size, time and privacy of what scanners write."""

import io
import resource
import signal
from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pydicom import Dataset
from pydicom.encaps import encapsulate
from pydicom.uid import (
    UID,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRLittleEndian,
    JPEGBaseline8Bit,
)

from sonosweep.errors import FormatError
from sonosweep.io.dicom_cine import read_dicom_cine, write_dicom_cine
from sonosweep.io.dicom_new import describe_rgb, dicom_bytes, new_dicom, new_uid
from sonosweep.scan import Calibration, FrameView, Region, Scan
from tests.io.damage import (
    LARGEST_RESIDENT_MB,
    assert_one_sentence,
    assert_reads_or_explains,
    damaged,
    resident_mb_after,
)

TENTH_MICROSECOND_S = 1.01e-7  # frame times are written in ms with four decimals
ONE_LEVEL = 1  # YBR to RGB rounds once
# Whole levels of Cb, 1.77 of which make blue, made and undone by libraries that both cut.
YBR_LEVELS = 3


def make_scan(shape: tuple[int, ...] = (6, 40, 51), dtype: str = "uint8", seed: int = 0) -> Scan:
    """Random pixels with uneven times, a pixel size and a region."""
    rng = np.random.default_rng(seed)
    times = torch.from_numpy(np.cumsum(rng.uniform(0.02, 0.08, shape[0])))
    return Scan(
        name="made up",
        frames=rng.integers(0, 250, shape).astype(dtype),
        calibration=Calibration(spacing_mm=(0.2, 0.15)),
        timestamps_s=times - times[0],
        region=Region((3, 4, 30, 21)),
    )


@pytest.fixture
def cine(tmp_path: Path) -> Path:
    """A cine file of six gray frames."""
    write_dicom_cine(make_scan(), tmp_path / "cine.dcm")
    return tmp_path / "cine.dcm"


def changed(path: Path, **elements: object) -> Path:
    """The file with other elements; ``None`` removes one."""
    header = pydicom.dcmread(path)
    for keyword, value in elements.items():
        if value is None:
            delattr(header, keyword)
        else:
            setattr(header, keyword, value)
    header.save_as(path)
    return path


def region(kind: int, data: int, rectangle: tuple[int, int, int, int], cm: float) -> Dataset:
    """One entry of the Sequence of Ultrasound Regions."""
    item = Dataset()
    item.RegionSpatialFormat, item.RegionDataType, item.RegionFlags = kind, data, 0
    left, top, right, bottom = rectangle
    item.RegionLocationMinX0, item.RegionLocationMinY0 = left, top
    item.RegionLocationMaxX1, item.RegionLocationMaxY1 = right, bottom
    item.PhysicalUnitsXDirection = item.PhysicalUnitsYDirection = 3
    item.PhysicalDeltaX = item.PhysicalDeltaY = cm
    return item


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        ((6, 40, 51), "uint8"),
        ((3, 41, 51), "uint16"),
        ((1, 41, 51), "uint8"),
        ((5, 41, 51, 3), "uint8"),
    ],
)
def test_a_recording_survives(tmp_path: Path, shape, dtype: str, compressed: bool):
    """Pixels, size, region and times come back, and ITK finds the same pixels."""
    scan = make_scan(shape, dtype)
    write_dicom_cine(scan, tmp_path / "cine.dcm", compressed=compressed)

    back = read_dicom_cine(tmp_path / "cine.dcm")

    assert back.frames.shape == shape
    np.testing.assert_array_equal(back.frames[:], scan.frames[:])
    np.testing.assert_array_equal(back.frames[-1], scan.frames[-1])
    seen = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "cine.dcm")))
    np.testing.assert_array_equal(seen.reshape(shape), scan.frames[:])
    assert back.region is not None
    assert back.region.rectangle_px == (3, 4, 30, 21)
    assert back.calibration is not None
    assert back.calibration.spacing_mm == pytest.approx((0.2, 0.15))
    if shape[0] > 1:
        assert scan.timestamps_s is not None
        assert back.timestamps_s is not None
        assert float((back.timestamps_s - scan.timestamps_s).abs().max()) < TENTH_MICROSECOND_S


def test_twenty_thousand_uneven_times_survive(tmp_path: Path):
    """Lists past the 64 kB of a short length field are written and read."""
    scan = make_scan((20_000, 2, 2))

    write_dicom_cine(scan, tmp_path / "cine.dcm")

    back = read_dicom_cine(tmp_path / "cine.dcm").timestamps_s
    assert back is not None
    assert scan.timestamps_s is not None
    assert float((back - scan.timestamps_s).abs().max()) < TENTH_MICROSECOND_S


def test_even_times_are_one_number(cine: Path, tmp_path: Path):
    """20 Hz is written as a frame time of 50 ms."""
    scan = make_scan()
    even = Scan(scan.name, scan.frames, timestamps_s=torch.arange(6).double() / 20)

    write_dicom_cine(even, tmp_path / "even.dcm")

    assert pydicom.dcmread(tmp_path / "even.dcm").FrameTime == 50
    back = read_dicom_cine(tmp_path / "even.dcm")
    assert back.timestamps_s is not None
    assert back.timestamps_s.tolist() == pytest.approx((torch.arange(6) / 20).tolist())


def test_nobody_and_no_date_is_in_it(tmp_path: Path):
    """Not even the subject's code is written."""
    scan = make_scan()
    named = Scan("Jane Doe", scan.frames, subject="Jane Doe")

    write_dicom_cine(named, tmp_path / "cine.dcm")

    header = pydicom.dcmread(tmp_path / "cine.dcm")
    assert [e.keyword for e in header if e.VR in ("PN", "DA", "TM", "DT") and e.value] == []
    assert b"Jane" not in (tmp_path / "cine.dcm").read_bytes()
    assert header.SOPClassUID == "1.2.840.10008.5.1.4.1.1.3.1"


def test_a_patient_in_a_file_stays_in_the_file(cine: Path):
    """A scan read from a clinical file names nobody."""
    changed(cine, PatientName="Doe^Jane", PatientID="4711", InstitutionName="Ward 7")

    scan = read_dicom_cine(cine)

    assert scan.subject is None
    assert "Jane" not in f"{scan.name} {scan.notes}"


def test_burnt_in_text_can_be_blanked(tmp_path: Path):
    """Everything outside the region becomes 0, everything inside stays."""
    scan = make_scan()
    write_dicom_cine(scan, tmp_path / "cine.dcm", blank_outside_region=True)

    frames = read_dicom_cine(tmp_path / "cine.dcm").frames[:]

    np.testing.assert_array_equal(frames[:, 4:25, 3:33], scan.frames[:][:, 4:25, 3:33])
    frames[:, 4:25, 3:33] = 0
    assert not frames.any()
    assert pydicom.dcmread(tmp_path / "cine.dcm").BurnedInAnnotation == "NO"


def test_blanking_needs_a_region(tmp_path: Path):
    """Without one nobody knows what to keep, and nothing is written."""
    scan = Scan("made up", make_scan().frames)

    with pytest.raises(FormatError, match="no region"):
        write_dicom_cine(scan, tmp_path / "cine.dcm", blank_outside_region=True)

    assert list(tmp_path.iterdir()) == []


def test_the_largest_tissue_region_counts(cine: Path):
    """Beside a smaller image, a larger colour box and a Doppler trace."""
    changed(
        cine,
        SequenceOfUltrasoundRegions=[
            region(1, 1, (0, 0, 9, 9), 0.05),
            region(1, 1, (10, 2, 39, 31), 0.02),
            region(1, 2, (0, 0, 50, 39), 0.03),
            region(3, 3, (0, 0, 50, 39), 0.04),
        ],
    )

    scan = read_dicom_cine(cine)

    assert scan.region is not None
    assert scan.region.rectangle_px == (10, 2, 30, 30)
    assert scan.calibration is not None
    assert scan.calibration.spacing_mm == pytest.approx((0.2, 0.2))


@pytest.mark.parametrize(
    "regions",
    [
        None,
        [],
        [region(3, 3, (0, 0, 50, 39), 0.04)],
        [region(1, 1, (0, 0, 50, 39), 0.0)],
        [region(1, 1, (0, 0, 50, 39), float("nan"))],
        [region(1, 1, (60, 60, 90, 90), 0.04)],
    ],
)
def test_the_size_of_a_pixel_is_never_guessed(cine: Path, regions):
    """No usable region: no calibration, and a note that says so."""
    scan = read_dicom_cine(changed(cine, SequenceOfUltrasoundRegions=regions))

    assert scan.calibration is None
    assert scan.region is None
    assert "region" in scan.notes["calibration"]


def test_mirrored_axes_are_noted(cine: Path):
    """A negative size per pixel still has a size."""
    scan = read_dicom_cine(
        changed(cine, SequenceOfUltrasoundRegions=[region(1, 1, (0, 0, 9, 9), -0.02)])
    )

    assert scan.calibration is not None
    assert scan.calibration.spacing_mm == pytest.approx((0.2, 0.2))
    assert "backwards" in scan.notes["calibration"]


def test_units_other_than_cm_do_not_count(cine: Path):
    """A region in seconds or percent is no length."""
    item = region(1, 1, (0, 0, 50, 39), 0.02)
    item.PhysicalUnitsXDirection = 4

    assert read_dicom_cine(changed(cine, SequenceOfUltrasoundRegions=[item])).calibration is None


@pytest.mark.parametrize(
    ("elements", "seconds", "note"),
    [
        ({"FrameTimeVector": [0, 10, 20, 30, 40, 50]}, [0, 0.01, 0.03, 0.06, 0.1, 0.15], None),
        ({"FrameTimeVector": [10, 20, 30, 40, 50]}, [0, 0.01, 0.03, 0.06, 0.1, 0.15], "lacks"),
        ({"FrameTimeVector": [0, 10, 0, 30, 40, 50]}, None, "increase"),
        ({"FrameTimeVector": None}, None, "no frame times"),
        ({"FrameTimeVector": None, "FrameTime": 100}, [0, 0.1, 0.2, 0.3, 0.4, 0.5], None),
        ({"FrameTimeVector": None, "FrameTime": 0}, None, "no frame times"),
        ({"FrameTimeVector": None, "CineRate": 10}, [0, 0.1, 0.2, 0.3, 0.4, 0.5], "cine rate"),
    ],
)
def test_times_are_those_of_the_file(cine: Path, elements, seconds, note: str | None):
    """Vectors, even times, hints with a note, or nothing with a reason."""
    scan = read_dicom_cine(changed(cine, **elements))

    if seconds is None:
        assert scan.timestamps_s is None
    else:
        assert scan.timestamps_s is not None
        assert scan.timestamps_s.tolist() == pytest.approx(seconds)
    assert (note is None) == ("timestamps" not in scan.notes)
    assert note is None or note in scan.notes["timestamps"]


def test_times_for_another_number_of_frames_are_refused(cine: Path):
    """Six frames and three times do not belong together."""
    with pytest.raises(FormatError, match="6 frames but 3 frame times"):
        read_dicom_cine(changed(cine, FrameTimeVector=[0, 10, 20]))


def color_file(path: Path, pixels: bytes | list[bytes], photometric: str, frames: int) -> Path:
    """A colour cine of 32 x 24 pixels, plain or (a list) compressed as JPEG."""
    header = new_dicom("1.2.840.10008.5.1.4.1.1.3.1", "US")
    describe_rgb(header, 24, 32)
    header.PhotometricInterpretation = photometric
    header.NumberOfFrames = frames
    if isinstance(pixels, list):
        header.file_meta.TransferSyntaxUID = JPEGBaseline8Bit
        header.PixelData = encapsulate(pixels, has_bot=False)
        header["PixelData"].is_undefined_length = True
    else:
        header.PixelData = pixels
    header["PixelData"].VR = "OB"
    path.write_bytes(dicom_bytes(header))
    return path


def smooth_rgb() -> np.ndarray:
    """A picture without sharp colour edges, which 4:2:2 would blur."""
    y, x = np.mgrid[:24, :32]
    return np.stack([8 * x, 10 * y, 255 - 4 * (x + y)], axis=-1).clip(0, 255).astype(np.uint8)


def test_ybr_full_becomes_rgb(tmp_path: Path):
    """Luma and colour differences come out as red, green and blue."""
    rgb = smooth_rgb()
    ybr = np.asarray(Image.fromarray(rgb).convert("YCbCr"))

    scan = read_dicom_cine(color_file(tmp_path / "c.dcm", ybr.tobytes() * 2, "YBR_FULL", 2))

    assert scan.frames.shape == (2, 24, 32, 3)
    assert np.abs(scan.frames[1].astype(int) - rgb).max() <= YBR_LEVELS


def test_plain_ybr_422_becomes_rgb(tmp_path: Path):
    """Two pixels that share their colour differences, uncompressed."""
    ybr = np.asarray(Image.fromarray(smooth_rgb()).convert("YCbCr"))
    pairs = np.stack([ybr[:, ::2, 0], ybr[:, 1::2, 0], ybr[:, ::2, 1], ybr[:, ::2, 2]], axis=-1)

    scan = read_dicom_cine(color_file(tmp_path / "c.dcm", pairs.tobytes(), "YBR_FULL_422", 1))

    luma = FrameView(scan.frames, gray=True)[0].astype(int)
    assert np.abs(luma - ybr[..., 0]).max() <= YBR_LEVELS


def test_jpeg_of_scanners_is_decoded(tmp_path: Path):
    """JPEG baseline 4:2:2, as most machines write: as Pillow decodes it, and as ITK does."""
    stream = io.BytesIO()
    Image.fromarray(smooth_rgb()).save(stream, "JPEG", quality=95, subsampling="4:2:2")
    path = color_file(tmp_path / "c.dcm", [stream.getvalue()] * 3, "YBR_FULL_422", 3)

    scan = read_dicom_cine(path)

    expected = np.asarray(Image.open(stream)).astype(int)
    assert np.abs(scan.frames[2].astype(int) - expected).max() <= ONE_LEVEL
    seen = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))
    assert np.abs(scan.frames[:].astype(int) - seen).max() <= ONE_LEVEL


def test_inverted_gray_is_turned(cine: Path):
    """MONOCHROME1 counts towards black; a scan counts towards white."""
    before = read_dicom_cine(cine).frames[:]

    after = read_dicom_cine(changed(cine, PhotometricInterpretation="MONOCHROME1")).frames[:]

    np.testing.assert_array_equal(after, 255 - before)


def test_palette_colors_are_looked_up(cine: Path):
    """Indices become the colours of the file's table."""
    before = read_dicom_cine(cine).frames[0]
    ramp = np.arange(256, dtype="<u2") << 8
    header = pydicom.dcmread(cine)
    header.PhotometricInterpretation = "PALETTE COLOR"
    for number, table in enumerate((ramp, ramp[::-1], ramp * 0)):  # red, green, blue
        header.add_new(0x00281101 + number, "US", [256, 0, 16])
        header.add_new(0x00281201 + number, "OW", table.tobytes())
    header.save_as(cine)

    scan = read_dicom_cine(cine)

    expected = np.stack([before, 255 - before, np.zeros_like(before)], axis=-1)
    np.testing.assert_array_equal(scan.frames[0], expected)


def folder_of_frames(folder: Path, scan: Scan) -> Path:
    """One file per frame, named against their order, with the time of day."""
    folder.mkdir()
    series = new_uid()
    for index in range(len(scan.frames)):
        one = Scan("one", scan.frames[index : index + 1], scan.calibration, region=scan.region)
        path = folder / f"{99 - index}.dcm"
        write_dicom_cine(one, path)
        changed(
            path,
            SeriesInstanceUID=series,
            InstanceNumber=index + 1,
            ContentTime=f"1030{59 if index else 58:02d}.{index}",
        )
    return folder


def test_a_folder_of_single_frames_is_one_recording(tmp_path: Path):
    """Ordered by instance number, timed by the time of day, other files passed over."""
    scan = make_scan((4, 20, 30))
    folder = folder_of_frames(tmp_path / "sweep", scan)
    (folder / "notes.txt").write_text("not DICOM")

    back = read_dicom_cine(folder)

    np.testing.assert_array_equal(back.frames[:], scan.frames[:])
    assert back.timestamps_s is not None
    assert back.timestamps_s.tolist() == pytest.approx([0, 1.1, 1.2, 1.3])
    assert back.calibration is not None
    assert back.name == "sweep"


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ({"SeriesInstanceUID": "2.25.1"}, "several series"),
        ({"Rows": 10, "Columns": 60}, "unlike"),
        ({"NumberOfFrames": 2, "Rows": 10}, "several recordings"),
    ],
)
def test_folders_of_mixed_files_are_refused(tmp_path: Path, elements, message: str):
    """What does not belong together is named."""
    folder = folder_of_frames(tmp_path / "sweep", make_scan((3, 20, 30)))
    changed(folder / "98.dcm", **elements)

    with pytest.raises(FormatError, match=message):
        read_dicom_cine(folder)


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ({"NumberOfFrames": 10**9}, "promises"),
        ({"Rows": 65535, "Columns": 65535}, "promises"),
        ({"PhotometricInterpretation": "YBR_PARTIAL_420"}, "YBR_PARTIAL_420"),
        ({"BitsAllocated": 32, "BitsStored": 32, "HighBit": 31}, "32 bits"),
        ({"Rows": None}, "cannot read"),
        ({"Rows": 0}, "frames, rows and columns"),
        ({"PixelData": None}, "no image"),
    ],
)
def test_absurd_headers_are_refused(cine: Path, elements, message: str):
    """Before any memory is taken, in one sentence."""
    with pytest.raises(FormatError, match=message) as caught:
        read_dicom_cine(changed(cine, **elements))

    assert_one_sentence(caught.value)


def test_a_huge_frame_in_a_small_compressed_file_is_refused(tmp_path: Path):
    """Twelve gigabytes of colour do not come out of a kilobyte of JPEG."""
    stream = io.BytesIO()
    Image.fromarray(smooth_rgb()).save(stream, "JPEG")
    path = color_file(tmp_path / "c.dcm", [stream.getvalue()], "YBR_FULL_422", 1)

    with pytest.raises(FormatError, match="promises"):
        read_dicom_cine(changed(path, Rows=65535, Columns=65535))


def test_compressed_frames_that_are_missing_are_noticed_on_opening(tmp_path: Path):
    """Five frames promised, three there."""
    stream = io.BytesIO()
    Image.fromarray(smooth_rgb()).save(stream, "JPEG")
    path = color_file(tmp_path / "c.dcm", [stream.getvalue()] * 3, "YBR_FULL_422", 5)

    with pytest.raises(FormatError, match="5 frames and 3 are there"):
        read_dicom_cine(path)


def test_unknown_compression_is_named(tmp_path: Path):
    """A video in DICOM needs another program."""
    path = color_file(tmp_path / "c.dcm", [b"xxxx"], "YBR_FULL_422", 1)
    header = pydicom.dcmread(path)
    header.file_meta.TransferSyntaxUID = UID("1.2.840.10008.1.2.4.102")
    header.save_as(path)

    with pytest.raises(FormatError, match="MPEG-4"):
        read_dicom_cine(path)


def test_pixels_that_dicom_lacks_are_refused(tmp_path: Path):
    """Real numbers are not rounded behind the user's back."""
    scan = Scan("made up", np.zeros((2, 4, 4), np.float32))

    with pytest.raises(FormatError, match="float32"):
        write_dicom_cine(scan, tmp_path / "c.dcm")

    assert list(tmp_path.iterdir()) == []


def test_more_than_4_gib_is_refused_before_it_is_written(tmp_path: Path):
    """DICOM's length field ends there."""
    frames = np.broadcast_to(np.zeros((1, 1, 1), np.uint8), (5000, 1000, 1000))

    with pytest.raises(FormatError, match="4 GiB"):
        write_dicom_cine(Scan("made up", frames), tmp_path / "c.dcm")

    assert list(tmp_path.iterdir()) == []


def test_opening_a_4_gb_recording_is_small(tmp_path: Path):
    """Frames are read one at a time, wherever they lie in the file."""
    header = new_dicom("1.2.840.10008.5.1.4.1.1.3.1", "US")
    scan = make_scan((1, 1000, 1000))
    write_dicom_cine(Scan("made up", scan.frames), tmp_path / "c.dcm")
    header = pydicom.dcmread(tmp_path / "c.dcm", stop_before_pixels=True)
    header.NumberOfFrames = 4000
    with (tmp_path / "c.dcm").open("wb") as file:
        file.write(dicom_bytes(header))
        file.write(b"\xe0\x7f\x10\x00OB\0\0" + (4_000_000_000).to_bytes(4, "little"))
        file.truncate(file.tell() + 4_000_000_000)  # a hole: no disk is used

    resident_mb = resident_mb_after(
        "from sonosweep.io.dicom_cine import read_dicom_cine\n"
        "scan = read_dicom_cine(path)\nassert scan.frames[3999].shape == (1000, 1000)",
        tmp_path / "c.dcm",
    )

    assert resident_mb < LARGEST_RESIDENT_MB


def test_a_deflated_file_is_refused(cine: Path):
    """It would have to be unpacked as a whole, however large that is."""
    header = pydicom.dcmread(cine)
    header.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    header.save_as(cine)

    with pytest.raises(FormatError, match="deflated"):
        read_dicom_cine(cine)


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory) -> list[bytes]:
    """A plain, an RLE and a JPEG file."""
    folder = tmp_path_factory.mktemp("whole")
    scan = make_scan((3, 12, 10))
    write_dicom_cine(scan, folder / "plain.dcm")
    write_dicom_cine(scan, folder / "rle.dcm", compressed=True)
    stream = io.BytesIO()
    Image.fromarray(smooth_rgb()).save(stream, "JPEG")
    color_file(folder / "jpeg.dcm", [stream.getvalue()] * 2, "YBR_FULL_422", 2)
    return [path.read_bytes() for path in sorted(folder.iterdir())]


@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, whole_files, data):
    """Cut, flipped or random bytes give frames or one sentence, never anything else."""
    path = tmp_path_factory.mktemp("damaged") / "cine.dcm"
    path.write_bytes(data.draw(damaged(data.draw(st.sampled_from(whole_files)))))

    assert_reads_or_explains(lambda: read_dicom_cine(path))


def test_plain_files_that_are_cut_are_refused_on_opening(tmp_path: Path, whole_files):
    """A recording whose last frame is not whole does not open."""
    plain = next(whole for whole in whole_files if ExplicitVRLittleEndian.encode() + b"\0" in whole)
    for length in range(0, len(plain) - 1, 13):
        (tmp_path / "cut.dcm").write_bytes(plain[:length])
        with pytest.raises(FormatError):
            read_dicom_cine(tmp_path / "cut.dcm")


@pytest.mark.parametrize("compressed", [False, True])
def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, compressed: bool):
    """When the disk ends in the middle of the frames, one sentence comes out and no file."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.getsignal(signal.SIGXFSZ)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(FormatError) as caught:
            write_dicom_cine(make_scan((20, 60, 60)), tmp_path / "c.dcm", compressed=compressed)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)

    assert_one_sentence(caught.value)
    assert list(tmp_path.iterdir()) == []

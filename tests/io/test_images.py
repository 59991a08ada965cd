"""Folders of images: order, kinds of pixels, and the odd one out."""

import struct
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sonosweep.errors import FormatError, ScanError
from sonosweep.io.images import read_images, write_images
from sonosweep.io.trajectory_text import write_trajectory_csv
from sonosweep.scan import Trajectory

from .damage import LARGEST_RESIDENT_MB, assert_reads_or_explains, damaged, resident_mb_after


def gray(value: int, rows: int = 4, columns: int = 6, dtype=np.uint8) -> Image.Image:
    """An image of one value."""
    return Image.fromarray(np.full((rows, columns), value, dtype))


def straight(count: int) -> torch.Tensor:
    """Poses 1 mm apart."""
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, 2, 3] = torch.arange(count)
    return poses


def test_frame_2_comes_before_frame_10(tmp_path):
    """Numbers in names count as numbers, whatever their digits; other files do not count."""
    for value in (10, 2, 1, 33):
        gray(value).save(tmp_path / f"Frame{value}.png")
    gray(4).save(tmp_path / "frame0004.PNG")
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "._Frame2.png").write_bytes(b"left by a Mac")

    frames = read_images(tmp_path).frames

    assert [int(frame[0, 0]) for frame in frames[:]] == [1, 2, 4, 10, 33]


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".jpg"])
def test_each_format_reads(tmp_path, suffix):
    """PNG, TIFF and BMP keep every pixel; JPEG keeps a flat gray."""
    for value in range(3):
        gray(100 + value).save(tmp_path / f"{value}{suffix}")

    frames = read_images(tmp_path).frames

    assert (frames.shape, frames.dtype) == ((3, 4, 6), np.uint8)
    np.testing.assert_array_equal(frames[1:3][:, 0, 0], [101, 102])


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_stay(tmp_path, suffix):
    """Nothing is reduced to 8 bits."""
    for value in (0, 40000):
        gray(value, dtype=np.uint16).save(tmp_path / f"{value}{suffix}")

    frames = read_images(tmp_path).frames

    assert frames.dtype == np.uint16
    assert frames[1].max() == 40000


def test_colour_has_three_channels(tmp_path):
    """Transparency is dropped and a palette looked up."""
    Image.new("RGBA", (6, 4), (10, 20, 30, 128)).save(tmp_path / "a.png")
    assert read_images(tmp_path).frames[0][0, 0].tolist() == [10, 20, 30]

    (tmp_path / "a.png").unlink()
    palette = Image.new("P", (6, 4), 1)
    palette.putpalette([0, 0, 0, 7, 8, 9])
    palette.save(tmp_path / "b.png")
    assert read_images(tmp_path).frames[0][3, 5].tolist() == [7, 8, 9]


def test_the_pages_of_a_tiff_are_frames(tmp_path):
    """Scanners and ImageJ store a sweep as one TIFF."""
    pages = [gray(value) for value in (5, 6, 7)]
    pages[0].save(tmp_path / "sweep.tif", save_all=True, append_images=pages[1:])

    scan = read_images(tmp_path / "sweep.tif", spacing_mm=(0.2, 0.1))

    assert [int(frame[0, 0]) for frame in scan.frames[:]] == [5, 6, 7]
    assert (scan.name, scan.calibration.spacing_mm) == ("sweep", (0.2, 0.1))


@given(
    st.sampled_from([(3, 5, 7), (3, 5, 7, 3)]), st.sampled_from([np.uint8, np.uint16]), st.data()
)
def test_written_images_read_back(tmp_path_factory, shape, dtype, data):
    """PNG loses nothing."""
    seed = data.draw(st.integers(0, 1000))
    frames = np.random.default_rng(seed).integers(0, 256, shape).astype(dtype)
    folder = tmp_path_factory.mktemp("images") / "out"

    if len(shape) == 4 and dtype == np.uint16:
        with pytest.raises(FormatError, match="PNG holds 8-bit"):
            write_images(frames, folder)
        return
    write_images(frames, folder)

    np.testing.assert_array_equal(read_images(folder).frames[:], frames)
    with pytest.raises(FormatError, match="already holds images"):
        write_images(frames, folder)


def test_poses_beside_the_images_are_used(tmp_path):
    """A csv of the same length gives poses and times."""
    write_images(np.zeros((3, 4, 6), np.uint8), tmp_path)
    times = torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64)
    write_trajectory_csv(Trajectory(straight(3), times), tmp_path / "poses.csv")

    scan = read_images(tmp_path)

    assert torch.equal(scan.image_to_reference, straight(3))
    assert torch.equal(scan.timestamps_s, times)
    assert scan.tracked is None


def test_frames_without_pose_are_not_tracked(tmp_path):
    """A table with a frame column may leave frames out."""
    write_images(np.zeros((3, 4, 6), np.uint8), tmp_path / "images")
    header = "frame,tx,ty,tz,qx,qy,qz,qw\n"
    (tmp_path / "some.csv").write_text(header + "0,0,0,0,0,0,0,1\n2,0,0,2,0,0,0,1\n")

    scan = read_images(tmp_path / "images", poses=tmp_path / "some.csv")

    assert scan.tracked.tolist() == [True, False, True]
    assert scan.image_to_reference[2, 2, 3] == 2.0


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("0 0 0 0 0 0 0 1\n", "2 frames but 1 timestamps"),
        ("0 0 0 0 0 0 1\n", "2 frames but 1 poses"),
        ("frame,tx,ty,tz,qx,qy,qz,qw\n7,0,0,0,0,0,0,1\n", "a pose of frame 7"),
        (
            "frame,tx,ty,tz,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n0,0,0,2,0,0,0,1\n",
            "not 0 to 1 in order",
        ),
    ],
)
def test_poses_that_do_not_fit_are_said(tmp_path, table, message):
    """Counts that differ are never cut to fit."""
    write_images(np.zeros((2, 4, 6), np.uint8), tmp_path)
    (tmp_path / "poses.txt").write_text(table)

    with pytest.raises((FormatError, ScanError), match=message):
        read_images(tmp_path)


def test_the_odd_image_is_named(tmp_path):
    """Another size or another kind of pixel among the frames is a mistake of the export."""
    write_images(np.zeros((3, 4, 6), np.uint8), tmp_path)
    gray(0, rows=5).save(tmp_path / "frame0001.png")
    with pytest.raises(FormatError, match=r"'frame0001.png' is 6 x 5 pixels .* 6 x 4 pixels"):
        read_images(tmp_path)

    Image.new("RGB", (6, 4)).save(tmp_path / "frame0001.png")
    with pytest.raises(FormatError, match=r"'frame0001.png' is .* kind RGB"):
        read_images(tmp_path)


def test_images_that_are_none_are_named(tmp_path):
    """An empty folder, a missing one, a text called PNG, an image cut short."""
    with pytest.raises(FormatError, match=r"holds no \.png"):
        read_images(tmp_path)
    with pytest.raises(FormatError, match="there is no folder"):
        read_images(tmp_path / "none")

    (tmp_path / "a.png").write_text("no image")
    with pytest.raises(FormatError, match=r"'a\.png' cannot be read"):
        read_images(tmp_path)

    noise = np.random.default_rng(0).integers(0, 256, (50, 50), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:1500])
    frames = read_images(tmp_path).frames
    with pytest.raises(FormatError, match=r"'a\.png' cannot be read"):
        frames[0]


def test_an_image_that_unpacks_to_gigabytes_is_refused(tmp_path):
    """Some kB of PNG can claim 30000 x 30000 pixels."""
    gray(0).save(tmp_path / "bomb.png")
    png = bytearray((tmp_path / "bomb.png").read_bytes())
    png[16:24] = struct.pack(">II", 30000, 30000)
    png[29:33] = struct.pack(">I", zlib.crc32(png[12:29]))
    (tmp_path / "bomb.png").write_bytes(png)

    with pytest.raises(FormatError, match="too large to be a frame"):
        read_images(tmp_path)


def test_opening_many_images_needs_little_memory(tmp_path):
    """4 GB of frames (512 images of 8 MB) are not in memory."""
    page = np.zeros((2048, 4096), np.uint8)
    Image.fromarray(page).save(tmp_path / "frame0.png")
    for i in range(1, 512):
        (tmp_path / f"frame{i}.png").hardlink_to(tmp_path / "frame0.png")

    used = resident_mb_after(
        "from sonosweep.io.images import read_images\n"
        "frames = read_images(path).frames\n"
        "assert len(frames) == 512 and not any(frames[i].any() for i in range(0, 512, 64))",
        tmp_path,
    )

    assert used < LARGEST_RESIDENT_MB


def test_the_stills_of_a_muscle_read(recordings):
    """Real images of one scanner make a stack."""
    frames = read_images(recordings / "timtrack_bmode").frames

    assert len(frames) == 8
    assert frames[0].any()


@given(data=st.data(), suffix=st.sampled_from([".png", ".tif", ".bmp", ".jpg"]))
def test_damaged_images_are_explained(tmp_path_factory, data, suffix):
    """Bytes lost or changed anywhere give frames or a sentence, nothing else."""
    folder = tmp_path_factory.mktemp("damaged")
    noise = np.random.default_rng(0).integers(0, 256, (2, 9, 11), dtype=np.uint8)
    for i in range(2):
        Image.fromarray(noise[i]).save(folder / f"{i}{suffix}")
    path = folder / f"1{suffix}"
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_images(folder))

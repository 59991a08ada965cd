"""MetaImage volumes, with SimpleITK as the other reader and writer."""

import os
import zlib

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError
from sonosweep.io.metaimage import read_metaimage, write_metaimage
from sonosweep.scan import Volume, VolumeGrid, voxel_to_reference

from ..strategies import poses
from .damage import assert_reads_or_explains, damaged

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m, written with all their digits
PRINTED_MM = 1e-4  # SimpleITK prints 15 digits, PLUS six
IDENTITY = torch.eye(4, dtype=torch.float64)
TURN = np.diag([-1.0, -1.0, 1.0])


def some_volume(pose, dtype="uint8", channels=1, seed=0) -> Volume:
    """Return random voxels on an oblique grid."""
    shape = (3, 4, 5) if channels == 1 else (3, 4, 5, channels)
    values = np.random.default_rng(seed).integers(0, 200, shape)
    rotation = pose[:3, :3].numpy()
    grid = VolumeGrid(
        size=(5, 4, 3),
        spacing_mm=(0.3, 0.41, 0.7),
        origin_mm=tuple(pose[:3, 3].tolist()),
        direction=tuple(tuple(row) for row in rotation.tolist()),
    )
    return Volume(values.astype(dtype), grid, settings={"method": "gather", "voxel_mm": "0.3"})


@given(
    pose=poses(),
    dtype=st.sampled_from(["uint8", "uint16", "int16", "float32"]),
    channels=st.sampled_from([1, 3]),
    compress=st.booleans(),
    world=st.sampled_from(["ras", "lps"]),
)
def test_a_written_volume_reads_back_unchanged(
    tmp_path_factory, pose, dtype, channels, compress, world
):
    """Voxels, their place and how they were made survive a file."""
    path = tmp_path_factory.mktemp("volume") / "v.mha"
    volume = some_volume(pose, dtype, channels)

    write_metaimage(volume, path, world, compress)
    # The file says which world it is in, so what the reader assumes does not matter.
    back = read_metaimage(path, "lps" if world == "ras" else "ras")

    assert back.voxels.dtype == volume.voxels.dtype
    np.testing.assert_array_equal(back.voxels, volume.voxels)
    assert back.settings == volume.settings
    error = voxel_to_reference(back.grid) - voxel_to_reference(volume.grid)
    assert float(error.abs().max()) < ROUND_OFF_MM


@given(pose=poses(), world=st.sampled_from(["ras", "lps"]))
def test_simpleitk_sees_the_same_voxel_at_the_same_place(tmp_path_factory, pose, world):
    """ITK puts voxel (2, 3, 1) at our reference point, half turned about z for RAS."""
    path = tmp_path_factory.mktemp("volume") / "v.mha"
    volume = some_volume(pose)
    write_metaimage(volume, path, world)

    image = sitk.ReadImage(str(path))

    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), volume.voxels)
    ours = (voxel_to_reference(volume.grid).numpy() @ [2, 3, 1, 1])[:3]
    expected = TURN @ ours if world == "ras" else ours
    theirs = image.TransformIndexToPhysicalPoint((2, 3, 1))
    np.testing.assert_allclose(theirs, expected, atol=PRINTED_MM)
    assert image.GetMetaData("Sonosweep_world") == world


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("suffix", [".mha", ".mhd"])
@pytest.mark.parametrize("kind", [sitk.sitkInt16, sitk.sitkFloat64, sitk.sitkVectorUInt8])
def test_what_simpleitk_writes_is_read(tmp_path, kind, suffix, compress):
    """Files of ITK, in one piece or two, keep their pixels and their place."""
    channels = 3 if kind == sitk.sitkVectorUInt8 else 1
    values = np.random.default_rng(1).integers(0, 99, (3, 4, 5) + (channels,) * (channels > 1))
    image = sitk.Cast(sitk.GetImageFromArray(values, isVector=channels > 1), kind)
    image.SetOrigin((1.5, -2.25, 3.125))
    image.SetSpacing((0.5, 0.25, 2.0))
    image.SetDirection((0, -1, 0, 1, 0, 0, 0, 0, 1))
    path = tmp_path / f"v{suffix}"
    sitk.WriteImage(image, str(path), useCompression=compress)

    volume = read_metaimage(path, world="lps")

    np.testing.assert_array_equal(volume.voxels, values)
    place = (voxel_to_reference(volume.grid).numpy() @ [4, 1, 2, 1])[:3]
    np.testing.assert_allclose(place, image.TransformIndexToPhysicalPoint((4, 1, 2)))


def test_left_handed_axes_are_turned_without_moving_a_voxel(tmp_path):
    """Counting slices from the other end makes a mirrored grid right-handed."""
    values = np.arange(60, dtype=np.uint8).reshape(3, 4, 5)
    image = sitk.GetImageFromArray(values)
    image.SetSpacing((0.5, 0.25, 2.0))
    image.SetDirection((0, 1, 0, 1, 0, 0, 0, 0, 1))
    sitk.WriteImage(image, str(tmp_path / "v.mha"))

    volume = read_metaimage(tmp_path / "v.mha", world="lps")

    place = (voxel_to_reference(volume.grid).numpy() @ [4, 1, 2, 1])[:3]
    index = image.TransformPhysicalPointToIndex(place)
    assert volume.voxels[2, 1, 4] == image[index]


def test_the_volumes_of_plus_are_read_as_simpleitk_reads_them(recordings):
    """Real files: PLUS pads its sizes with blanks and leaves no world."""
    for path in sorted((recordings / "plus_spine_freehand").glob("*Ref.mha")):
        image = sitk.ReadImage(str(path))

        volume = read_metaimage(path, world="lps")

        np.testing.assert_array_equal(volume.voxels, sitk.GetArrayFromImage(image))
        np.testing.assert_allclose(volume.grid.origin_mm, image.GetOrigin(), atol=PRINTED_MM)
        assert volume.grid.spacing_mm == image.GetSpacing()


def test_a_flat_image_is_a_volume_of_one_slice(tmp_path):
    """Two sizes make one slice, one millimetre thick."""
    sitk.WriteImage(sitk.GetImageFromArray(np.ones((4, 5), np.uint8)), str(tmp_path / "v.mha"))

    volume = read_metaimage(tmp_path / "v.mha")

    assert volume.grid.size == (5, 4, 1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"DimSize = 5 4 3", b"DimSize = 5 4 1000000000000", "cut off or its header is wrong"),
        (b"DimSize = 5 4 3", b"DimSize = 5 4 2", "cut off or its header is wrong"),
        (b"DimSize = 5 4 3", b"DimSize = -5 4 3", "one size of 0 or more"),
        (b"DimSize = 5 4 3", b"DimSize = 5 4", "one size of 0 or more"),
        (b"DimSize = 5 4 3", b"DimSize = 5 4 x", "expected whole numbers"),
        (b"NDims = 3", b"NDims = 3 3", "expected one number"),
        (b"MET_UCHAR", b"MET_OTHER", "expected one of MET_CHAR"),
        (b"BinaryData = True", b"BinaryData = False", "as text"),
        (b"ElementSpacing = 0.3", b"ElementSpacing = 0.0", "above 0 mm"),
        (b"ElementSpacing = 0.3", b"ElementSpacing = nan", "expected numbers"),
        (b"Offset = ", b"Offset = 7 ", "holds 4 numbers, expected 3"),
        (b"LOCAL", b"/dev/zero", "not beside it"),
        (b"LOCAL", b"LIST", "over several files"),
        (b"Sonosweep_world = ras", b"Sonosweep_world = xyz", "expected ras or lps"),
        (b"ElementDataFile", b"ElementDataFool", "is not text"),
    ],
)
def test_a_wrong_header_is_explained_in_one_sentence(tmp_path, old, new, message):
    """Sizes beyond the file, words for numbers and missing parts are named."""
    write_metaimage(some_volume(IDENTITY), tmp_path / "v.mha", compress=False)
    whole = (tmp_path / "v.mha").read_bytes()
    assert old in whole
    (tmp_path / "v.mha").write_bytes(whole.replace(old, new))

    with pytest.raises(FormatError, match=message):
        read_metaimage(tmp_path / "v.mha")


def test_a_compressed_bomb_is_not_inflated(tmp_path):
    """A stream of a gigabyte behind a header of 60 voxels stops after those 60."""
    bomb = zlib.compress(bytes(50 << 20), 9)
    header = (
        "ObjectType = Image\nNDims = 3\nDimSize = 5 4 3\nElementType = MET_UCHAR\n"
        "CompressedData = True\nElementDataFile = LOCAL\n"
    )
    (tmp_path / "v.mha").write_bytes(header.encode() + bomb)

    with pytest.raises(FormatError, match="more pixels than the 5 x 4 x 3"):
        read_metaimage(tmp_path / "v.mha")


@pytest.mark.parametrize("name", ["missing.mha", "folder.mha", "empty.mha"])
def test_what_is_no_file_is_said_so(tmp_path, name):
    """A path that is absent, a folder or an empty file gives a sentence."""
    (tmp_path / "folder.mha").mkdir()
    (tmp_path / "empty.mha").touch()

    with pytest.raises(FormatError, match=name):
        read_metaimage(tmp_path / name)


def test_a_pipe_is_not_waited_for(tmp_path):
    """A named pipe without writer would hang whoever opens it."""
    os.mkfifo(tmp_path / "v.mha")

    with pytest.raises(FormatError, match="is not a file"):
        read_metaimage(tmp_path / "v.mha")


def test_voxels_that_cannot_be_stored_leave_the_old_file(tmp_path):
    """A refused volume neither writes nor removes anything."""
    path = tmp_path / "v.mha"
    path.write_bytes(b"old")

    with pytest.raises(FormatError, match=r"convert them to one of float32, .*uint8"):
        write_metaimage(some_volume(IDENTITY, "complex64"), path)
    with pytest.raises(FormatError, match=r"ends with \.mha"):
        write_metaimage(some_volume(IDENTITY), tmp_path / "v.png")

    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@given(data=st.data())
def test_damaged_volumes_are_read_or_explained(tmp_path_factory, data):
    """No damage to a file gives anything but a volume or one sentence."""
    folder = tmp_path_factory.mktemp("damage")
    compress = data.draw(st.booleans())
    write_metaimage(some_volume(IDENTITY), folder / "v.mha", compress=compress)
    whole = (folder / "v.mha").read_bytes()
    (folder / "v.mha").write_bytes(data.draw(damaged(whole)))

    assert_reads_or_explains(lambda: read_metaimage(folder / "v.mha"))

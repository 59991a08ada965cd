"""Every volume format: the same voxels at the same place, and nothing half-written."""

import resource
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.volumes import read_volume, write_volume
from sonosweep.io.world import World
from sonosweep.scan import Volume, VolumeGrid, voxel_to_reference
from tests.io.damage import assert_one_sentence, assert_reads_or_explains, damaged
from tests.io.volume_files import FORMATS, itk_image, random_volume
from tests.strategies import poses

# NIfTI's header is float32: 24 bits of 200 mm, and its quaternion turns a 10 mm volume.
FLOAT32_MM = 1e-4
# DICOM's decimal strings hold 13 digits of a negative cosine; 100 mm and float64 elsewhere.
PRINTED_MM = 1e-9
PLACE_MM = {".nii": FLOAT32_MM, ".nii.gz": FLOAT32_MM}
WORLDS: tuple[World, World] = ("ras", "lps")


def reference_points(grid: VolumeGrid, indices: np.ndarray) -> np.ndarray:
    """Where voxels (x, y, z) lie in the reference, mm."""
    matrix = voxel_to_reference(grid).numpy()
    return indices @ matrix[:3, :3].T + matrix[:3, 3]


def placed_volume(seed: int, pose: Tensor) -> Volume:
    """A volume of random size, voxels and spacing whose axes are those of a pose."""
    # No strategy, because beartype draws random numbers when it checks the grid's axes.
    rng = np.random.default_rng(seed)
    # ITK takes a series of slices of one row for a single image.
    size = (int(rng.integers(1, 8)), int(rng.integers(2, 8)), int(rng.integers(2, 6)))
    return random_volume(rng, size, pose.numpy())


def random_voxels(volume: Volume, count: int = 20) -> np.ndarray:
    """Indices (x, y, z) of voxels of the volume."""
    rng = np.random.default_rng(1)
    return np.stack([rng.integers(0, n, count) for n in volume.grid.size], axis=-1)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("suffix", FORMATS)
@given(seed=st.integers(0, 2**31 - 1), pose=poses())
def test_every_format_keeps_every_voxel_in_place(
    tmp_path_factory, suffix: str, world: World, seed: int, pose: Tensor
):
    """A voxel read back has its value and lies where it lay, whichever file it went through."""
    path = tmp_path_factory.mktemp("volume") / f"volume{suffix}"
    volume = placed_volume(seed, pose)

    write_volume(volume, path, world)
    back = read_volume(path)

    indices = random_voxels(volume)
    np.testing.assert_array_equal(back.voxels, volume.voxels)
    np.testing.assert_allclose(
        reference_points(back.grid, indices),
        reference_points(volume.grid, indices),
        atol=PLACE_MM.get(suffix, PRINTED_MM),
    )


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("suffix", FORMATS)
@given(seed=st.integers(0, 2**31 - 1), pose=poses())
def test_itk_finds_every_voxel_where_the_world_rule_puts_it(
    tmp_path_factory, suffix: str, world: World, seed: int, pose: Tensor
):
    """Under "ras" ITK sees (-x, -y, z) of the reference, under "lps" (x, y, z)."""
    path = tmp_path_factory.mktemp("volume") / f"volume{suffix}"
    volume = placed_volume(seed, pose)

    write_volume(volume, path, world)
    image = itk_image(path)

    indices = random_voxels(volume)
    seen = [image.TransformContinuousIndexToPhysicalPoint(i.tolist()) for i in indices * 1.0]
    sign = [-1, -1, 1] if world == "ras" else [1, 1, 1]
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), volume.voxels)
    np.testing.assert_allclose(
        seen,
        reference_points(volume.grid, indices) * sign,
        atol=PLACE_MM.get(suffix, PRINTED_MM),
    )


@pytest.mark.parametrize("suffix", FORMATS)
def test_voxel_10_20_30_is_where_pencil_and_paper_put_it(tmp_path: Path, suffix: str):
    """Half-millimetre voxels from (1, 2, 3) on: voxel (10, 20, 30) is at (6, 12, 18)."""
    grid = VolumeGrid((11, 21, 31), (0.5, 0.5, 0.5), (1.0, 2.0, 3.0))
    volume = Volume(np.zeros((31, 21, 11), np.uint8), grid)
    seen = {}

    for world in WORLDS:
        write_volume(volume, tmp_path / world / f"volume{suffix}", world)
        image = itk_image(tmp_path / world / f"volume{suffix}")
        seen[world] = image.TransformIndexToPhysicalPoint((10, 20, 30))

    np.testing.assert_allclose(seen["ras"], (-6, -12, 18), atol=FLOAT32_MM)
    np.testing.assert_allclose(seen["lps"], (6, 12, 18), atol=FLOAT32_MM)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize("suffix", FORMATS)
def test_voxel_types_survive(tmp_path: Path, suffix: str, dtype: str):
    """What was 16 bits or real numbers comes back as that, to ITK as well."""
    volume = random_volume(np.random.default_rng(2), dtype=dtype)
    path = tmp_path / f"volume{suffix}"
    # DICOM stores no real numbers: 16-bit steps of the range, rounded to the nearest.
    step = np.ptp(volume.voxels) / 65535 if (suffix, dtype) == ("", "float32") else 0.0

    write_volume(volume, path)
    back = read_volume(path)

    assert back.voxels.dtype == volume.voxels.dtype
    np.testing.assert_allclose(back.voxels, volume.voxels, rtol=0, atol=0.51 * step)
    seen = sitk.GetArrayFromImage(itk_image(path))
    np.testing.assert_allclose(seen, volume.voxels, rtol=0, atol=0.51 * step)


@pytest.mark.parametrize("dtype", ["int8", "int32", "uint32", "int64", "float64", "bool"])
@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii.gz"])
def test_rarer_voxel_types_survive(tmp_path: Path, suffix: str, dtype: str):
    """Whatever a recording holds can become a volume; a mask becomes 0 and 1."""
    volume = random_volume(np.random.default_rng(3))
    volume = replace(volume, voxels=(volume.voxels > 99).astype(dtype))
    path = tmp_path / f"volume{suffix}"

    write_volume(volume, path)

    assert read_volume(path).voxels.dtype == ("uint8" if dtype == "bool" else dtype)
    assert np.array_equal(sitk.GetArrayFromImage(itk_image(path)), volume.voxels)


@pytest.mark.parametrize("suffix", FORMATS)
def test_color_volumes_survive(tmp_path: Path, suffix: str):
    """Three channels of 8 bits stay three channels, in their order."""
    volume = random_volume(np.random.default_rng(3), channels=3)
    path = tmp_path / f"volume{suffix}"

    write_volume(volume, path)

    np.testing.assert_array_equal(read_volume(path).voxels, volume.voxels)
    np.testing.assert_array_equal(sitk.GetArrayFromImage(itk_image(path)), volume.voxels)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_tells_its_own_world(tmp_path: Path, suffix: str):
    """A file written with "lps" is read right by someone who expects "ras"."""
    volume = random_volume(np.random.default_rng(4))
    path = tmp_path / f"volume{suffix}"

    write_volume(volume, path, "lps")

    np.testing.assert_allclose(
        read_volume(path, "ras").grid.origin_mm, volume.grid.origin_mm, atol=FLOAT32_MM
    )


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii.gz"])
def test_how_a_volume_was_made_is_kept(tmp_path: Path, suffix: str):
    """The settings are read back from the file."""
    volume = random_volume(np.random.default_rng(5))
    path = tmp_path / f"volume{suffix}"

    write_volume(volume, path)

    assert read_volume(path).settings["voxel_mm"] == "0.3"


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii", ".nii.gz"])
def test_left_handed_volumes_of_others_are_turned_in_place(tmp_path: Path, suffix: str):
    """ITK may count slices downwards; every voxel keeps its value at its place."""
    voxels = np.random.default_rng(6).integers(0, 255, (3, 4, 5), dtype=np.uint8)
    image = sitk.GetImageFromArray(voxels)
    image.SetSpacing((0.5, 0.6, 0.7))
    image.SetOrigin((1, 2, 3))
    image.SetDirection((1, 0, 0, 0, 1, 0, 0, 0, -1))
    sitk.WriteImage(image, str(tmp_path / f"volume{suffix}"))

    volume = read_volume(tmp_path / f"volume{suffix}", "lps")

    np.testing.assert_array_equal(volume.voxels, voxels[::-1])
    np.testing.assert_allclose(volume.grid.origin_mm, (1, 2, 3 - 2 * 0.7), atol=1e-6)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, suffix: str):
    """When the disk ends in the middle of the voxels, one sentence comes out and no file."""
    rng = np.random.default_rng(7)
    voxels = rng.integers(0, 255, (4, 200, 200), dtype=np.uint8)
    volume = Volume(voxels, VolumeGrid((200, 200, 4), (1.0, 1.0, 1.0)))
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.getsignal(signal.SIGXFSZ)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(FormatError) as caught:
            write_volume(volume, tmp_path / f"volume{suffix}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)

    assert_one_sentence(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", FORMATS)
def test_an_interruption_leaves_the_old_file(tmp_path: Path, suffix: str):
    """Ctrl-C half-way through writing keeps what was there before, whole."""
    path = tmp_path / f"volume{suffix}"
    old = random_volume(np.random.default_rng(8))
    write_volume(old, path)

    class Interrupted(np.ndarray):
        def __iter__(self):
            yield np.asarray(self[0])
            raise KeyboardInterrupt

        def __array_finalize__(self, obj):
            pass

        @property
        def T(self):
            raise KeyboardInterrupt

    new = Volume(old.voxels.view(Interrupted), old.grid)
    with pytest.raises(KeyboardInterrupt):
        write_volume(new, path)

    np.testing.assert_array_equal(read_volume(path).voxels, old.voxels)
    assert [child.name for child in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_place_that_cannot_be_written_is_said(tmp_path: Path, suffix: str):
    """A file where the folder should be gives one sentence that names the target."""
    (tmp_path / "in the way").write_text("")
    volume = random_volume(np.random.default_rng(9))

    with pytest.raises(FormatError, match="in the way") as caught:
        write_volume(volume, tmp_path / "in the way" / f"volume{suffix}")

    assert_one_sentence(caught.value)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("dtype", ["complex64", "float16"])
def test_types_without_a_place_are_refused(tmp_path: Path, suffix: str, dtype: str):
    """Complex and half-precision voxels are refused by name instead of changed."""
    volume = Volume(np.zeros((2, 2, 2), dtype), VolumeGrid((2, 2, 2), (1.0, 1.0, 1.0)))

    with pytest.raises(FormatError, match=dtype):
        write_volume(volume, tmp_path / f"volume{suffix}")

    assert list(tmp_path.iterdir()) == []


def test_unknown_suffixes_list_the_known(tmp_path: Path):
    """Someone who writes .stl is told what there is."""
    volume = random_volume(np.random.default_rng(10))
    (tmp_path / "volume.stl").write_text("solid")

    with pytest.raises(FormatError, match=r"\.nrrd, \.mha, \.nii"):
        write_volume(volume, tmp_path / "other.stl")
    with pytest.raises(FormatError, match=r"\.nrrd, \.mha, \.nii"):
        read_volume(tmp_path / "volume.stl")
    with pytest.raises(FormatError, match="there is no"):
        read_volume(tmp_path / "missing.nrrd")


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory) -> dict[str, bytes]:
    """One good file of each format; of the DICOM series, its first slice."""
    folder = tmp_path_factory.mktemp("whole")
    volume = random_volume(np.random.default_rng(11), size=(9, 8, 3))
    files = {}
    for suffix in FORMATS:
        path = folder / f"volume{suffix}"
        write_volume(volume, path)
        files[suffix] = (path / "slice_00000.dcm" if path.is_dir() else path).read_bytes()
    return files


@pytest.mark.parametrize("suffix", [".nrrd", ".nii", ".nii.gz", ""])
@given(data=st.data())
def test_damaged_files_are_explained(tmp_path_factory, whole_files, suffix: str, data):
    """Cut, flipped or random bytes give a volume or one sentence, never anything else."""
    path = tmp_path_factory.mktemp("damaged") / f"volume{suffix}"
    broken = data.draw(damaged(whole_files[suffix]))
    if suffix:
        path.write_bytes(broken)
    else:
        path.mkdir()
        (path / "slice_00000.dcm").write_bytes(broken)

    assert_reads_or_explains(lambda: read_volume(path))


@pytest.mark.parametrize("suffix", [".nrrd", ".nii", ".nii.gz"])
def test_every_cut_is_noticed(tmp_path: Path, whole_files, suffix: str):
    """A file that lost even its last bytes of voxels is refused, not filled up."""
    whole = whole_files[suffix]
    path = tmp_path / f"volume{suffix}"

    for length in range(0, len(whole) - 8, 7):
        path.write_bytes(whole[:length])
        with pytest.raises(SonosweepError) as caught:
            read_volume(path)
        assert_one_sentence(caught.value)

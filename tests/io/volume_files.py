"""Volumes to write, and what another program finds in the files."""

from pathlib import Path

import numpy as np
import SimpleITK as sitk

from sonosweep.scan import Volume, VolumeGrid

FORMATS = (".nrrd", ".mha", ".nii", ".nii.gz", "")  # no suffix is a folder of DICOM slices


def random_volume(
    rng: np.random.Generator,
    size: tuple[int, int, int] = (7, 6, 5),
    pose: np.ndarray | None = None,
    dtype: str = "uint8",
    channels: int = 0,
) -> Volume:
    """Random voxels on a grid whose axes and origin are those of a pose."""
    matrix = np.eye(4) if pose is None else pose
    shape = size[::-1] + ((channels,) if channels else ())
    voxels = rng.integers(0, 101, shape).astype(dtype)
    if np.issubdtype(voxels.dtype, np.floating):
        voxels = rng.normal(size=shape).astype(dtype)
    spacing = tuple(float(s) for s in rng.uniform(0.1, 1.5, 3).round(4))
    grid = VolumeGrid(
        size=size,
        spacing_mm=(spacing[0], spacing[1], spacing[2]),
        origin_mm=(float(matrix[0, 3]), float(matrix[1, 3]), float(matrix[2, 3])),
        direction=tuple((float(a), float(b), float(c)) for a, b, c in matrix[:3, :3]),
    )
    return Volume(voxels=voxels, grid=grid, settings={"voxel_mm": "0.3"})


def itk_image(path: Path) -> sitk.Image:
    """The file, or the series in the folder, as ITK reads it."""
    if not path.is_dir():
        return sitk.ReadImage(str(path))
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(path)))
    return reader.Execute()

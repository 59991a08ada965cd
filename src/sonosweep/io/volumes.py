"""The one place that looks at a volume's path and decides on its format."""

import os
from pathlib import Path
from typing import Literal

from sonosweep.errors import FormatError
from sonosweep.io.world import World
from sonosweep.scan import Volume

KNOWN = ".nrrd, .mha, .nii, .nii.gz, or a folder for a DICOM series"


def read_volume(path: str | os.PathLike, world: World = "ras") -> Volume:
    """Return the volume in a file, or in a folder that holds a DICOM series.

    Args:
        path: ``.nrrd``, ``.nhdr``, ``.mha``, ``.mhd``, ``.nii``, ``.nii.gz`` or a folder.
        world: How to read the coordinates of a file that does not tell itself; files that
            we wrote do. PLUS's volumes need ``"lps"``.

    Raises:
        FormatError: If the file is missing, of no known format, or broken.
    """
    file = Path(path)
    if not file.exists():
        raise FormatError(f"there is no '{file}'")
    if file.is_dir():
        from sonosweep.io.dicom_volume import read_dicom_volume

        return read_dicom_volume(file, world)
    if _is_nifti(file):
        from sonosweep.io.nifti import read_nifti

        return read_nifti(file, world)
    suffix = file.suffix.lower()
    if suffix in (".nrrd", ".nhdr"):
        from sonosweep.io.nrrd import read_nrrd

        return read_nrrd(file, world)
    if suffix in (".mha", ".mhd"):
        from sonosweep.io.metaimage import read_metaimage

        return read_metaimage(file, world)
    raise FormatError(f"'{file.name}' is no volume that we know; known are {KNOWN}")


def write_volume(
    volume: Volume,
    path: str | os.PathLike,
    world: World = "ras",
    dicom_modality: Literal["US", "OT"] = "US",
) -> None:
    """Write the voxels of a volume in the format that the suffix names.

    The coverage is a volume of its own: write it to a file of its own.

    Args:
        volume: What to write.
        path: ``.nrrd``, ``.mha``, ``.nii``, ``.nii.gz``, or no suffix for a folder with a
            DICOM series.
        world: How our reference is stated in the file's patient axes.
        dicom_modality: What the DICOM series calls itself.

    Raises:
        FormatError: If the suffix is not known, the format cannot hold the voxels, or the
            file cannot be written.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if _is_nifti(file):
        from sonosweep.io.nifti import write_nifti

        write_nifti(volume, file, world)
    elif suffix == ".nrrd":
        from sonosweep.io.nrrd import write_nrrd

        write_nrrd(volume, file, world)
    elif suffix == ".mha":
        from sonosweep.io.metaimage import write_metaimage

        write_metaimage(volume, file, world)
    elif not suffix or file.is_dir():
        from sonosweep.io.dicom_volume import write_dicom_volume

        write_dicom_volume(volume, file, world, dicom_modality)
    else:
        raise FormatError(f"cannot write a volume as '{file.name}'; known are {KNOWN}")


def _is_nifti(file: Path) -> bool:
    return file.name.lower().endswith((".nii", ".nii.gz"))

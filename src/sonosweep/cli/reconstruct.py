"""``sonosweep reconstruct``: the main job."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from sonosweep.cli.inputs import OUTPUT, Force, InputOptions, Json
from sonosweep.cli.motion import MotionOptions
from sonosweep.cli.photoacoustic_options import PhotoacousticOptions
from sonosweep.cli.volume_options import VolumeOptions


def reconstruct(
    scans: Annotated[list[Path], Parameter(negative="")],
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], group=OUTPUT)],
    motion: MotionOptions | None = None,
    volume: VolumeOptions | None = None,
    photoacoustic: PhotoacousticOptions | None = None,
    inputs: InputOptions | None = None,
    world: Annotated[Literal["ras", "lps"] | None, Parameter(group=OUTPUT)] = None,
    volume_format: Annotated[
        Literal["nrrd", "mha", "nii.gz", "dicom"], Parameter(group=OUTPUT)
    ] = "nrrd",
    maps: Annotated[bool, Parameter(negative="", group=OUTPUT)] = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Turn sweeps into trajectories, volumes and a report.

    Writes volume.nrrd, coverage.nrrd, trajectory.csv, trajectory.mrk.json, report.html,
    summary.json and open_in_slicer.py, for each companion volume_NAME.nrrd, and for power
    Doppler and photoacoustics vessels_NAME.png. With several scans, each gets a folder of
    its own.

    Args:
        scans: Files or folders of sweeps.
        output: Folder to write.
        world: How volumes state coordinates, see the conventions page: ras otherwise, but
            lps where a PLUS configuration asks for a MetaImage, as PLUS writes it.
        volume_format: Format of the volumes.
        maps: With a network that has them, write its attention and correlation of every step
            (maps.h5) and a picture of a slow, a usual and a fast one (maps.png).
    """
    from sonosweep.cli.job import Job, run_job
    from sonosweep.cli.output import say, whole_folder
    from sonosweep.errors import ScanError

    job = Job(
        motion=motion or MotionOptions(),
        volume=volume or VolumeOptions(),
        photoacoustic=photoacoustic or PhotoacousticOptions(),
        inputs=inputs or InputOptions(),
        world=world,
        volume_format=volume_format,
        maps=maps,
    )
    names = [_name(path) for path in scans]
    if len(set(names)) < len(names):
        raise ScanError("two of the scans have the same name: reconstruct them one by one")
    for path, name in zip(scans, names, strict=True):
        folder = output if len(scans) == 1 else output / name
        with whole_folder(folder, force) as temporary:
            result = run_job(path, temporary, job)
        say(f"{result.line} -> {folder}", {**result.summary, "output": str(folder)}, json)


def _name(path: Path) -> str:
    """Return a file's name without its suffixes, ``sweep`` for ``sweep.igs.mha``."""
    name = path.resolve().name
    return name.split(".")[0] or name

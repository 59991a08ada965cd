"""``sonosweep estimate``: a trajectory, without a volume."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from sonosweep.cli.inputs import OUTPUT, Force, InputOptions, Json, read
from sonosweep.cli.motion import MotionOptions


def estimate(
    scan: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], group=OUTPUT)],
    motion: MotionOptions | None = None,
    inputs: InputOptions | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Estimate the trajectory of a sweep from its frames alone.

    Args:
        scan: File or folder of the sweep.
        output: Where to write: .csv, .txt (TUM), .igs.mha, .tfm or .mrk.json.
    """
    from sonosweep.cli.info import image_center_mm, path_length_mm
    from sonosweep.cli.motion import find_trajectory
    from sonosweep.cli.output import check_free, say
    from sonosweep.io import write_trajectory
    from sonosweep.io.trajectories import check_name

    check_name(output)
    check_free(output, force)
    recorded, trajectory = find_trajectory(read(scan, inputs), motion or MotionOptions())
    write_trajectory(trajectory, output, point_mm=image_center_mm(recorded))
    length = path_length_mm(recorded, trajectory.image_to_reference)
    frames = len(trajectory.image_to_reference)
    say(
        f"{recorded.name}: {frames} frames, {length:.1f} mm, {trajectory.method} -> {output}",
        {
            "scan": recorded.name,
            "frames": frames,
            "path_length_mm": length,
            "method": trajectory.method,
            "assumptions": trajectory.assumptions,
            "output": output,
        },
        json,
    )

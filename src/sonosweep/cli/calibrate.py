"""``sonosweep calibrate``: the decorrelation curve of a probe and preset."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from sonosweep.cli.inputs import OUTPUT, Force, InputOptions, Json, read


def calibrate(
    scan: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], group=OUTPUT)],
    length_mm: float | None = None,
    inputs: InputOptions | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Measure how fast speckle decorrelates with elevational motion.

    Do it once per probe and preset; `estimate` and `reconstruct` take the file as
    --calibration. A tracked sweep is best; one sweep along a ruler is enough.

    Args:
        scan: A tracked sweep, or with --length-mm any sweep in one direction.
        output: Where to write the curve (.toml).
        length_mm: How far the probe went, measured with a ruler.
    """
    from sonosweep import estimators
    from sonosweep.cli.output import check_free, say
    from sonosweep.scan import locate_image

    check_free(output, force)
    recorded = locate_image(read(scan, inputs))
    curve = estimators.calibrate(recorded, length_mm=length_mm)
    estimators.write_curve(curve, output)
    source = "tracked poses" if length_mm is None else f"a length of {length_mm:g} mm"
    widths = " to ".join(
        f"{width:.2g}" for width in sorted({min(curve.width_mm), max(curve.width_mm)})
    )
    say(
        f"{recorded.name}: decorrelation curve from {source}, width {widths} mm -> {output}",
        {
            "scan": recorded.name,
            "source": source,
            "depth_mm": curve.depth_mm,
            "width_mm": curve.width_mm,
            "quality": curve.quality,
            "output": output,
        },
        json,
    )

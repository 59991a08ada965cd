"""One scan of a data set, made from its plan."""

from sonosweep.scan import Scan, select_frames
from sonosweep.simulate.bodies import named_body
from sonosweep.simulate.body import Body
from sonosweep.simulate.datasets import PlannedScan
from sonosweep.simulate.random_sweep import draw_sweep
from sonosweep.simulate.sweep import simulate_sweep
from sonosweep.simulate.tracker import TrackerSettings

PHANTOM_MARGIN_MM = 50.0


def planned_body(plan: PlannedScan) -> Body:
    """Return what the plan scans.

    Raises:
        ScanError: If there is no such body.
    """
    length_mm = plan.motion.length_mm + PHANTOM_MARGIN_MM
    return named_body(plan.body, plan.subject, plan.side, length_mm)


def simulate_planned(plan: PlannedScan, body: Body, tracker: TrackerSettings | None = None) -> Scan:
    """Return the planned scan; its frames are rendered when they are read.

    Args:
        plan: Which scan of a data set.
        body: Of :func:`planned_body`.
        tracker: What sees the poses; ``None`` gives the truth.

    Raises:
        ScanError: If the plan cannot be carried out.
    """
    settings = draw_sweep(
        plan.subject,
        plan.scan,
        plan.motion,
        probe=plan.probe,
        pixels=plan.pixels,
        modalities=plan.modalities,
        tracker=tracker,
        scanner=plan.scanner,
    )
    scan = simulate_sweep(settings, body)
    if plan.stretch is None:
        return scan
    first, count = plan.stretch
    return select_frames(scan, range(first, first + count))

"""How good a trajectory or a volume is: functions that return numbers."""

from sonosweep.metrics.frame_points import frame_grid, frame_quadrature, pixel_quadrature
from sonosweep.metrics.trajectory import (
    PAPER_EULER_ORDER,
    TrajectoryMetrics,
    align_first_frame,
    drift_per_frame,
    evaluate_trajectory,
)
from sonosweep.metrics.tusrec import (
    TusrecErrors,
    displacement_fields,
    landmark_displacements,
    tusrec_errors,
    tusrec_score,
)
from sonosweep.metrics.volume import VolumeMetrics, compare_volumes

__all__ = [
    "PAPER_EULER_ORDER",
    "TrajectoryMetrics",
    "TusrecErrors",
    "VolumeMetrics",
    "align_first_frame",
    "compare_volumes",
    "displacement_fields",
    "drift_per_frame",
    "evaluate_trajectory",
    "frame_grid",
    "frame_quadrature",
    "landmark_displacements",
    "pixel_quadrature",
    "tusrec_errors",
    "tusrec_score",
]

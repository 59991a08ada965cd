"""How good a trajectory, a volume or an image is: functions that return numbers."""

from sonosweep.metrics.frame_points import frame_grid, frame_quadrature, pixel_quadrature
from sonosweep.metrics.image import (
    PointResolution,
    contrast_db,
    contrast_to_noise,
    full_width_half_maximum,
    normalized_variance,
    point_resolution,
    speckle_snr,
)
from sonosweep.metrics.step_correlation import step_correlation
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
    "PointResolution",
    "TrajectoryMetrics",
    "TusrecErrors",
    "VolumeMetrics",
    "align_first_frame",
    "compare_volumes",
    "contrast_db",
    "contrast_to_noise",
    "displacement_fields",
    "drift_per_frame",
    "evaluate_trajectory",
    "frame_grid",
    "frame_quadrature",
    "full_width_half_maximum",
    "landmark_displacements",
    "normalized_variance",
    "pixel_quadrature",
    "point_resolution",
    "speckle_snr",
    "step_correlation",
    "tusrec_errors",
    "tusrec_score",
]

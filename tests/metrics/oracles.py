"""The metrics written with loops, one pixel and one frame at a time."""

import math

import numpy as np
from scipy.spatial.transform import Rotation


def slow_metrics(estimated, true, points):
    """The paper's numbers, from matrices given as nested arrays."""
    a = [np.linalg.inv(estimated[0]) @ pose for pose in estimated]
    b = [np.linalg.inv(true[0]) @ pose for pose in true]
    steps_a = [np.linalg.inv(a[i]) @ a[i + 1] for i in range(len(a) - 1)]
    steps_b = [np.linalg.inv(b[i]) @ b[i + 1] for i in range(len(b) - 1)]
    center = np.mean(points, axis=0)
    path = [(pose @ [*center, 1])[:3] for pose in b]
    length = sum(math.dist(path[i], path[i + 1]) for i in range(len(path) - 1))
    drift = [_distance(x, y, points) for x, y in zip(a, b, strict=True)]
    result = {
        "accumulated_frame_error_mm": sum(drift[1:]) / (len(drift) - 1),
        "final_drift_mm": drift[-1],
        "maximum_drift_mm": max(drift),
        "median_drift_mm": float(np.median(drift[1:])),
        "final_drift_rate_path_percent": 100 * drift[-1] / length,
        "final_drift_rate_chord_percent": 100 * drift[-1] / math.dist(path[0], path[-1]),
        "path_length_mm": length,
        "relative_frame_error_mm": np.mean(
            [_distance(x, y, points) for x, y in zip(steps_a, steps_b, strict=True)]
        ),
    }
    for name, x, y in (("relative", steps_a, steps_b), ("accumulated", a[1:], b[1:])):
        mm = [abs(p[k, 3] - q[k, 3]) for p, q in zip(x, y, strict=True) for k in range(3)]
        deg = [d for p, q in zip(x, y, strict=True) for d in _angle_differences(p, q)]
        turn = [
            math.degrees(Rotation.from_matrix(p[:3, :3].T @ q[:3, :3]).magnitude())
            for p, q in zip(x, y, strict=True)
        ]
        result[f"{name}_error_mm"] = np.mean(mm)
        result[f"{name}_error_deg"] = np.mean(deg)
        result[f"{name}_error_mixed"] = np.mean(mm + deg)
        result[f"{name}_angle_deg"] = np.mean(turn)
    cosines = []
    for point in points:
        p = np.array([(pose @ [*point, 1])[:3] for pose in a])
        q = np.array([(pose @ [*point, 1])[:3] for pose in b])
        for k in range(3):
            cosines.append(
                np.dot(p[:, k], q[:, k]) / (np.linalg.norm(p[:, k]) * np.linalg.norm(q[:, k]))
            )
    result["correlation_cosine"] = np.mean(cosines)
    return result


def _angle_differences(p, q):
    """The 'YZX' angles of the released code's axes (rows, columns, row x column)."""
    swap = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    angles = [
        Rotation.from_matrix(swap @ m[:3, :3] @ swap.T).as_euler("YZX", degrees=True)
        for m in (p, q)
    ]
    differences = []
    for x, y in zip(*angles, strict=True):
        d = abs(x - y)
        differences.append(min(d, 360 - d))
    return differences


def _distance(a, b, points):
    total = 0.0
    for point in points:
        total += math.dist((a @ [*point, 1])[:3], (b @ [*point, 1])[:3])
    return total / len(points)

"""A TUS-REC scan on the command line, against the challenge's formulas on the raw file."""

import json

import h5py
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sonosweep.io import write_trajectory
from sonosweep.scan import Trajectory

FRAMES, ROWS, COLUMNS = 5, 24, 32
S = np.diag([0.23, 0.22, 1.0, 1.0])
C = np.eye(4)
C[:3, :3] = Rotation.from_euler("xyz", [0.3, -1.2, 0.4]).as_matrix()
C[:3, 3] = [-70, -80, -46]
TITLES = (
    "scaling_from_pixel_to_mm",
    "spatial_calibration_from_image_coordinate_system_to_tracking_tool_coordinate_system",
)
SINGLE_PRECISION_MM = 1e-4  # the file holds float32 poses some 100 mm from the camera


def tool_poses(seed: int) -> np.ndarray:
    """Poses of the tool that wander, in the precision of the files."""
    generator = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    turns = generator.normal(0, 0.1, (FRAMES, 3))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = generator.normal(0, 5, (FRAMES, 3))
    return poses.astype(np.float32).astype(np.float64)


def challenge_errors(true, estimated, landmarks) -> dict[str, float]:
    """GPE, GLE, LPE and LLE as the challenge writes them: every pixel, counted from 1."""
    column, row = np.meshgrid(np.arange(1, COLUMNS + 1), np.arange(1, ROWS + 1))
    ones = np.ones(column.size)
    pixels = S @ np.stack([column.ravel(), row.ravel(), 0 * ones, ones])
    count = len(landmarks)
    places = S @ np.column_stack([landmarks[:, 1:], np.zeros(count), np.ones(count)]).T
    errors = {}
    for scope, before in (("global", lambda _: 0), ("local", lambda i: i - 1)):
        gap = np.stack(
            [
                np.linalg.inv(C)
                @ (
                    np.linalg.inv(true[before(i)]) @ true[i]
                    - np.linalg.inv(estimated[before(i)]) @ estimated[i]
                )
                @ C
                for i in range(1, FRAMES)
            ]
        )
        at_pixels = np.linalg.norm((gap @ pixels)[:, :3], axis=1)
        at_landmarks = [
            np.linalg.norm((gap[frame - 1] @ place)[:3])
            for frame, place in zip(landmarks[:, 0], places.T, strict=True)
        ]
        errors[f"{scope}_pixel_error_mm"] = at_pixels.mean()
        errors[f"{scope}_landmark_error_mm"] = np.mean(at_landmarks)
    return errors


@pytest.fixture
def landmarks() -> np.ndarray:
    """Rows of (frame from 0, column from 1, row from 1), the image's corners among them."""
    return np.array([[1, 1, 1], [4, COLUMNS, ROWS], [2, 7, 3]])


@pytest.fixture
def data_set(tmp_path, landmarks):
    """The training layout with one scan; returns the scan's file."""
    scan = tmp_path / "frames_transfs" / "000" / "LH_Par_C_DtP.h5"
    scan.parent.mkdir(parents=True)
    pixels = np.random.default_rng(3).integers(0, 255, (FRAMES, ROWS, COLUMNS), dtype=np.uint8)
    with h5py.File(scan, "w") as file:
        file["frames"], file["tforms"] = pixels, tool_poses(1).astype(np.float32)
    (tmp_path / "landmarks").mkdir()
    with h5py.File(tmp_path / "landmarks" / "landmark_000.h5", "w") as file:
        file[scan.stem] = landmarks
    rows = []
    for title, matrix in zip(TITLES, (S, C), strict=True):
        rows += [title, *(",".join(map(repr, map(float, row))) for row in matrix)]
    (tmp_path / "calib_matrix.csv").write_bytes("\r\n".join([*rows, ""]).encode())
    return scan


def test_evaluate_gives_the_challenge_s_four_errors(run, data_set, landmarks, tmp_path):
    """GPE, GLE, LPE and LLE from the command line are those of the challenge's formulas."""
    first_pixel = np.eye(4)  # our image coordinates start at the challenge's pixel (1, 1)
    first_pixel[:3, 3] = (S @ [1, 1, 0, 0])[:3]
    estimate = Trajectory(torch.from_numpy(tool_poses(2) @ C @ first_pixel))
    write_trajectory(estimate, tmp_path / "estimate.csv")

    ran = run("evaluate", tmp_path / "estimate.csv", data_set, "--json")

    assert ran.code == 0, ran.error
    found = json.loads(ran.out)
    for name, expected in challenge_errors(tool_poses(1), tool_poses(2), landmarks).items():
        assert found[name] == pytest.approx(expected, abs=SINGLE_PRECISION_MM), name


def test_without_landmarks_the_pixel_errors_remain(run, data_set, tmp_path):
    """A set without its landmark file, or with one that lacks the scan, has no GLE and LLE."""
    write_trajectory(Trajectory(torch.from_numpy(tool_poses(2))), tmp_path / "estimate.csv")
    file = tmp_path / "landmarks" / "landmark_000.h5"
    with h5py.File(file, "a") as opened:
        opened.move(data_set.stem, "another_scan")

    for _ in range(2):
        ran = run("evaluate", tmp_path / "estimate.csv", data_set, "--json")
        assert ran.code == 0, ran.error
        assert json.loads(ran.out)["global_landmark_error_mm"] is None
        file.unlink(missing_ok=True)

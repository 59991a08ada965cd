"""The picture of what a network looks at."""

import numpy as np
from PIL import Image

from sonosweep.estimators.step_maps import StepMaps
from sonosweep.view.map_picture import GAP, LABEL, PANEL, TOP, write_map_picture


def _panel(picture: np.ndarray, row: int, column: int) -> np.ndarray:
    top, left = TOP + row * (PANEL + LABEL + GAP), GAP + column * (PANEL + GAP)
    return picture[top : top + PANEL, left : left + PANEL].astype(int)


def test_bright_is_where_the_numbers_are_large(tmp_path):
    """Attention colours its corner; the two correlations share one scale."""
    attention = np.zeros((4, 4), np.float32)
    attention[0, 3] = 1
    strong, weak = np.full((5, 5), 0.2, np.float32), np.full((5, 5), 0.2, np.float32)
    strong[2, 2], weak[2, 2] = 1.0, 0.4
    step = StepMaps("a step", np.full((60, 60), 90, np.uint8), (0.3, 0.3), attention, strong, weak)

    write_map_picture(tmp_path / "maps.png", [step, step])

    picture = np.asarray(Image.open(tmp_path / "maps.png"))
    assert picture.shape == (TOP + 2 * (PANEL + LABEL + GAP), GAP + 4 * (PANEL + GAP), 3)
    over = _panel(picture, 1, 1)
    assert over[20, -20, 0] > over[-20, 20, 0] + 40
    middle = PANEL // 2
    bright, dim = (_panel(picture, 1, k)[middle, middle].sum() for k in (2, 3))
    assert bright > 2 * dim > 0


def test_without_correlation_there_are_two_columns(tmp_path):
    """Pixels that are deeper than wide become square."""
    frame = np.full((30, 60), 200, np.uint8)
    step = StepMaps("a step", frame, (0.3, 0.6), np.eye(2, dtype=np.float32))

    write_map_picture(tmp_path / "maps.png", [step])

    picture = np.asarray(Image.open(tmp_path / "maps.png"))
    assert picture.shape[1] == GAP + 2 * (PANEL + GAP)
    lit = _panel(picture, 0, 0).min(-1) > 150
    assert abs(int(lit.any(1).sum()) - int(lit.any(0).sum())) <= 1

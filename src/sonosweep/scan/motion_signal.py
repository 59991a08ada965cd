"""One number per frame and per tracker sample that tells where the probe was.

Two clocks are compared by a movement that both saw: in the image the depth of a flat echo,
in the tracker the way along the direction in which the probe moved most.
"""

import numpy as np
import torch
from jaxtyping import Float, Num
from scipy import ndimage
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.scan.frames import Frames, FrameView

# A column whose brightest echo is below this share of the frame's bright ones has no line.
ECHO_SHARE = 0.25
# A column's echo belongs to the line if it is this near, in pixels.
LINE_WIDTH_PX = 4.0
# Lines through every two of this many echoes are tried.
TRIED_ECHOES = 24
# A frame has a line if this share of its echoes, by brightness, lies on it.
LINE_SHARE = 0.5


def image_motion_signal(frames: Frames) -> Float[Tensor, " frames"]:
    """Return the depth (rows) of the brightest line in each frame, NaN where there is none.

    In each column the brightest echo is found to a fraction of a pixel; of all straight
    lines the one with most of them near it is taken, so that reverberations and specks do
    not pull. The depth is taken in one column for all frames, the middle of the brightness
    of all of them.

    Args:
        frames: Gray or colour, read one at a time.
    """
    gray = FrameView(frames, gray=True)
    echoes = [_brightest_echoes(np.asarray(gray[i], dtype=np.float32)) for i in range(len(gray))]
    if not echoes:
        return torch.zeros(0, dtype=torch.float64)
    brightness = np.sum([weight for _, weight in echoes], axis=0)
    if not brightness.sum() > 0:
        return torch.full((len(echoes),), torch.nan, dtype=torch.float64)
    column = float(np.average(np.arange(len(brightness)), weights=brightness))
    depths = [_depth_of_line(depth, weight, column) for depth, weight in echoes]
    return torch.tensor(depths, dtype=torch.float64)


def tracker_motion_signal(
    probe_to_reference: Float[Tensor, "samples 4 4"],
) -> Float[Tensor, " samples"]:
    """Return the position (mm) along the direction in which the probe moved most.

    Which way along it counts as up is arbitrary (the largest coordinate of the direction
    is taken as positive).

    Raises:
        ScanError: If the probe does not move.
    """
    position = probe_to_reference[:, :3, 3].double()
    position = position - position.mean(0)
    _, size, directions = torch.linalg.svd(position, full_matrices=False)
    if not float(size[0]) > 0:
        raise ScanError("the tracked probe does not move: there is nothing to match in time")
    direction = directions[0]
    return position @ (direction * torch.sign(direction[direction.abs().argmax()]))


def _brightest_echoes(
    frame: Num[np.ndarray, "rows columns"],
) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " columns"]]:
    """Return the depth (rows) of the brightest echo of each column, and its brightness."""
    smooth = ndimage.gaussian_filter1d(frame, 2.0, axis=0)
    row, column = smooth.argmax(axis=0), np.arange(frame.shape[1])
    inner = row.clip(1, max(len(frame) - 2, 1)) if len(frame) > 2 else row
    bright = smooth.max(axis=0).astype(np.float64)
    depth = row.astype(np.float64)
    if len(frame) > 2:
        above, at, below = (smooth[inner + k, column].astype(np.float64) for k in (-1, 0, 1))
        curvature = above - 2 * at + below
        curved = curvature < 0
        shift = np.where(curved, 0.5 * (above - below) / np.where(curved, curvature, 1), 0)
        depth = inner + shift.clip(-1, 1)
    background = np.median(smooth, axis=0)
    contrast = bright - background
    contrast[contrast < ECHO_SHARE * contrast.max()] = 0
    return depth, contrast


def _depth_of_line(depth: np.ndarray, weight: np.ndarray, column: float) -> float:
    """Return where the line that most echoes lie on crosses a column; NaN if too few do.

    Every line through two of some twenty echoes is tried, and the one with most brightness
    near it is fitted to the echoes near it: a second echo at one end cannot tilt it.
    """
    place = np.flatnonzero(weight > 0)
    if len(place) < 2:
        return float("nan")
    x, y, weight = place - column, depth[place], weight[place]
    tried = np.unique(np.linspace(0, len(x) - 1, TRIED_ECHOES).astype(int))
    first, second = (tried[index] for index in np.triu_indices(len(tried), 1))
    slope = (y[second] - y[first]) / (x[second] - x[first])
    at_column = y[first] - slope * x[first]
    distance = np.abs(y - at_column[:, None] - slope[:, None] * x)
    best = int(((distance < LINE_WIDTH_PX) @ weight).argmax())
    near = distance[best] < LINE_WIDTH_PX
    for _ in range(3):
        tilt, middle = np.polyfit(x[near], y[near], 1, w=np.sqrt(weight[near]))
        again = np.abs(y - middle - tilt * x) < LINE_WIDTH_PX
        near = again if np.count_nonzero(again) > 1 else near
    on_line = float(weight[near].sum() / weight.sum())
    return float(middle) if on_line >= LINE_SHARE else float("nan")

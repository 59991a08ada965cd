"""Some of the frames of a scan."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from sonosweep.errors import ScanError
from sonosweep.scan.frames import FrameView
from sonosweep.scan.scan import Scan


def select_frames(scan: Scan, indices: Sequence[int] | np.ndarray) -> Scan:
    """Return the scan with only the frames of ``indices``, in that order.

    Args:
        scan: What was recorded.
        indices: Frame numbers from 0, each once, increasing.

    Raises:
        ScanError: If there is none, or one lies outside the scan.
    """
    chosen = np.asarray(indices, dtype=np.int64)
    if len(chosen) == 0:
        raise ScanError(f"no frame of '{scan.name}' is left")
    if chosen.min() < 0 or chosen.max() >= len(scan.frames):
        raise ScanError(f"'{scan.name}' has frames 0 to {len(scan.frames) - 1}, not {chosen.max()}")
    rows = torch.from_numpy(chosen)
    return replace(
        scan,
        frames=FrameView(scan.frames, chosen),
        timestamps_s=None if scan.timestamps_s is None else scan.timestamps_s[rows],
        image_to_reference=(
            None if scan.image_to_reference is None else scan.image_to_reference[rows]
        ),
        tracked=None if scan.tracked is None else scan.tracked[rows],
        companions={
            name: replace(companion, frames=FrameView(companion.frames, chosen))
            for name, companion in scan.companions.items()
        },
    )


def select_tracked(scan: Scan) -> Scan:
    """Return the scan with only the frames whose pose the tracker saw.

    Raises:
        ScanError: If the scan has no poses, or none of them is valid.
    """
    if scan.image_to_reference is None:
        reason = scan.notes.get("poses", "the file holds none")
        raise ScanError(f"'{scan.name}' has no tracked poses: {reason}")
    if scan.tracked is None or bool(scan.tracked.all()):
        return scan
    if not bool(scan.tracked.any()):
        raise ScanError(f"the tracker saw the probe in no frame of '{scan.name}'")
    return select_frames(scan, scan.tracked.nonzero()[:, 0].numpy())

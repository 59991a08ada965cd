"""A simple arm to move a probe over."""

import numpy as np

from sonosweep.simulate import Body, Tissue


def arm(length_mm: float = 250.0, width_mm: float = 80.0) -> Body:
    """Return an arm of muscle whose round, tapering skin begins some 4 mm below y = 0."""
    spacing = 1.0
    z, y, x = (int(size / spacing) + 1 for size in (length_mm, 20.0, width_mm))
    across = spacing * np.arange(x) - width_mm / 2
    skin = 4 + (across / 12) ** 2 + 0.02 * spacing * np.arange(z)[:, None]
    shape = (z, y, x)
    return Body(
        name="arm",
        subject="simulated-900000",
        tissue=np.full(shape, Tissue.MUSCLE, np.uint8),
        echogenicity=np.full(shape, 200, np.uint8),
        spacing_mm=spacing,
        origin_mm=(-width_mm / 2, 0.0, 0.0),
        skin_depth_mm=skin.astype(np.float32),
    )

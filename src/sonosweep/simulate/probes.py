"""Probes that can be had."""

import torch

from sonosweep.scan import Probe


def linear_probe(
    name: str,
    elements: int,
    pitch_mm: float,
    element_width_mm: float,
    center_frequency_hz: float,
    elevation_aperture_mm: float | None = None,
    elevation_focus_mm: float | None = None,
) -> Probe:
    """Return a linear array: elements in a row along the lateral axis about its middle."""
    positions = torch.zeros(elements, 3, dtype=torch.float64)
    positions[:, 0] = pitch_mm * (torch.arange(elements) - (elements - 1) / 2)
    return Probe(
        name,
        positions,
        element_width_mm,
        center_frequency_hz,
        elevation_aperture_mm,
        elevation_focus_mm,
    )


def linear_probe_l11_5v(elements: int = 128) -> Probe:
    """Return Verasonics' L11-5v, which the paper used, or the middle elements of one."""
    return linear_probe("L11-5v", elements, 0.3, 0.27, 7.6e6, 5.0, 18.0)

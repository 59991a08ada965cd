"""A simulated sweep as a scan: frames on demand, and where the probe truly was."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from sonosweep.geometry import pose_from_parts
from sonosweep.scan import Calibration, Companion, LazyFrames, Region, Scan
from sonosweep.simulate.body import Body
from sonosweep.simulate.echoes import SweepEchoes
from sonosweep.simulate.forearm import forearm
from sonosweep.simulate.seeds import subject_name
from sonosweep.simulate.sweep_frames import (
    AmplitudeFrames,
    BModeFrames,
    IQFrames,
    PhotoacousticFrames,
    PowerDopplerFrames,
)
from sonosweep.simulate.sweep_settings import SweepSettings, settings_text
from sonosweep.simulate.tracker import track_frames

FRAMES_OF: dict[str, type[LazyFrames]] = {
    "amplitude": AmplitudeFrames,
    "iq": IQFrames,
    "power_doppler": PowerDopplerFrames,
    "photoacoustic": PhotoacousticFrames,
}


def simulate_sweep(
    settings: SweepSettings,
    body: Body | None = None,
    *,
    engine: Literal["numba", "torch"] = "numba",
    device: str = "cpu",
) -> Scan:
    """Return a sweep over a body; each frame is rendered when it is read, in any order.

    Poses are ``image_to_reference``, body coordinates being the reference. They belong to
    the moment in the middle of a frame's persistence. Companions show the same moments on
    the same grid.

    Args:
        settings: All that defines the sweep.
        body: What is scanned; ``None`` makes the subject's forearm, which takes seconds:
            make it once for several sweeps of a subject.
        engine: Of the speckle renderer, see :class:`SpeckleRenderer`.
        device: Of its engine ``"torch"``.

    Raises:
        ScanError: If the sweep leaves the body or is too fast for its frames.
    """
    echoes = SweepEchoes(settings, body or forearm(settings.subject), engine, device)
    grid = settings.grid
    image_to_plane = pose_from_parts(
        torch.eye(3, dtype=torch.float64),
        torch.tensor([*grid.origin_mm, 0.0], dtype=torch.float64),
    )
    plane_to_body, tracked = _poses(echoes)
    return Scan(
        name=f"{subject_name(settings.subject)}-{settings.scan:03d}",
        frames=BModeFrames(echoes),
        calibration=Calibration(grid.spacing_mm, image_to_probe=image_to_plane),
        timestamps_s=torch.from_numpy(echoes.times_s),
        image_to_reference=torch.from_numpy(plane_to_body) @ image_to_plane,
        tracked=None if tracked is None else torch.from_numpy(tracked),
        subject=subject_name(settings.subject),
        region=_region(echoes),
        companions={
            name: Companion(FRAMES_OF[name](echoes), grid.spacing_mm)  # type: ignore[call-arg,arg-type]
            for name in settings.modalities
        },
        notes=_notes(settings),
    )


def _poses(
    echoes: SweepEchoes,
) -> tuple[Float[np.ndarray, "frames 4 4"], Bool[np.ndarray, " frames"] | None]:
    """Return the true poses, or those that a tracker saw and which they are."""
    tracker = echoes.settings.tracker
    if tracker is None:
        return echoes.motion.poses_at(echoes.times_s), None
    return track_frames(
        echoes.motion.poses_at, echoes.times_s, tracker, echoes.generator("tracker")
    )


def _region(echoes: SweepEchoes) -> Region | None:
    if echoes.converter is None:
        return None
    inside = echoes.converter.inside
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    width, height = int(columns[-1]) - left + 1, int(rows[-1]) - top + 1
    return Region((left, top, width, height), inside)


def _notes(settings: SweepSettings) -> dict[str, str]:
    notes = {"simulation": settings_text(settings)}
    if "power_doppler" in settings.modalities:
        doppler = settings.doppler
        notes["power_doppler"] = (
            f"gray 0 is {doppler.black_db:g} dB above the noise, 255 is"
            f" {doppler.black_db + doppler.dynamic_range_db:g} dB above it, linear in dB"
        )
    if "photoacoustic" in settings.modalities:
        notes["photoacoustic"] = "linear amplitude; blood in full light is about 1"
    if "iq" in settings.modalities:
        notes["iq"] = "baseband echoes before detection: real part, imaginary part"
    return notes

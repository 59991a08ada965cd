"""Channel data of a short sweep over a body: B-mode, power Doppler and photoacoustics.

As in the paper's data set 2, each frame has plane waves of several angles, an ensemble of one
angle and a laser shot. Tissue scatterers stay where they are in the body; blood is new in
each frame, having flowed on, and moves from pulse to pulse.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from sonosweep.errors import ScanError
from sonosweep.scan import ChannelData, ChannelSweep, LazyFrames, Probe
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Body, Tissue, Vessel, echo_amplitude
from sonosweep.simulate.channels import (
    Acquisition,
    plane_wave_delays,
    simulate_ensemble,
    simulate_photoacoustic,
    simulate_plane_waves,
)
from sonosweep.simulate.probes import linear_probe_l11_5v
from sonosweep.simulate.seeds import generator

BLOOD = (int(Tissue.ARTERY), int(Tissue.VEIN))
SLICE_WIDTHS = 2.0  # waists beside the plane, where an echo has fallen to exp(-8)
MOST_SCATTERERS = 5e6


@dataclass(frozen=True)
class ChannelSweepSettings:
    """How a sweep's channel data are made; small, so that a frame takes a fraction of a second.

    Attributes:
        angles_rad: Of the plane waves for B-mode.
        pulses: In a Doppler ensemble, straight ahead.
        pulse_repetition_hz: Their rate.
        frame_rate_hz: Of the sweep; tissue moves by while an ensemble is recorded.
        density_per_mm3: Scatterers in tissue and blood.
        fluence_per_mm: How fast light fades with depth.
        skin_pressure: Photoacoustic pressure of the skin; that of blood is 1.
        noise: Standard deviation of the electronic noise of a sample; the echo of a
            scatterer of amplitude 1 that is 10 mm away has a peak of 0.1.
        acquisition: How echoes are recorded.
    """

    angles_rad: tuple[float, ...] = tuple(np.deg2rad(np.linspace(-10.0, 10.0, 7)).tolist())
    pulses: int = 20
    pulse_repetition_hz: float = 3000.0
    frame_rate_hz: float = 20.0
    density_per_mm3: float = 8.0
    fluence_per_mm: float = 0.11
    skin_pressure: float = 0.5
    noise: float = 3e-4
    acquisition: Acquisition = field(default_factory=lambda: Acquisition(samples=640, beam=Beam()))

    def __post_init__(self) -> None:
        """Check what the simulation of a frame does not.

        Raises:
            ScanError: If a rate or the density is not positive.
        """
        for what, value in (
            ("frame rate", self.frame_rate_hz),
            ("density of scatterers", self.density_per_mm3),
        ):
            if not (math.isfinite(value) and value > 0):
                raise ScanError(f"the {what} must be above 0, got {value:g}")
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise ScanError(f"the noise of a sample must be 0 or more, got {self.noise:g}")


def simulate_channel_sweep(
    body: Body,
    plane_to_body: Float[np.ndarray, "frames 4 4"],
    probe: Probe | None = None,
    settings: ChannelSweepSettings | None = None,
    seed: int = 0,
) -> ChannelSweep:
    """Return a sweep's channel data, simulated frame by frame when read.

    Args:
        body: What is scanned.
        plane_to_body: Pose of the image plane in each frame; its origin is the middle of
            the array's face.
        probe: What scans; the middle 64 elements of an L11-5v when ``None``.
        settings: How; see there.
        seed: Of the scatterers. The same seed gives the same samples.

    Raises:
        ScanError: If the sweep leaves the body, or would need too many scatterers.
    """
    array, chosen = probe or linear_probe_l11_5v(64), settings or ChannelSweepSettings()
    field_of_view = _Field(body, plane_to_body, array, chosen, seed)
    timestamps = torch.arange(len(plane_to_body), dtype=torch.float64) / chosen.frame_rate_hz
    speed = chosen.acquisition.sound_speed_m_per_s
    angles = np.array(chosen.angles_rad, np.float64)
    straight = plane_wave_delays(array, np.zeros(1), speed).repeat(chosen.pulses, 0)

    def data(
        simulate: Callable[[int], ChannelData], transmits: int, delays: np.ndarray | None
    ) -> ChannelData:
        rate = chosen.pulse_repetition_hz if simulate == field_of_view.ensemble else None
        return ChannelData(
            body.name,
            _Simulated(simulate, len(plane_to_body), transmits, array, chosen.acquisition),
            array,
            chosen.acquisition.sampling_frequency_hz,
            start_time_s=torch.full((transmits,), chosen.acquisition.start_time_s).double(),
            transmit_delays_s=None if delays is None else torch.from_numpy(delays),
            sound_speed_m_per_s=speed,
            timestamps_s=timestamps,
            pulse_repetition_hz=rate,
        )

    return ChannelSweep(
        body.name,
        data(field_of_view.plane_waves, len(angles), plane_wave_delays(array, angles, speed)),
        data(field_of_view.ensemble, chosen.pulses, straight),
        data(field_of_view.laser_shot, 1, None),
        image_to_reference=torch.from_numpy(plane_to_body.astype(np.float64)),
        subject=body.subject,
    )


class _Simulated(LazyFrames):
    """Samples that are simulated when read."""

    def __init__(
        self,
        simulate: Callable[[int], ChannelData],
        frames: int,
        transmits: int,
        probe: Probe,
        acquisition: Acquisition,
    ) -> None:
        elements = len(probe.element_positions_mm)
        super().__init__((frames, transmits, elements, acquisition.samples), np.dtype(np.float32))
        self._simulate = simulate

    def _read(self, frame: int) -> np.ndarray:
        return np.asarray(self._simulate(frame).samples[0])


class _Field:
    """The scatterers of a body, as the probe sees them in each frame."""

    def __init__(
        self,
        body: Body,
        plane_to_body: np.ndarray,
        probe: Probe,
        settings: ChannelSweepSettings,
        seed: int,
    ) -> None:
        self._body, self._poses, self._probe = body, plane_to_body, probe
        self._settings, self._seed = settings, seed
        self._low, self._high = _slab(probe, settings.acquisition)
        # What flows into the slice before the last pulse, twice as fast as on average.
        fastest = max((2 * abs(vessel.mean_speed_mm_per_s) for vessel in body.vessels), default=0.0)
        inflow = fastest * settings.pulses / settings.pulse_repetition_hz
        self._inflow_mm = np.array([0.0, 0.0, inflow])
        self._tissue_mm, self._amplitude, self._skin = self._static()

    def plane_waves(self, frame: int) -> ChannelData:
        """Return one frame of echoes for B-mode."""
        points, amplitudes, _ = self._scatterers(frame)
        angles = np.array(self._settings.angles_rad, np.float64)
        data = simulate_plane_waves(
            points, amplitudes, self._probe, angles, self._settings.acquisition
        )
        return self._noisy(data, frame, "plane waves")

    def ensemble(self, frame: int) -> ChannelData:
        """Return one frame's Doppler ensemble."""
        points, amplitudes, velocities = self._scatterers(frame)
        data = simulate_ensemble(
            points,
            amplitudes,
            velocities,
            self._probe,
            self._settings.pulses,
            self._settings.pulse_repetition_hz,
            acquisition=self._settings.acquisition,
        )
        return self._noisy(data, frame, "ensemble")

    def laser_shot(self, frame: int) -> ChannelData:
        """Return what one laser pulse makes blood and skin send."""
        blood, _ = self._blood(frame)
        skin = self._in_plane(self._tissue_mm[self._skin], frame)
        skin = skin[self._inside(skin)]
        points = np.concatenate([blood, skin])
        pressures = np.concatenate(
            [np.ones(len(blood)), np.full(len(skin), self._settings.skin_pressure)]
        )
        if len(points) == 0:  # nothing absorbs: the elements hear nothing
            points, pressures = np.array([[0.0, 1.0, 0.0]]), np.zeros(1)
        lit = pressures * np.exp(-self._settings.fluence_per_mm * points[:, 1])
        data = simulate_photoacoustic(points, lit, self._probe, self._settings.acquisition)
        return self._noisy(data, frame, "laser shot")

    def _noisy(self, data: ChannelData, frame: int, what: str) -> ChannelData:
        """Return the data with electronic noise, other in each frame and modality."""
        random = generator(self._seed, frame, f"channel noise {what}")
        noise = random.standard_normal(data.samples.shape, np.float32)
        return replace(data, samples=data.samples[:] + np.float32(self._settings.noise) * noise)

    def _static(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return scatterers that stay in the body: places, amplitudes, and which are skin."""
        corners = np.array(np.meshgrid(*zip(self._low, self._high, strict=True))).reshape(3, -1).T
        reached = np.concatenate([_moved(pose, corners) for pose in self._poses])
        size = np.array(self._body.tissue.shape[::-1]) * self._body.spacing_mm
        first = np.array(self._body.origin_mm) - self._body.spacing_mm / 2
        low, high = np.maximum(reached.min(0), first), np.minimum(reached.max(0), first + size)
        if not (low < high).all():
            raise ScanError(f"the sweep lies outside of phantom '{self._body.name}'")
        count = self._settings.density_per_mm3 * float(np.prod(high - low))
        if count > MOST_SCATTERERS:
            raise ScanError(
                f"the sweep would need {count:.3g} scatterers, more than {MOST_SCATTERERS:.0e}:"
                " make it shorter or density_per_mm3 smaller"
            )
        random = generator(self._seed, 0, "channel tissue")
        points = random.uniform(low, high, (round(count), 3))
        strengths = random.normal(size=len(points))
        tissue, amplitude = self._look_up(points)
        keep = (amplitude > 0) & ~np.isin(tissue, BLOOD)
        skin = (tissue == Tissue.SKIN)[keep]
        return points[keep], (amplitude * strengths)[keep], skin

    def _scatterers(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return places, amplitudes and velocities (mm/s) of tissue and blood in the plane."""
        here = self._in_plane(self._tissue_mm, frame)
        inside = self._inside(here)
        blood, blood_velocity = self._blood(frame)
        in_body = _moved(self._poses[frame], blood)
        _, blood_amplitude = self._look_up(in_body)
        random = generator(self._seed, frame, "channel blood echoes")
        echoes = blood_amplitude * random.normal(size=len(blood))
        points = np.concatenate([here[inside], blood])
        if len(points) == 0:
            raise ScanError(f"frame {frame} of the sweep lies outside of '{self._body.name}'")
        velocities = self._passing(points, frame)
        velocities[inside.sum() :] += blood_velocity
        return points, np.concatenate([self._amplitude[inside], echoes]), velocities

    def _passing(self, points: np.ndarray, frame: int) -> np.ndarray:
        """Return how fast still tissue passes by the moving probe, mm/s, plane coordinates."""
        if len(self._poses) == 1:
            return np.zeros_like(points)
        first = min(frame, len(self._poses) - 2)
        step = np.linalg.inv(self._poses[first + 1]) @ self._poses[first]
        return (_moved(step, points) - points) * self._settings.frame_rate_hz

    def _blood(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return this frame's blood: places and velocities (mm/s), plane coordinates."""
        random = generator(self._seed, frame, "channel blood")
        low, high = self._low - self._inflow_mm, self._high + self._inflow_mm
        count = round(self._settings.density_per_mm3 * float(np.prod(high - low)))
        points = random.uniform(low, high, (count, 3))
        in_body = _moved(self._poses[frame], points)
        tissue, _ = self._look_up(in_body)
        inside = np.isin(tissue, BLOOD)
        flow = blood_velocity(self._body.vessels, in_body[inside])
        return points[inside], flow @ self._poses[frame][:3, :3]

    def _in_plane(self, points: np.ndarray, frame: int) -> np.ndarray:
        return _moved(np.linalg.inv(self._poses[frame]), points)

    def _inside(self, points: np.ndarray) -> np.ndarray:
        return np.all((points >= self._low) & (points < self._high), axis=1)

    def _look_up(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return tissue and scatterers' amplitude at places in the body."""
        body = self._body
        index = np.rint((points - np.array(body.origin_mm)) / body.spacing_mm).astype(np.int64)
        inside = ((index >= 0) & (index < body.tissue.shape[::-1])).all(axis=1)
        x, y, z = np.where(inside[:, None], index, 0).T
        tissue = np.where(inside, body.tissue[z, y, x], int(Tissue.OUTSIDE))
        amplitude = np.where(inside, echo_amplitude()[body.echogenicity[z, y, x]], 0.0)
        return tissue, amplitude


def blood_velocity(
    vessels: tuple[Vessel, ...], points_mm: Float[np.ndarray, "points xyz=3"]
) -> Float[np.ndarray, "points xyz=3"]:
    """Return the velocity of blood (mm/s) at places in vessels, in body coordinates.

    The profile is Poiseuille's: twice the mean speed in the middle, none at the wall.
    """
    if len(vessels) == 0 or len(points_mm) == 0:
        return np.zeros_like(points_mm)
    lines = [np.asarray(vessel.centerline_mm) for vessel in vessels]
    along = np.concatenate([_directions(line) for line in lines])
    radii = np.concatenate([vessel.radius_mm for vessel in vessels])
    speeds = np.concatenate([np.full(len(v.radius_mm), v.mean_speed_mm_per_s) for v in vessels])
    centers = np.concatenate(lines)
    _, nearest = cKDTree(centers).query(points_mm)
    apart = points_mm - centers[nearest]
    aside = apart - (apart * along[nearest]).sum(1, keepdims=True) * along[nearest]
    relative = (aside**2).sum(1) / radii[nearest] ** 2
    return (2 * speeds[nearest] * np.clip(1 - relative, 0, 1))[:, None] * along[nearest]


def _directions(line: np.ndarray) -> np.ndarray:
    """Return unit vectors along a center line."""
    steps = np.gradient(line, axis=0)
    return steps / np.linalg.norm(steps, axis=1, keepdims=True)


def _slab(probe: Probe, acquisition: Acquisition) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of what a frame can hear, plane coordinates."""
    if acquisition.beam is None:
        raise ScanError("a sweep needs the elevational beam of its probe, got an acquisition none")
    end_s = acquisition.start_time_s + acquisition.samples / acquisition.sampling_frequency_hz
    depth = end_s * acquisition.sound_speed_m_per_s * 1e3 / 2
    lateral = probe.element_positions_mm[:, 0].numpy()
    beam = acquisition.beam
    rayleigh = math.pi * beam.elevation_waist_mm**2 / beam.wavelength_mm
    widest = max(beam.elevation_focus_mm, depth - beam.elevation_focus_mm) / rayleigh
    # Out of focus the echo from beside is weak and its phase spread: half the widening is enough.
    thick = SLICE_WIDTHS * beam.elevation_waist_mm * math.sqrt(1 + widest**2) / 2
    low = np.array([lateral.min() - 1.0, 0.0, -thick])
    return low, np.array([lateral.max() + 1.0, depth, thick])


def _moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]

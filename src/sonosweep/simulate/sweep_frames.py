"""The frames of a simulated sweep, made when they are read."""

import numpy as np
from jaxtyping import Complex64

from sonosweep.scan import LazyFrames
from sonosweep.simulate.blood import amplitudes_for_level, disturbed, draw_blood
from sonosweep.simulate.doppler_frames import add_noise, power_levels, tissue_ensemble
from sonosweep.simulate.echoes import SweepEchoes
from sonosweep.simulate.photoacoustic_frames import photoacoustic_iq
from sonosweep.simulate.scanner import gray_levels, remaining_amplitude, with_bone
from sonosweep.simulate.speckle import render_points

BEAT_REST, BEAT_PEAK = 0.6, 1.28  # arterial flow in parts of its mean: at rest, and more by


class BModeFrames(LazyFrames):
    """8-bit B-mode."""

    def __init__(self, echoes: SweepEchoes) -> None:
        super().__init__(_shape(echoes), np.dtype(np.uint8))
        self._echoes = echoes

    def _read(self, frame: int) -> np.ndarray:
        levels = gray_levels(self._echoes.amplitude(frame), self._echoes.settings.scanner)
        converter = self._echoes.converter
        return levels if converter is None else converter.apply(levels)


class AmplitudeFrames(LazyFrames):
    """The amplitude before log compression, float32."""

    def __init__(self, echoes: SweepEchoes) -> None:
        super().__init__(_shape(echoes), np.dtype(np.float32))
        self._echoes = echoes

    def _read(self, frame: int) -> np.ndarray:
        amplitude = self._echoes.amplitude(frame)
        converter = self._echoes.converter
        return amplitude if converter is None else converter.apply(amplitude)


class IQFrames(LazyFrames):
    """Baseband echoes of one frame, without persistence: real and imaginary part, float32."""

    def __init__(self, echoes: SweepEchoes) -> None:
        super().__init__((*_shape(echoes), 2), np.dtype(np.float32))
        self._echoes = echoes

    def _read(self, frame: int) -> np.ndarray:
        received = self._echoes.at(frame).received
        return received.view(np.float32).reshape(self.shape[1:]).copy()


class PowerDopplerFrames(LazyFrames):
    """8-bit power of blood on a logarithmic scale above the noise."""

    def __init__(self, echoes: SweepEchoes) -> None:
        super().__init__(_shape(echoes), np.dtype(np.uint8))
        self._echoes = echoes

    def _read(self, frame: int) -> np.ndarray:
        return power_levels(doppler_ensemble(self._echoes, frame), self._echoes.settings.doppler)


class PhotoacousticFrames(LazyFrames):
    """Photoacoustic amplitude, float32, linear."""

    def __init__(self, echoes: SweepEchoes) -> None:
        super().__init__(_shape(echoes), np.dtype(np.float32))
        self._echoes = echoes

    def _read(self, frame: int) -> np.ndarray:
        echoes = self._echoes
        pose = echoes.pose_at(float(echoes.times_s[frame]))
        iq = photoacoustic_iq(
            echoes.body,
            pose,
            echoes.at(frame).tissue,
            echoes.settings.grid,
            echoes.settings.beam,
            echoes.settings.photoacoustic,
            echoes.generator(f"photoacoustic {frame}"),
            echoes.deformation_at(float(echoes.times_s[frame]), pose),
        )
        return np.abs(iq)


def doppler_ensemble(
    echoes: SweepEchoes, frame: int
) -> Complex64[np.ndarray, "pulses rows columns"]:
    """Return the pulses of a frame before the clutter filter: tissue, blood and noise."""
    chosen, grid, beam = echoes.settings.doppler, echoes.settings.grid, echoes.settings.beam
    now, draws = float(echoes.times_s[frame]), echoes.generator(f"doppler {frame}")
    half_s = float(chosen.pulse_times_s[-1])
    end = now + half_s
    heard, prepared = echoes.at(frame), echoes.prepared
    last_pose = echoes.pose_at(end)
    middle = with_bone(heard.iq, heard.tissue, prepared)
    last_iq = echoes.render(last_pose, echoes.deformation_at(end, last_pose))
    last = with_bone(last_iq, heard.tissue, prepared)
    ensemble = tissue_ensemble(middle, last, chosen, beam, grid.spacing_mm, draws)
    pose = echoes.pose_at(now)
    beat = BEAT_REST + BEAT_PEAK * echoes.body_motion.pulse_at(now)
    flow = {"artery": beat * chosen.flow, "vein": chosen.flow}
    deformation = echoes.deformation_at(now, pose)
    blood = draw_blood(echoes.body, pose, grid, beam, draws, deformation, flow, half_s)
    velocity = disturbed(blood.velocities_mm_per_s, chosen.disturbance, draws)
    level = amplitudes_for_level(chosen.blood_db, blood.places_mm[:, 1], grid, beam)
    for pulse, time in zip(ensemble, chosen.pulse_times_s, strict=True):
        pulse += render_points(blood.places_mm + time * velocity, level, beam, grid)
    ensemble *= remaining_amplitude(heard.tissue, prepared)
    add_noise(ensemble, chosen.noise_db, draws)
    return ensemble


def _shape(echoes: SweepEchoes) -> tuple[int, int, int]:
    grid = echoes.settings.grid
    return (len(echoes.times_s), grid.rows, grid.columns)

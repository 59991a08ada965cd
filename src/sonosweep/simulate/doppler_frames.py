"""Power Doppler frames: an ensemble of pulses over moving blood, through the clutter filter."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex64, Float, Float32, UInt8

from sonosweep.errors import ScanError
from sonosweep.imaging.bmode import log_compress
from sonosweep.imaging.clutter import Rank, check_rank, svd_filter
from sonosweep.imaging.doppler import power_doppler
from sonosweep.simulate.beam import Beam

FIELD_WAVES = 4  # sinusoids that make up how tissue moves from place to place
FIELD_SCALE_MM = 25.0


@dataclass(frozen=True)
class DopplerSettings:
    """An ensemble of pulses, and how its power is shown.

    Attributes:
        pulses: In an ensemble.
        pulse_repetition_hz: Their rate.
        blood_db: Mean level of blood, as the levels of the scanner.
        noise_db: Electronic noise of a pulse, as the level of the scanner's.
        flow: How many times faster than at rest blood flows: an arm that is warm or has
            worked has more flow.
        disturbance: Standard deviation of each component of the velocity of blood cells,
            in parts of their speed. Without it, flow straight through the image would be
            seen by the width of the slice alone.
        tissue_speed_mm_per_s: Standard deviation of the axial speed with which tissue
            moves, differently from place to place, on top of the probe's motion.
        rank: Of the clutter filter.
        black_db: Power this far above that of noise is black.
        dynamic_range_db: Between black and white.
    """

    pulses: int = 20
    pulse_repetition_hz: float = 3000.0
    blood_db: float = -50.0
    noise_db: float = -85.0
    flow: float = 2.0
    disturbance: float = 0.25
    tissue_speed_mm_per_s: float = 1.0
    rank: Rank = "auto"
    black_db: float = 6.0
    dynamic_range_db: float = 30.0

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ScanError: If one is out of range.
        """
        check_rank(self.pulses, self.rank)
        for name in ("pulse_repetition_hz", "dynamic_range_db"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ScanError(f"{name} of power Doppler must be above 0, got {value:g}")
        for name in ("flow", "disturbance", "tissue_speed_mm_per_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ScanError(f"{name} of power Doppler must be 0 or more, got {value:g}")
        for name in ("blood_db", "noise_db", "black_db"):
            if not np.isfinite(getattr(self, name)):
                raise ScanError(f"{name} of power Doppler must be a number")

    @property
    def pulse_times_s(self) -> Float[np.ndarray, " pulses"]:
        """Time of each pulse after the middle of the ensemble."""
        return (np.arange(self.pulses) - (self.pulses - 1) / 2) / self.pulse_repetition_hz


def tissue_ensemble(
    middle: Complex64[np.ndarray, "rows columns"],
    last: Complex64[np.ndarray, "rows columns"],
    settings: DopplerSettings,
    beam: Beam,
    pixel_mm: tuple[float, float],
    generator: np.random.Generator,
) -> Complex64[np.ndarray, "pulses rows columns"]:
    """Return the echoes of tissue in an ensemble.

    Args:
        middle: Echoes in the middle of the ensemble.
        last: Those where probe and body are at the last pulse; they change linearly.
        settings: Of the ensemble.
        beam: Says how fast the phase turns.
        pixel_mm: From column to column and from row to row.
        generator: Draws how tissue moves besides.
    """
    speed = _speed_field(middle.shape, pixel_mm, settings.tissue_speed_mm_per_s, generator)
    angle = speed * np.float32(-4 * np.pi / beam.wavelength_mm / settings.pulse_repetition_hz)
    turn = np.exp(1j * angle).astype(np.complex64)
    phase = np.ones_like(turn)
    steps = np.float32((settings.pulses - 1) / 2)
    change = (last - middle) / steps
    now = middle - steps * change
    ensemble = np.empty((settings.pulses, *middle.shape), np.complex64)
    for pulse in ensemble:
        np.multiply(now, phase, out=pulse)
        now += change
        phase *= turn
    return ensemble


def power_levels(
    ensemble: Complex64[np.ndarray, "pulses rows columns"], settings: DopplerSettings
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the power Doppler image of an ensemble, which is overwritten.

    Its clutter is filtered out, its power is averaged and compressed logarithmically.
    """
    power = power_doppler(svd_filter(ensemble, settings.rank, overwrite=True))
    white_db = settings.noise_db + settings.black_db + settings.dynamic_range_db
    return log_compress(np.sqrt(power), 10 ** (white_db / 20), settings.dynamic_range_db)


def add_noise(
    ensemble: Complex64[np.ndarray, "pulses rows columns"],
    noise_db: float,
    generator: np.random.Generator,
) -> None:
    """Add electronic noise to an ensemble in place."""
    deviation = np.float32(10 ** (noise_db / 20) / np.sqrt(2))
    parts = ensemble.view(np.float32)
    for pulse in parts:
        pulse += deviation * generator.standard_normal(pulse.shape, np.float32)


def _speed_field(
    shape: tuple[int, ...],
    pixel_mm: tuple[float, float],
    deviation: float,
    generator: np.random.Generator,
) -> Float32[np.ndarray, "rows columns"]:
    """Return a random axial speed that changes slowly from place to place."""
    rows = np.arange(shape[0], dtype=np.float32)[:, np.newaxis] * np.float32(pixel_mm[1])
    columns = np.arange(shape[1], dtype=np.float32) * np.float32(pixel_mm[0])
    field = np.zeros((shape[0], shape[1]), np.float32)
    for _ in range(FIELD_WAVES):
        across, down = generator.normal(0, 1 / FIELD_SCALE_MM, 2).astype(np.float32)
        phase = np.float32(generator.uniform(0, 2 * np.pi))
        field += np.cos(across * columns + down * rows + phase)
    return field * np.float32(deviation * np.sqrt(2 / FIELD_WAVES))

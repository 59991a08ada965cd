"""Delay-and-sum beamforming: complex images from what the elements received.

The value of a pixel is the mean over transmits of the weighted sum over elements of the
analytic signal at the time of flight. RF samples are demodulated first and interpolated as
baseband samples, whose phase is restored with the carrier at the time of flight (the
convention of PyMUST's ``dasmtx``): RF itself is never interpolated, nor sampled on a grid too
coarse for its phase.

References:
    Perrot, Polichetti, Varray, Garcia, "So you think you can DAS? A viewpoint on
    delay-and-sum beamforming", Ultrasonics 111 (2021) 106309.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Complex64, Float

from sonosweep.errors import ScanError
from sonosweep.imaging.aperture import (
    WINDOWS,
    ArrayShape,
    Window,
    array_shape,
    check_aperture,
)
from sonosweep.imaging.demodulate import demodulate_into
from sonosweep.imaging.pixel_grid import PixelGrid
from sonosweep.imaging.prepared import (
    Beamformer,
    Geometry,
    delay_table,
    needed_bytes,
)
from sonosweep.imaging.sector_grid import SectorGrid
from sonosweep.imaging.transmit import Waves, transmitted_waves
from sonosweep.scan import ChannelData

Interpolation = Literal["auto", "linear", "cubic"]
MEMORY_LIMIT_BYTES = 4 << 30
SOUND_SPEEDS_M_PER_S = (100.0, 10_000.0)
"""From rubber foam to beryllium; 1.54 is in mm per us."""
MOST_PIXELS, MOST_ROWS = 1 << 24, 1 << 16
"""Beyond, a mistaken spacing is likelier than such an image, and memory would run out."""


@dataclass(frozen=True)
class BeamformSettings:
    """How to beamform.

    Attributes:
        f_number: Depth over width of the receive aperture, measured from where each element
            looks; ``None`` uses all elements everywhere, as ring arrays need.
        window: Of the receive aperture.
        interpolation: Between baseband samples: 2 points (``"linear"``) or 4 (``"cubic"``);
            ``"auto"`` is linear for at least two samples in a carrier period, else cubic.
        directivity: Whether to weight elements by what they hear: a soft baffle's
            ``cos(a) sinc(width / wavelength sin(a))``.
        sound_speed_m_per_s: In the medium; ``None`` takes the machine's assumption.
        bandwidth_hz: To keep when demodulating RF; ``None`` keeps all.
        compound: Whether to average the transmits coherently.
    """

    f_number: float | None = 1.5
    window: Window = "boxcar"
    interpolation: Interpolation = "auto"
    directivity: bool = False
    sound_speed_m_per_s: float | None = None
    bandwidth_hz: float | None = None
    compound: bool = True

    def __post_init__(self) -> None:
        """Check the sound speed; the rest is checked with the probe at hand.

        Raises:
            ScanError: If nothing has such a speed.
        """
        if self.sound_speed_m_per_s is not None:
            check_sound_speed(self.sound_speed_m_per_s)


def check_sound_speed(speed_m_per_s: float) -> None:
    """Check that sound may be so fast somewhere.

    Raises:
        ScanError: If not.
    """
    slowest, fastest = SOUND_SPEEDS_M_PER_S
    if not slowest <= speed_m_per_s <= fastest:
        raise ScanError(
            f"the sound speed must be from {slowest:g} to {fastest:g} m/s, got {speed_m_per_s:g}"
        )


DEFAULT_SETTINGS = BeamformSettings()


def beamform(
    channel_data: ChannelData,
    frame: int,
    grid: PixelGrid | SectorGrid,
    settings: BeamformSettings = DEFAULT_SETTINGS,
    *,
    threads: int = 1,
) -> Complex64[np.ndarray, "..."]:
    """Return the analytic signal of one frame at the pixels of a grid.

    Data without transmit delays are one-way: sound starts in the pixels at time zero.

    Args:
        channel_data: RF or IQ samples and their geometry.
        frame: Number of the frame.
        grid: Where the pixels are, in probe coordinates.
        settings: How to beamform.
        threads: Of this computation; the numbers do not depend on it.

    Returns:
        ``(rows, columns)``, or ``(transmits, rows, columns)`` without compounding. Pixels
        whose echo was not recorded are 0.

    Raises:
        ScanError: If samples, geometry and settings do not fit together, samples are not all
            finite, or no pixel at all was recorded.
    """
    count = len(channel_data.samples)
    if not 0 <= frame < count:
        raise ScanError(f"there is no frame {frame} in '{channel_data.name}', which has {count}")
    samples = np.asarray(channel_data.samples[frame])
    geometry = _geometry(channel_data, grid, settings)
    baseband = _Baseband(channel_data, settings)
    return Beamformer(geometry, baseband, settings.compound, threads=threads).apply(samples)


def prepare_beamformer(
    channel_data: ChannelData,
    grid: PixelGrid | SectorGrid,
    settings: BeamformSettings = DEFAULT_SETTINGS,
    *,
    threads: int = 1,
    memory_limit_bytes: int = MEMORY_LIMIT_BYTES,
) -> Beamformer:
    """Return a beamformer whose delays are computed once, for many frames.

    Its ``apply(samples)`` takes one frame's samples or a stack of frames and gives the same
    numbers as :func:`beamform`; ``memory_bytes`` tells what it holds.

    Args:
        channel_data: Any recording of this geometry; the samples themselves are not read.
        grid: As for :func:`beamform`.
        settings: As for :func:`beamform`.
        threads: As for :func:`beamform`.
        memory_limit_bytes: Refuse to take more.

    Raises:
        ScanError: As for :func:`beamform`, and if the delays take too much memory.
    """
    geometry = _geometry(channel_data, grid, settings)
    needed = needed_bytes(geometry)
    if needed > memory_limit_bytes:
        columns, rows = geometry.points_mm.shape[:2]
        raise ScanError(
            f"the delays of {columns} x {rows} pixels take {needed / 1e9:.1f} GB, more than the"
            f" limit of {memory_limit_bytes / 1e9:.1f} GB: use fewer pixels, a larger f-number,"
            " or beamform without preparing"
        )
    tables = [delay_table(geometry, block) for block in geometry.blocks]
    baseband = _Baseband(channel_data, settings)
    return Beamformer(geometry, baseband, settings.compound, tables, threads)


class _Baseband:
    """Checks a frame's samples and turns them into baseband samples."""

    def __init__(self, data: ChannelData, settings: BeamformSettings) -> None:
        self._name, self._is_rf = data.name, not _is_complex(data)
        self._rate_hz, self._carrier_hz = data.sampling_frequency_hz, _carrier_hz(data)
        self._start_s = _start_times(data)
        self._bandwidth_hz = settings.bandwidth_hz

    def __call__(self, samples: np.ndarray, iq: np.ndarray) -> None:
        """Fill ``iq``, ``(transmits x elements, samples)``."""
        if np.iscomplexobj(samples) is self._is_rf:
            kinds = ("RF (real)", "IQ (complex)") if self._is_rf else ("IQ (complex)", "RF (real)")
            raise ScanError("the beamformer was made for {} samples, got {}".format(*kinds))
        if np.issubdtype(samples.dtype, np.inexact) and not np.isfinite(samples).all():
            place = np.argwhere(~np.isfinite(samples))[0]
            raise ScanError(
                f"samples of '{self._name}' are not all numbers: transmit {place[0]}, element"
                f" {place[1]} holds NaN or infinity"
            )
        signals = samples.reshape(-1, samples.shape[-1])
        if not self._is_rf:
            iq[:] = signals
            return
        starts = np.repeat(self._start_s, samples.shape[1])
        demodulate_into(iq, signals, self._rate_hz, self._carrier_hz, starts, self._bandwidth_hz)


def _geometry(
    data: ChannelData, grid: PixelGrid | SectorGrid, settings: BeamformSettings
) -> Geometry:
    """Return the geometry of a recording and a grid, checked."""
    shape = array_shape(data.probe)
    check_aperture(settings.f_number, settings.window, shape)
    array = shape or _undirected(data, settings)
    speed = settings.sound_speed_m_per_s or data.sound_speed_m_per_s
    check_sound_speed(speed)
    carrier_hz = _carrier_hz(data)
    wavelength_mm = speed / data.probe.center_frequency_hz * 1e3
    return Geometry(
        points_mm=grid_points(grid),
        array=array,
        waves=_waves(data, array, speed),
        transmits=data.samples.shape[1],
        start_time_s=_start_times(data),
        samples=data.samples.shape[3],
        rate_hz=float(data.sampling_frequency_hz),
        carrier_hz=carrier_hz,
        sound_speed_m_per_s=float(speed),
        half_width=-1.0 if settings.f_number is None else 0.5 / settings.f_number,
        window=WINDOWS[settings.window],
        width_wavelengths=(
            data.probe.element_width_mm / wavelength_mm if settings.directivity else 0.0
        ),
        is_cubic=_is_cubic(settings, data.sampling_frequency_hz, carrier_hz),
    )


def _is_cubic(settings: BeamformSettings, rate_hz: float, carrier_hz: float) -> bool:
    if settings.interpolation == "auto":
        return rate_hz < 2 * carrier_hz * (1 - 1e-9)
    return settings.interpolation == "cubic"


def _undirected(data: ChannelData, settings: BeamformSettings) -> ArrayShape:
    """Return an array whose elements listen in all directions."""
    if settings.directivity:
        raise ScanError(
            f"the elements of probe '{data.probe.name}' lie neither on a line nor on a circle, so"
            " that their directivity is not known"
        )
    elements = data.probe.element_positions_mm.detach().cpu().numpy().astype(np.float64)
    return ArrayShape(elements, np.tile((0.0, 1.0), (len(elements), 1)), False)


def _waves(data: ChannelData, array: ArrayShape, speed: float) -> Waves | None:
    if data.transmit_delays_s is None:
        return None
    delays = data.transmit_delays_s.detach().cpu().numpy().astype(np.float64)
    return transmitted_waves(array.elements_mm, delays, speed, array)


def _start_times(data: ChannelData) -> Float[np.ndarray, " transmits"]:
    if data.start_time_s is None:
        return np.zeros(data.samples.shape[1])
    starts = data.start_time_s.detach().cpu().numpy().astype(np.float64)
    if not np.isfinite(starts).all():
        raise ScanError(f"the start times of '{data.name}' are not all numbers")
    return starts


def _is_complex(data: ChannelData) -> bool:
    return np.issubdtype(data.samples.dtype, np.complexfloating)


def _carrier_hz(data: ChannelData) -> float:
    """Return the carrier of the baseband samples, from the data or for the demodulation."""
    carrier = data.demodulation_frequency_hz
    if _is_complex(data):
        if not (np.isfinite(carrier) and carrier > 0):
            raise ScanError(
                f"'{data.name}' holds IQ samples without a demodulation frequency ({carrier:g} Hz):"
                " it is needed to restore their phase"
            )
        return float(carrier)
    if carrier != 0:
        raise ScanError(
            f"'{data.name}' holds real samples but a demodulation frequency of {carrier:g} Hz:"
            " RF samples have none"
        )
    center = float(data.probe.center_frequency_hz)
    if center > data.sampling_frequency_hz * (1 + 1e-9):
        raise ScanError(
            f"'{data.name}' holds {data.sampling_frequency_hz:g} RF samples per second, less than"
            f" one per period of the {center:g} Hz of probe '{data.probe.name}': check both"
        )
    return center


def grid_points(
    grid: PixelGrid | SectorGrid,
) -> Float[np.ndarray, "columns rows xy=2"]:
    """Return the lateral and axial position of each pixel, or of each sample of each line.

    Raises:
        ScanError: If there are too many.
    """
    columns, rows = (
        (grid.columns, grid.rows) if isinstance(grid, PixelGrid) else (grid.lines, grid.samples)
    )
    if columns * rows > MOST_PIXELS or rows > MOST_ROWS:
        raise ScanError(
            f"an image of {columns} x {rows} pixels is too large to beamform: at most"
            f" {MOST_PIXELS} pixels and {MOST_ROWS} rows"
        )
    if isinstance(grid, PixelGrid):
        points = np.empty((grid.columns, grid.rows, 2))
        points[..., 0], points[..., 1] = grid.lateral_mm[:, None], grid.axial_mm
        return points
    distance = grid.radius_mm + grid.depths_mm
    angles = grid.angles_rad[:, None]
    return np.stack(
        [distance * np.sin(angles), distance * np.cos(angles) - grid.radius_mm], axis=-1
    )

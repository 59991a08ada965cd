"""Delay-and-sum for a fixed geometry, computed once and applied to many frames.

A sparse matrix over all transmits repeats each element's delay for every transmit: 31 angles
of the paper's grid take 1.8 GB. Kept apart, the receive delays and weights take 12 bytes for
each pair of pixel and element, and the transmit delays 12 bytes for each pair of pixel and
transmit: 50 MB, which the processor reads faster than such a matrix.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Complex64, Float32, Float64, Int, Shaped

from sonosweep.errors import ScanError
from sonosweep.imaging import das_kernels as kernels
from sonosweep.imaging.aperture import ArrayShape
from sonosweep.imaging.das_kernels import BACK, FRONT
from sonosweep.imaging.transmit import Waves, arrival_times

COLUMNS_AT_ONCE = 8
"""Columns whose sums for 31 transmits stay in the processor's cache."""
BYTES_PER_PAIR = 12


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where the pixels are and how sound gets there and back.

    Attributes:
        points_mm: Lateral and axial position of each pixel, ``(columns, rows)``.
        array: Elements and where they look.
        waves: What is transmitted; ``None`` for one-way data.
        transmits: In each frame.
        start_time_s: Time of the first sample of each transmit.
        samples: In each recording.
        rate_hz: Of the samples.
        carrier_hz: Removed from them.
        sound_speed_m_per_s: In the medium.
        half_width: Half of the receive aperture per depth, ``1 / (2 f)``; -1 for all elements.
        window: Its number in the kernels.
        width_wavelengths: Width of an element, for its directivity; 0 for none.
        is_cubic: Whether to interpolate between four samples instead of two.
    """

    points_mm: np.ndarray
    array: ArrayShape
    waves: Waves | None
    transmits: int
    start_time_s: np.ndarray
    samples: int
    rate_hz: float
    carrier_hz: float
    sound_speed_m_per_s: float
    half_width: float
    window: int
    width_wavelengths: float
    is_cubic: bool

    @cached_property
    def blocks(self) -> list[slice]:
        """The columns, a few at a time."""
        columns = len(self.points_mm)
        return [
            slice(first, min(first + COLUMNS_AT_ONCE, columns))
            for first in range(0, columns, COLUMNS_AT_ONCE)
        ]


@dataclass(frozen=True, eq=False)
class DelayTable:
    """Delays and weights of a block of columns, as the kernels take them.

    Attributes:
        transmit: Delay of each transmit in samples of the padded recording.
        phases: Carrier at that delay.
        first: First row that an element hears in a column.
        last: One after the last such row.
        offset: Where the run of an element and column begins in ``delays`` and so on.
        delays: Receive delays, in samples.
        cosines: Apodization times the carrier at the receive delay, real part.
        sines: The same, imaginary part.
    """

    transmit: Float32[np.ndarray, "transmits columns rows"]
    phases: Complex64[np.ndarray, "transmits columns rows"]
    first: Int[np.ndarray, "elements columns"]
    last: Int[np.ndarray, "elements columns"]
    offset: Int[np.ndarray, "elements columns"]
    delays: Float32[np.ndarray, " pairs"]
    cosines: Float32[np.ndarray, " pairs"]
    sines: Float32[np.ndarray, " pairs"]


def delay_table(geometry: Geometry, columns: slice) -> DelayTable:
    """Return the delays and weights of a block of columns."""
    points = np.ascontiguousarray(geometry.points_mm[columns])
    first, last = _runs(geometry, points)
    lengths = last - first
    offset = np.cumsum(lengths).reshape(lengths.shape) - lengths
    delays = np.empty(int(lengths.sum()), np.float32)
    cosines, sines = np.empty_like(delays), np.empty_like(delays)
    per_mm = 1e-3 / geometry.sound_speed_m_per_s
    kernels.receive_table(
        points,
        geometry.array.elements_mm,
        geometry.array.normals,
        (geometry.half_width, geometry.window),
        (
            geometry.rate_hz * per_mm,
            geometry.carrier_hz * per_mm,
            geometry.width_wavelengths,
        ),
        first,
        last,
        offset,
        delays,
        cosines,
        sines,
    )
    transmit, phases = _transmit_table(geometry, points)
    return DelayTable(transmit, phases, first, last, offset, delays, cosines, sines)


def _runs(geometry: Geometry, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row and one after the last that each element hears."""
    shape = (len(geometry.array.elements_mm), len(points))
    first, last = np.empty(shape, np.int64), np.empty(shape, np.int64)
    kernels.aperture_rows(
        points,
        geometry.array.elements_mm,
        geometry.array.normals,
        geometry.half_width,
        first,
        last,
    )
    return first, last


def _transmit_table(geometry: Geometry, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays of the transmits and the carrier at them."""
    shape = (geometry.transmits, *points.shape[:2])
    times = np.zeros(shape) if geometry.waves is None else arrival_times(geometry.waves, points)
    delays, phases = np.empty(shape, np.float32), np.empty(shape, np.complex64)
    kernels.transmit_table(
        times, geometry.start_time_s, geometry.rate_hz, geometry.carrier_hz, delays, phases
    )
    return delays, phases


class Beamformer:
    """Delay-and-sum for one geometry; made by :func:`sonosweep.imaging.prepare_beamformer`.

    Args:
        geometry: Of pixels, elements and transmits.
        to_baseband: Checks a frame's samples as recorded and fills an array,
            ``(transmits x elements, samples)``, with baseband ones.
        compound: Whether to average the transmits.
        tables: Delays of all blocks of columns; ``None`` computes them for each frame anew.
        threads: How many blocks to work on at the same time.
    """

    def __init__(
        self,
        geometry: Geometry,
        to_baseband: Callable[[np.ndarray, np.ndarray], None],
        compound: bool = True,
        tables: Sequence[DelayTable] | None = None,
        threads: int = 1,
    ) -> None:
        self.geometry, self.compound, self.tables = geometry, compound, tables
        self._to_baseband = to_baseband
        self._threads = threads
        self._checked = False

    @property
    def memory_bytes(self) -> int:
        """What the prepared delays take."""
        return 0 if self.tables is None else needed_bytes(self.geometry)

    def apply(
        self, samples: Shaped[np.ndarray, "*frames transmits elements samples"]
    ) -> Complex64[np.ndarray, "..."]:
        """Return the analytic signal at the pixels, one image for each frame.

        Args:
            samples: As the channel data hold them (RF or IQ), of one frame or of several.

        Returns:
            ``(*frames, rows, columns)``, or ``(*frames, transmits, rows, columns)`` without
            compounding.

        Raises:
            ScanError: If the samples do not fit the geometry, are not all finite, or were
                all recorded too early or too late for the image.
        """
        geometry = self.geometry
        self._check_shape(samples)
        batch = samples.shape[:-3]
        columns, rows = geometry.points_mm.shape[:2]
        kept = (rows, columns) if self.compound else (geometry.transmits, rows, columns)
        images = np.empty((*batch, *kept), np.complex64)
        for frame in np.ndindex(batch):
            self._fill(samples[frame], images[frame])
        return images

    def _fill(self, samples: np.ndarray, image: np.ndarray) -> None:
        """Beamform one frame into ``image``."""
        padded = self._padded(samples)

        def sum_block(number: int) -> list[bool]:
            table = self._table(number)
            image[..., self.geometry.blocks[number]] = self._sum(padded, table)
            return [] if self._checked else _covered(table, self.geometry.samples)

        numbers = range(len(self.geometry.blocks))
        if self._threads == 1:
            covered = [sum_block(number) for number in numbers]
        else:
            with ThreadPoolExecutor(self._threads) as pool:
                covered = list(pool.map(sum_block, numbers))
        if not self._checked:
            _check_covered(self.geometry, np.any(covered, axis=0))
        self._checked = True

    def baseband(
        self, samples: Shaped[np.ndarray, "*frames transmits elements samples"]
    ) -> Complex64[np.ndarray, "*frames transmits elements samples"]:
        """Return baseband samples, checked: what is interpolated, and what torch takes.

        Args:
            samples: As for :meth:`apply`.

        Raises:
            ScanError: As :meth:`apply`, but for samples recorded too early or too late.
        """
        self._check_shape(samples)
        iq = np.empty(samples.shape, np.complex64)
        for frame in np.ndindex(samples.shape[:-3]):
            self._to_baseband(samples[frame], iq[frame].reshape(-1, samples.shape[-1]))
        return iq

    def _padded(self, samples: np.ndarray) -> Float64[np.ndarray, "transmits elements padded"]:
        """Return baseband samples with a rim of zeros.

        Each complex one is in the bits of a 64-bit number, which moves in one piece.
        """
        size = samples.shape[-1]
        padded = np.zeros((*samples.shape[:-1], size + FRONT + BACK), np.complex64)
        self._to_baseband(samples, padded.reshape(-1, padded.shape[-1])[:, FRONT : FRONT + size])
        return padded.view(np.float64)

    def _check_shape(self, samples: np.ndarray) -> None:
        geometry = self.geometry
        expected = (geometry.transmits, len(geometry.array.elements_mm), geometry.samples)
        if samples.shape[-3:] != expected:
            raise ScanError(
                "the beamformer was made for {} transmits, {} elements and {} samples, got an"
                " array of shape {}".format(*expected, samples.shape)
            )

    def _table(self, number: int) -> DelayTable:
        if self.tables is None:
            return delay_table(self.geometry, self.geometry.blocks[number])
        return self.tables[number]

    def _sum(self, padded: np.ndarray, table: DelayTable) -> np.ndarray:
        images = np.empty(table.transmit.shape, np.complex64)
        kernels.sum_block(
            padded,
            table.transmit,
            table.phases,
            table.first,
            table.last,
            table.offset,
            table.delays,
            table.cosines,
            table.sines,
            self.geometry.is_cubic,
            images,
        )
        return images.mean(0).T if self.compound else images.transpose(0, 2, 1)


def needed_bytes(geometry: Geometry) -> int:
    """Return the memory that the prepared delays of a geometry take."""
    pairs = sum(
        int(np.subtract(*reversed(_runs(geometry, geometry.points_mm[block]))).sum())
        for block in geometry.blocks
    )
    columns, rows = geometry.points_mm.shape[:2]
    return BYTES_PER_PAIR * (pairs + geometry.transmits * columns * rows)


def _covered(table: DelayTable, samples: int) -> list[bool]:
    """Return for each transmit whether the echo of any pixel was recorded."""
    return [
        kernels.is_covered(each, table.first, table.last, table.offset, table.delays, samples)
        for each in table.transmit
    ]


def _check_covered(geometry: Geometry, covered: np.ndarray) -> None:
    if covered.all():
        return
    missed = int(np.argmin(covered))
    start = geometry.start_time_s[missed]
    stop = start + (geometry.samples - 1) / geometry.rate_hz
    low, high = geometry.points_mm[..., 1].min(), geometry.points_mm[..., 1].max()
    raise ScanError(
        f"no pixel of the image, {low:g} to {high:g} mm deep, has its echo in the recording of"
        f" transmit {missed} from {start * 1e6:.4g} to {stop * 1e6:.4g} us: check the start time,"
        " the transmit delays and the f-number"
    )

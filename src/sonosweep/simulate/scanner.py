"""What a scanner makes of echoes: attenuation, gain, noise, clutter, persistence, gray levels.

Levels in decibels are relative to the mean envelope of tissue of echogenicity code 200 before
attenuation (20 dB are a factor of 10 in amplitude). Rows run along the image lines, columns
from line to line, also for a sector before scan conversion.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex64, Float32, Int64, UInt8

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid, SectorGrid
from sonosweep.imaging.bmode import log_compress
from sonosweep.imaging.despeckle import lee_filter
from sonosweep.simulate.attenuation import two_way_loss_db_per_mm
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Tissue
from sonosweep.simulate.scanner_kernels import add_bone, first_rows, lose, receive

BONE_REACH_MM = 0.75
BONE_SLOPE = 0.6
HAZE_WIDTH_MM = 3.0
LEE_WINDOW = 5
SIDE_LOBES = 8  # on either side
SIDE_LOBE_GROWTH = 1.4  # of their distances
SIDE_LOBE_DEPTH_MM = 20.0  # at which the curvature of their arcs is right


@dataclass(frozen=True)
class Scanner:
    """Settings of a scanner: the knobs, and what its electronics add.

    Attributes:
        attenuation_scale: Factor of the attenuation of soft tissue.
        gain_db: A mean envelope of 1 shows this far above white.
        tgc_db_per_mm: Time gain compensation.
        sliders_db: Gain left over at equal distances from the first to the last row.
        dynamic_range_db: Between black and white.
        gray_gamma: Exponent of the gray map; below 1 brightens what is dark.
        gray_contrast: 0 keeps the map straight, 1 makes it S-shaped.
        noise_db: Electronic noise, before amplification.
        side_lobe_db: Mean level of clutter right beside an echo.
        side_lobe_mm: Lateral distance at which it has fallen to 1/e.
        haze_db: Reverberation at the face, which stays with the probe.
        haze_mm: Depth at which it has fallen to 1/e.
        bone_db: Mirror-like echo of a bone's surface that faces the probe.
        persistence_frames: How many envelopes are averaged, an odd number: as many before
            the frame as after it, so that its pose and time are those of the middle one
            and time has no direction.
        speckle_reduction: From 0 (none) to 1 (a Lee filter).
    """

    attenuation_scale: float = 0.75
    gain_db: float = -20.0
    tgc_db_per_mm: float = 1.0
    sliders_db: tuple[float, ...] = (0.0,)
    dynamic_range_db: float = 60.0
    gray_gamma: float = 1.0
    gray_contrast: float = 0.0
    noise_db: float = -75.0
    side_lobe_db: float = -45.0
    side_lobe_mm: float = 3.0
    haze_db: float = -25.0
    haze_mm: float = 1.5
    bone_db: float = 20.0
    persistence_frames: int = 1
    speckle_reduction: float = 0.0

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ScanError: If one is not a number or out of range.
        """
        for name, value in vars(self).items():
            if not np.isfinite(value).all():
                raise ScanError(f"{name} of a scanner must be a number, got {value}")
        for name in ("dynamic_range_db", "gray_gamma", "side_lobe_mm", "haze_mm"):
            if getattr(self, name) <= 0:
                raise ScanError(f"{name} of a scanner must be above 0, got {getattr(self, name)}")
        for name in ("gray_contrast", "speckle_reduction"):
            if not 0 <= getattr(self, name) <= 1:
                raise ScanError(f"{name} must be from 0 to 1, got {getattr(self, name):g}")
        if self.attenuation_scale < 0 or not self.sliders_db:
            raise ScanError("a scanner needs an attenuation of 0 or more and at least one slider")
        if self.persistence_frames < 1 or self.persistence_frames % 2 == 0:
            raise ScanError(
                "persistence must average an odd number of frames (1, 3, 5), got"
                f" {self.persistence_frames}"
            )


@dataclass(frozen=True, eq=False)
class SideLobes:
    """Weak images of each echo beside it.

    Attributes:
        lags: Columns from the echo.
        delays: Rows below it: the way there is longer.
        amplitudes: In parts of the echo, with random phases.
    """

    lags: Int64[np.ndarray, " lobes"]
    delays: Int64[np.ndarray, " lobes"]
    amplitudes: Complex64[np.ndarray, " lobes"]


@dataclass(frozen=True, eq=False)
class PreparedScanner:
    """A scanner with everything worked out that does not change within a sweep.

    Attributes:
        scanner: Its settings.
        first: Per tissue, what is left of an amplitude between face and first row.
        half: Per tissue, what is left after half a row.
        gain: Amplification of each row.
        haze: Reverberation near the probe.
        noise: Amplitude of the electronic noise's real and imaginary part.
        noise_blur: Correlation of noise from column to column.
        side_lobes: Where they are and how strong.
        row_mm: From row to row.
        column_mm: From column to column; of a sector, at the beam's ``sector_depth_mm``.
        pulse_rows: Standard deviation of the pulse's envelope.
        row_phase_rad: Change of an echo's phase from row to row.
    """

    scanner: Scanner
    first: Float32[np.ndarray, "256"]
    half: Float32[np.ndarray, "256"]
    gain: Float32[np.ndarray, " rows"]
    haze: Complex64[np.ndarray, "rows columns"]
    noise: float
    noise_blur: float
    side_lobes: SideLobes
    row_mm: float
    column_mm: float
    pulse_rows: float
    row_phase_rad: float


def prepare_scanner(
    scanner: Scanner, beam: Beam, grid: PixelGrid | SectorGrid, generator: np.random.Generator
) -> PreparedScanner:
    """Return the scanner, ready for the frames of one sweep.

    Args:
        scanner: Its settings.
        beam: Of the probe.
        grid: Where the samples lie.
        generator: Draws the haze, which is the same in all frames.
    """
    depths, row_mm, column_mm = line_geometry(grid, beam)
    loss = two_way_loss_db_per_mm(beam.center_frequency_hz, scanner.attenuation_scale)
    sliders = np.linspace(depths[0], depths[-1], len(scanner.sliders_db))
    gain_db = scanner.tgc_db_per_mm * depths + np.interp(depths, sliders, scanner.sliders_db)
    return PreparedScanner(
        scanner=scanner,
        first=_amplitude(-loss * max(depths[0], 0.0)),
        half=_amplitude(-loss * row_mm / 2),
        gain=_amplitude(gain_db),
        haze=_haze(scanner, depths, column_mm, _columns(grid), generator),
        noise=float(10 ** (scanner.noise_db / 20) / np.sqrt(2)),
        noise_blur=float(np.exp(-column_mm / beam.lateral_fwhm_mm)),
        side_lobes=_side_lobes(scanner, beam, row_mm, column_mm, generator),
        row_mm=row_mm,
        column_mm=column_mm,
        pulse_rows=beam.axial_fwhm_mm / (2 * np.sqrt(2 * np.log(2))) / row_mm,
        row_phase_rad=-4 * np.pi / beam.wavelength_mm * row_mm,
    )


def fill_with_gel(tissue: UInt8[np.ndarray, "rows columns"]) -> None:
    """Make gel, in place, of what is outside of the body between it and the face."""
    touched = np.maximum.accumulate(tissue != Tissue.OUTSIDE, axis=0)
    tissue[~touched] = Tissue.GEL


def receive_echoes(
    iq: Complex64[np.ndarray, "rows columns"],
    tissue: UInt8[np.ndarray, "rows columns"],
    prepared: PreparedScanner,
    generator: np.random.Generator,
) -> Complex64[np.ndarray, "rows columns"]:
    """Return IQ after the way through tissue and the scanner's amplifiers.

    Args:
        iq: Echoes as if nothing attenuated.
        tissue: Label of each pixel, :class:`Tissue`.
        prepared: The scanner.
        generator: Draws the electronic noise.

    Raises:
        ScanError: If an echo is not a number.
    """
    echoes = with_bone(iq, tissue, prepared)
    noise = generator.standard_normal((*iq.shape, 2), np.float32)
    noise *= np.float32(prepared.noise)
    received = np.empty_like(echoes)
    receive(
        echoes,
        tissue,
        prepared.first,
        prepared.half,
        prepared.side_lobes.lags,
        prepared.side_lobes.delays,
        prepared.side_lobes.amplitudes,
        prepared.haze,
        noise,
        np.float32(prepared.noise_blur),
        prepared.gain,
        np.empty_like(echoes),
        received,
    )
    if not np.isfinite(received.view(np.float32).sum()):
        raise ScanError("the simulated echoes hold values that are not numbers")
    return received


def remaining_amplitude(
    tissue: UInt8[np.ndarray, "rows columns"], prepared: PreparedScanner
) -> Float32[np.ndarray, "rows columns"]:
    """Return the part of an echo's amplitude that comes back from each pixel, without gain."""
    left = np.empty(tissue.shape, np.float32)
    lose(tissue, prepared.first, prepared.half, left)
    return left


def detect(
    received: Sequence[Complex64[np.ndarray, "rows columns"]], scanner: Scanner
) -> Float32[np.ndarray, "rows columns"]:
    """Return the amplitude before log compression.

    Args:
        received: IQ of the frames over which persistence averages.
        scanner: Says how much speckle is reduced.
    """
    amplitude = np.abs(received[0])
    for iq in received[1:]:
        amplitude += np.abs(iq)
    amplitude /= np.float32(len(received))
    if scanner.speckle_reduction > 0:
        smooth = lee_filter(amplitude, LEE_WINDOW)
        amplitude += np.float32(scanner.speckle_reduction) * (smooth - amplitude)
    return amplitude


def gray_levels(
    amplitude: Float32[np.ndarray, "rows columns"], scanner: Scanner
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the B-mode image of an amplitude: log compression, then the gray map."""
    levels = log_compress(amplitude, 1.0, scanner.dynamic_range_db, scanner.gain_db)
    return gray_map(scanner)[levels]


def gray_map(scanner: Scanner) -> UInt8[np.ndarray, "256"]:
    """Return the gray level shown for each level of the log compression."""
    level = (np.arange(256) / 255) ** scanner.gray_gamma
    curved = level + scanner.gray_contrast * (level * level * (3 - 2 * level) - level)
    return np.rint(255 * curved).astype(np.uint8)


def line_geometry(grid: PixelGrid | SectorGrid, beam: Beam) -> tuple[np.ndarray, float, float]:
    """Return the depth of each row, the distance of rows and that of columns, mm."""
    if isinstance(grid, PixelGrid):
        return grid.axial_mm, grid.spacing_mm[1], grid.spacing_mm[0]
    column_mm = grid.line_spacing_rad * (grid.radius_mm + beam.sector_depth_mm)
    return grid.depths_mm, grid.sample_spacing_mm, column_mm


def _columns(grid: PixelGrid | SectorGrid) -> int:
    return grid.columns if isinstance(grid, PixelGrid) else grid.lines


def _amplitude(level_db: np.ndarray) -> Float32[np.ndarray, " numbers"]:
    return (10 ** (np.asarray(level_db) / 20)).astype(np.float32)


def _side_lobes(
    scanner: Scanner,
    beam: Beam,
    row_mm: float,
    column_mm: float,
    generator: np.random.Generator,
) -> SideLobes:
    """Return side lobes on either side, each one for the gap to the next."""
    edges = beam.lateral_fwhm_mm * SIDE_LOBE_GROWTH ** np.arange(SIDE_LOBES + 1)
    away = np.sqrt(edges[1:] * edges[:-1]) * generator.uniform(0.95, 1.05, (2, SIDE_LOBES))
    level = 10 ** (scanner.side_lobe_db / 20) * np.exp(-away / scanner.side_lobe_mm)
    level *= np.sqrt(np.diff(edges) / beam.lateral_fwhm_mm)
    turn = np.exp(2j * np.pi * generator.random((2, SIDE_LOBES)))
    lags = np.rint(away / column_mm).astype(np.int64) * np.array([[-1], [1]])
    delays = np.rint(away**2 / (2 * SIDE_LOBE_DEPTH_MM) / row_mm).astype(np.int64)
    return SideLobes(lags.ravel(), delays.ravel(), (level * turn).ravel().astype(np.complex64))


def _haze(
    scanner: Scanner,
    depths_mm: np.ndarray,
    column_mm: float,
    columns: int,
    generator: np.random.Generator,
) -> Complex64[np.ndarray, "rows columns"]:
    """Return bands that are wide across and thin in depth, fading away from the face."""
    noise = generator.standard_normal((2, len(depths_mm), columns))
    width = max(HAZE_WIDTH_MM / column_mm, 1e-3)
    away = np.abs(np.subtract.outer(np.arange(columns), np.arange(columns))) / width
    smooth = noise @ np.exp(-0.5 * away**2)
    smooth /= np.sqrt((smooth**2).sum(axis=0).mean())
    level = 10 ** (scanner.haze_db / 20) * np.exp(-np.maximum(depths_mm, 0) / scanner.haze_mm)
    return ((smooth[0] + 1j * smooth[1]) * level[:, np.newaxis]).astype(np.complex64)


def with_bone(
    iq: Complex64[np.ndarray, "rows columns"],
    tissue: UInt8[np.ndarray, "rows columns"],
    prepared: PreparedScanner,
) -> Complex64[np.ndarray, "rows columns"]:
    """Return a copy of the echoes with the mirror-like ones of bone."""
    surface = np.empty(tissue.shape[1], np.int64)
    first_rows(tissue, int(Tissue.BONE), surface)
    echoes = iq.copy()
    if (surface < len(tissue)).any():
        add_bone(
            echoes,
            surface,
            prepared.column_mm / prepared.row_mm,
            max(int(BONE_REACH_MM / prepared.column_mm), 1),
            10 ** (prepared.scanner.bone_db / 20),
            BONE_SLOPE,
            prepared.pulse_rows,
            prepared.row_phase_rad,
        )
    return echoes

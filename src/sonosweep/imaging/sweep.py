"""A whole sweep's channel data as a scan: B-mode, power Doppler and photoacoustic frames.

Frames are beamformed when they are read, one at a time, with delays that are computed once.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.geometry import pose_from_parts
from sonosweep.imaging.beamform import (
    DEFAULT_SETTINGS,
    BeamformSettings,
    beamform,
    prepare_beamformer,
)
from sonosweep.imaging.bmode import check_compression, log_compress
from sonosweep.imaging.clutter import Rank, check_rank, svd_filter
from sonosweep.imaging.doppler import power_doppler
from sonosweep.imaging.photoacoustic import band_pass
from sonosweep.imaging.pixel_grid import PAPER_GRID, PixelGrid
from sonosweep.imaging.prepared import BYTES_PER_PAIR
from sonosweep.scan import (
    Calibration,
    ChannelData,
    ChannelSweep,
    Companion,
    Frames,
    LazyFrames,
    Scan,
    modalities,
)

FrameImage = Callable[[int], np.ndarray]

ONE_WAY_SETTINGS = BeamformSettings(f_number=1.0)

LARGEST_TABLE_BYTES = 1 << 30
"""Delays that take more are computed for each frame anew."""
SAMPLED_FRAMES = 7
"""So many frames, spread over the sweep, say which amplitude is white."""
WHITE_PERCENTILE = 99.9
B_MODE_RANGE_DB, PHOTOACOUSTIC_RANGE_DB = 60.0, 40.0


@dataclass(frozen=True)
class SweepImaging:
    """How a sweep's channel data become frames.

    Attributes:
        grid: Where the pixels of all modalities lie.
        echoes: Beamforming of B-mode and power Doppler.
        photoacoustic: Beamforming of photoacoustic frames.
        photoacoustic_band_hz: What to keep of photoacoustic samples; ``None`` filters
            nothing but what demodulation does.
        b_mode_range_db: Between black and white; ``None``: 60 dB for echoes, 40 dB where
            photoacoustic frames stand in for them.
        power_doppler_range_db: Between black and white.
        b_mode_white: Amplitude that is white; ``None`` measures it, once for the sweep.
        power_doppler_white: The same for the square root of power.
        clutter_rank: Of the filter before power Doppler.
        keep_amplitude: Whether the amplitude before log compression becomes a companion.
        threads: Of the beamforming; the numbers do not depend on it.
    """

    grid: PixelGrid = PAPER_GRID
    echoes: BeamformSettings = DEFAULT_SETTINGS
    photoacoustic: BeamformSettings = ONE_WAY_SETTINGS
    photoacoustic_band_hz: tuple[float, float] | None = None
    b_mode_range_db: float | None = None
    power_doppler_range_db: float = 30.0
    b_mode_white: float | None = None
    power_doppler_white: float | None = None
    clutter_rank: Rank = "auto"
    keep_amplitude: bool = False
    threads: int = 1

    def __post_init__(self) -> None:
        """Check the gray scales.

        Raises:
            ScanError: If a range or white is not positive.
        """
        b_mode_range_db = 1.0 if self.b_mode_range_db is None else self.b_mode_range_db
        for white, range_db in (
            (self.b_mode_white, b_mode_range_db),
            (self.power_doppler_white, self.power_doppler_range_db),
        ):
            check_compression(1.0 if white is None else white, range_db)


def beamform_sweep(sweep: ChannelSweep, settings: SweepImaging | None = None) -> Scan:
    """Return a sweep as a scan whose frames are beamformed when read.

    ``frames`` is log-compressed B-mode, ``companions["power_doppler"]`` log-compressed
    power after the clutter filter, both with the same white over the whole sweep, and
    ``companions["photoacoustic"]`` the linear amplitude (float32). A sweep without B-mode
    gets it from the mean of its Doppler pulses; one with nothing but photoacoustics shows
    these, log-compressed. ``notes`` say how each was made.

    Args:
        sweep: Channel data of one or more modalities.
        settings: How; see there.

    Raises:
        ScanError: If the geometry does not fit the samples or the image, some of the first
            samples are not numbers, or the pulses of an ensemble differ. The same, with the
            number of the frame, when a frame is read.
    """
    chosen = settings or SweepImaging()
    images = _images(sweep, chosen)
    companions: dict[str, LazyFrames] = {}
    notes = dict(sweep.notes)
    b_mode, made = images.pop("b_mode")
    count = _frame_count(sweep)
    if chosen.keep_amplitude:
        companions["amplitude"] = _Images(b_mode, count, chosen.grid, np.dtype(np.float32))
    usual_db = B_MODE_RANGE_DB if _has_echoes(sweep) else PHOTOACOUSTIC_RANGE_DB
    range_db = usual_db if chosen.b_mode_range_db is None else chosen.b_mode_range_db
    frames, scale = _gray(b_mode, count, chosen.grid, range_db, chosen.b_mode_white)
    notes["b_mode"] = f"{made}; {scale}"
    if "power_doppler" in images:
        power, made = images["power_doppler"]
        companions["power_doppler"], scale = _gray(
            power, count, chosen.grid, chosen.power_doppler_range_db, chosen.power_doppler_white
        )
        notes["power_doppler"] = f"{made}; {scale}"
    if "photoacoustic" in images:
        amplitude, made = images["photoacoustic"]
        companions["photoacoustic"] = _Images(amplitude, count, chosen.grid, np.dtype(np.float32))
        notes["photoacoustic"] = f"{made}; linear amplitude"
    return Scan(
        name=sweep.name,
        frames=frames,
        calibration=Calibration(chosen.grid.spacing_mm),
        timestamps_s=_timestamps(sweep),
        image_to_reference=_image_poses(sweep.image_to_reference, chosen.grid),
        tracked=sweep.tracked,
        subject=sweep.subject,
        companions={
            name: Companion(stack, chosen.grid.spacing_mm) for name, stack in companions.items()
        },
        notes=notes,
    )


def _images(sweep: ChannelSweep, settings: SweepImaging) -> dict[str, tuple[FrameImage, str]]:
    """Return what gives the amplitude image of a frame, and how, for each modality."""
    images: dict[str, tuple[FrameImage, str]] = {}
    if sweep.photoacoustic is not None:
        iq = _beamformed(sweep.photoacoustic, settings.photoacoustic, settings)
        made = _words(sweep.photoacoustic, settings.photoacoustic)
        images["photoacoustic"] = (lambda k: np.abs(iq(k)), made)
        images["b_mode"] = (lambda k: np.abs(iq(k)), f"photoacoustic, there are no echoes; {made}")
    if sweep.power_doppler is not None:
        images.update(_doppler_images(sweep.power_doppler, settings))
    if sweep.b_mode is not None:
        echo = _beamformed(sweep.b_mode, settings.echoes, settings)
        made = _words(sweep.b_mode, settings.echoes)
        images["b_mode"] = (lambda k: np.abs(echo(k)), made)
    return images


def _doppler_images(data: ChannelData, settings: SweepImaging) -> dict[str, tuple[FrameImage, str]]:
    """Return the images that an ensemble gives: of what flows, and of what stays."""
    rank = settings.clutter_rank
    check_rank(data.samples.shape[1], rank)
    _check_repetitions(data)
    pulses = _beamformed(data, replace(settings.echoes, compound=False), settings)
    made = _words(data, settings.echoes)
    filtered = f"{made}; singular value clutter filter of rank {rank}"
    return {
        "power_doppler": (lambda k: np.sqrt(power_doppler(svd_filter(pulses(k), rank))), filtered),
        "b_mode": (lambda k: np.abs(pulses(k).mean(axis=0)), f"mean of Doppler pulses; {made}"),
    }


def _beamformed(data: ChannelData, how: BeamformSettings, settings: SweepImaging) -> FrameImage:
    """Return what beamforms a frame of channel data."""
    band = settings.photoacoustic_band_hz if data.transmit_delays_s is None else None
    if band is not None:
        data = replace(data, samples=_BandPassed(data.samples, data.sampling_frequency_hz, band))
    pixels = settings.grid.columns * settings.grid.rows
    most_bytes = BYTES_PER_PAIR * sum(data.samples.shape[1:3]) * pixels
    if most_bytes > LARGEST_TABLE_BYTES:
        return lambda k: beamform(data, k, settings.grid, how, threads=settings.threads)
    prepared = prepare_beamformer(data, settings.grid, how, threads=settings.threads)
    return lambda k: prepared.apply(np.asarray(data.samples[k]))


def _gray(
    image: FrameImage, count: int, grid: PixelGrid, range_db: float, white: float | None
) -> tuple[LazyFrames, str]:
    """Return log-compressed frames, and their gray scale in words."""
    source = _Images(image, count, grid, np.dtype(np.float32))
    reference = white or _white(source)

    def gray(frame: int) -> np.ndarray:
        return log_compress(source[frame], reference, range_db)

    words = f"255 is an amplitude of {reference:.6g}, 0 is {range_db:g} dB less, linear in dB"
    return _Images(gray, count, grid, np.dtype(np.uint8)), words


def _white(frames: Frames) -> float:
    """Return the amplitude that few pixels exceed, in frames spread over the sweep."""
    sampled = np.unique(np.linspace(0, len(frames) - 1, SAMPLED_FRAMES).round().astype(int))
    brightest = max(float(np.percentile(frames[int(k)], WHITE_PERCENTILE)) for k in sampled)
    return brightest if brightest > 0 else 1.0


class _Images(LazyFrames):
    """Frames that a function makes."""

    def __init__(self, image: FrameImage, count: int, grid: PixelGrid, dtype: np.dtype) -> None:
        super().__init__((count, grid.rows, grid.columns), dtype)
        self._image = image

    def _read(self, frame: int) -> np.ndarray:
        try:
            return self._image(frame).astype(self.dtype, copy=False)
        except ScanError as error:
            raise ScanError(f"frame {frame}: {error}") from error


class _BandPassed(LazyFrames):
    """Samples of which a band is left."""

    def __init__(self, samples: Frames, rate_hz: float, band_hz: tuple[float, float]) -> None:
        super().__init__(samples.shape, np.dtype(np.float32))
        self._samples, self._rate_hz, self._band_hz = samples, rate_hz, band_hz

    def _read(self, frame: int) -> np.ndarray:
        return band_pass(np.asarray(self._samples[frame]), self._rate_hz, self._band_hz)


def _has_echoes(sweep: ChannelSweep) -> bool:
    return sweep.b_mode is not None or sweep.power_doppler is not None


def _frame_count(sweep: ChannelSweep) -> int:
    count = len(next(iter(modalities(sweep).values())).samples)
    if count == 0:
        raise ScanError(f"'{sweep.name}' has no frames: there is nothing to beamform")
    return count


def _timestamps(sweep: ChannelSweep) -> Float[Tensor, " frames"] | None:
    every = (data.timestamps_s for data in modalities(sweep).values())
    return next((times for times in every if times is not None), None)


def _image_poses(
    plane_to_reference: Float[Tensor, "frames 4 4"] | None, grid: PixelGrid
) -> Float[Tensor, "frames 4 4"] | None:
    """Return poses whose origin is the first pixel instead of the array's face."""
    if plane_to_reference is None:
        return None
    origin = torch.tensor([*grid.origin_mm, 0.0], dtype=torch.float64)
    return plane_to_reference @ pose_from_parts(torch.eye(3, dtype=torch.float64), origin)


def _check_repetitions(data: ChannelData) -> None:
    """Check that the pulses of an ensemble are repetitions of one another."""
    for what, values in (("delays", data.transmit_delays_s), ("start times", data.start_time_s)):
        if values is not None and not torch.equal(
            values.nan_to_num(), values[:1].expand_as(values).nan_to_num()
        ):
            raise ScanError(
                f"the pulses of the ensemble of '{data.name}' have different transmit {what}: power"
                " Doppler needs repetitions of one transmit"
            )


def _words(data: ChannelData, how: BeamformSettings) -> str:
    transmits = data.samples.shape[1]
    ways = "one-way " if data.transmit_delays_s is None else ""
    aperture = "all elements" if how.f_number is None else f"f-number {how.f_number:g}"
    speed = how.sound_speed_m_per_s or data.sound_speed_m_per_s
    counted = f"{transmits} transmit" + ("s" if transmits > 1 else "")
    return f"{ways}delay-and-sum of {counted}, {aperture}, {speed:g} m/s"

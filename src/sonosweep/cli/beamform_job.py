"""One sweep of channel data, beamformed and written."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sonosweep.cli.beamform import BeamformingOptions, PixelOptions
from sonosweep.cli.output import check_free
from sonosweep.cli.progress import progress
from sonosweep.errors import ScanError
from sonosweep.imaging.beamform import BeamformSettings
from sonosweep.imaging.field_of_view import field_of_view, surrounding_radius_mm
from sonosweep.imaging.sweep import SweepImaging, beamform_sweep
from sonosweep.io import write_scan_as
from sonosweep.io.open import HDF5
from sonosweep.io.open_channel_data import open_channel_data
from sonosweep.io.write_scan import check_suffix, poses_beside
from sonosweep.reconstruct.blocks import thread_count
from sonosweep.scan import ChannelSweep, Frames, LazyFrames, Scan, modalities

MODALITY_NAMES = {
    "b_mode": "B-mode",
    "power_doppler": "power Doppler",
    "photoacoustic": "photoacoustic",
}
ECHO_F_NUMBER, PHOTOACOUSTIC_F_NUMBER = 1.5, 1.0


def run_beamform(
    data: Path,
    output: Path,
    pixels: PixelOptions,
    options: BeamformingOptions,
    keep_subject: bool,
    force: bool,
) -> tuple[str, dict[str, Any]]:
    """Beamform a sweep into a file; returns the summary line and the same as facts.

    Raises:
        ScanError: If the channel data contradict themselves or the options.
        FormatError: If the input cannot be read or the output not be written.
    """
    check_suffix(output)
    check_free(output, force)
    sweep = open_channel_data(data, wavelength_nm=options.wavelength_nm)
    _refuse_idle(sweep, options)
    if options.sound_speed is not None:  # what the reader assumed is not what is used
        notes = {about: note for about, note in sweep.notes.items() if about != "sound speed"}
        sweep = replace(sweep, notes=notes)
    beside = poses_beside(output)
    if beside is not None and sweep.image_to_reference is not None:
        check_free(beside, force)
    scan = beamform_sweep(sweep, _imaging(sweep, pixels, options))
    left_out = [] if output.suffix.lower() in HDF5 else sorted(scan.companions)
    written = replace(scan, companions={}) if left_out else scan
    with progress("beamforming") as show:
        files = write_scan_as(_counted(written, show), output, keep_subject=keep_subject)
    found = list(modalities(sweep))
    return _line(scan, files, found, left_out), {
        "scan": scan.name,
        "frames": len(scan.frames),
        "columns": scan.frames.shape[2],
        "rows": scan.frames.shape[1],
        "spacing_mm": scan.calibration and scan.calibration.spacing_mm,
        "modalities": found,
        "companions": sorted(written.companions),
        "left_out": left_out,
        "notes": dict(scan.notes),
        "outputs": [str(file) for file in files],
    }


def _refuse_idle(sweep: ChannelSweep, options: BeamformingOptions) -> None:
    """Refuse options that have nothing to act on: nobody shall think that they did."""
    about = {
        "power_doppler": ("clutter_rank", "power_doppler_range_db"),
        "photoacoustic": ("photoacoustic_band_mhz", "wavelength_nm"),
    }
    for modality, names in about.items():
        given = next((name for name in names if getattr(options, name) is not None), None)
        if given is not None and modality not in modalities(sweep):
            option, told = given.replace("_", "-"), MODALITY_NAMES[modality]
            raise ScanError(f"'{sweep.name}' holds no {told} data for --{option} to act on")


def _imaging(
    sweep: ChannelSweep, pixels: PixelOptions, options: BeamformingOptions
) -> SweepImaging:
    """Return how to beamform: what the options say, and what suits the array otherwise."""
    first = next(iter(modalities(sweep).values()))
    speed = BeamformSettings(sound_speed_m_per_s=options.sound_speed).sound_speed_m_per_s
    first = first if speed is None else replace(first, sound_speed_m_per_s=speed)
    band_mhz, doppler_db = options.photoacoustic_band_mhz, options.power_doppler_range_db
    surrounded = surrounding_radius_mm(first.probe) is not None

    def settings(usual: float) -> BeamformSettings:
        asked = options.f_number
        if asked == "all" or (asked is None and surrounded):
            return BeamformSettings(None, sound_speed_m_per_s=speed)
        return BeamformSettings(usual if asked is None else asked, sound_speed_m_per_s=speed)

    return SweepImaging(
        grid=field_of_view(first, pixels.columns, pixels.rows, pixels.pixel_mm, pixels.depth_mm),
        echoes=settings(ECHO_F_NUMBER),
        photoacoustic=settings(PHOTOACOUSTIC_F_NUMBER),
        photoacoustic_band_hz=band_mhz and (band_mhz[0] * 1e6, band_mhz[1] * 1e6),
        b_mode_range_db=options.dynamic_range_db,
        power_doppler_range_db=30.0 if doppler_db is None else doppler_db,
        clutter_rank="auto" if options.clutter_rank is None else options.clutter_rank,
        keep_amplitude=options.amplitude,
        threads=thread_count(None),
    )


class _Counted(LazyFrames):
    """Frames that say when one was read."""

    def __init__(self, frames: Frames, was_read: Callable[[], None]) -> None:
        super().__init__(frames.shape, frames.dtype)
        self._frames, self._was_read = frames, was_read

    def _read(self, frame: int) -> np.ndarray:
        pixels = self._frames[frame]
        self._was_read()
        return pixels


def _counted(scan: Scan, show: Callable[[int, int], None]) -> Scan:
    """Return the scan, whose frames show how many of all were read."""
    total, done = len(scan.frames) * (1 + len(scan.companions)), 0

    def was_read() -> None:
        nonlocal done
        done += 1
        show(done, total)

    return replace(
        scan,
        frames=_Counted(scan.frames, was_read),
        companions={
            name: replace(companion, frames=_Counted(companion.frames, was_read))
            for name, companion in scan.companions.items()
        },
    )


def _line(scan: Scan, files: tuple[Path, ...], found: list[str], left_out: list[str]) -> str:
    count, rows, columns = scan.frames.shape
    assert scan.calibration is not None
    size = f"{columns} x {rows} pixels of {scan.calibration.spacing_mm[0]:.4g} mm"
    told = ", ".join(MODALITY_NAMES[name] for name in found)
    lost = f"; {', '.join(left_out)} left out: only .h5 holds companions" if left_out else ""
    names = ", ".join(str(file) for file in files)
    return f"{scan.name}: {count} frames of {size}, {told} -> {names}{lost}"

"""Photoacoustic time series in the format of the IPASC consortium (HDF5).

=============================================== ==========================================
``binary_time_series_data``                     (elements, samples, wavelengths, frames); the
                                                last two axes may lack if of length 1
``meta_data/ad_sampling_rate``                  Hz
``meta_data/acquisition_wavelengths``           m
``meta_data/speed_of_sound``                    m/s, one number or a mean is taken; 1500 if
                                                absent
``meta_data/measurement_timestamps``            s, one per frame, if known
``meta_data_device/detectors/*/``               one group per element, in alphabetical order
``.../detector_position``                       x1, x2, x3 in m
``.../detector_orientation``                    where it looks, if known
``.../detector_geometry``                       its size in m, if known
``.../frequency_response``                      (frequency, response), if known
``meta_data_device/general/field_of_view``      (3, 2) or 6 numbers, m: tells where the
                                                elements look if they do not
=============================================== ==========================================

The elements' coordinates are turned into ours (:mod:`sonosweep.io.element_axes`); their
origin stays. Fields that are not known may hold the text ``None``.

References:
    Gröhl J et al., "The IPASC data format: a consensus data format for photoacoustic
    imaging", Photoacoustics 26:100339, 2022.
"""

import os
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.channel_frames import HDF5ChannelFrames, channel_frames
from sonosweep.io.element_axes import plane_coordinates
from sonosweep.io.hdf5_access import get_dataset, open_hdf5, read_array
from sonosweep.scan import ChannelData, ChannelSweep, Probe

SAMPLES = "binary_time_series_data"
DETECTORS = "meta_data_device/detectors"
MM_PER_M = 1000.0
NM_PER_M = 1e9
SAME_WAVELENGTH_NM = 0.01
ASSUMED_SPEED_M_PER_S = 1500.0
ASSUMED_FREQUENCY_HZ = 5e6
MOST_ELEMENTS = 10_000
LONGEST_DIRECTION = 1e6


def is_ipasc(path: str | os.PathLike) -> bool:
    """Say whether an HDF5 file holds photoacoustic data in IPASC's format."""
    try:
        with open_hdf5(path) as file:
            return SAMPLES in file and "meta_data_device" in file
    except SonosweepError:
        return False


def read_ipasc(path: str | os.PathLike, *, wavelength_nm: float | None = None) -> ChannelSweep:
    """Return an IPASC recording as photoacoustic channel data; samples are read when indexed.

    Args:
        path: The file.
        wavelength_nm: Which frames to take; needed if there are several wavelengths.

    Raises:
        FormatError: If something is missing or of another form, the array is not plane, or
            the wavelength is not there.
        ScanError: If the geometry does not fit the samples.
    """
    file = Path(path)
    with open_hdf5(file) as opened:
        stored = get_dataset(opened, SAMPLES)
        if not 2 <= len(stored.shape) <= 4:
            raise FormatError(
                f"{SAMPLES} of '{file.name}' must be elements, samples, wavelengths and frames, but"
                f" has the shape {stored.shape}"
            )
        place, taken_nm = _choose(opened, stored, wavelength_nm, file)
        samples = _samples(stored, place)
        notes = {} if taken_nm is None else {"wavelength": f"{taken_nm:g} nm"}
        probe = _probe(opened, file, notes)
        rate_hz = _numbers(opened, "meta_data/ad_sampling_rate")
        if rate_hz is None or rate_hz.size != 1:
            raise FormatError(f"'{file.name}' lacks the number meta_data/ad_sampling_rate")
        data = ChannelData(
            name=file.stem,
            samples=samples,
            probe=probe,
            sampling_frequency_hz=float(rate_hz[0]),
            start_time_s=torch.zeros(1, dtype=torch.float64),
            sound_speed_m_per_s=_speed(opened, notes),
            timestamps_s=_times(opened, len(samples)),
        )
    return ChannelSweep(name=file.stem, photoacoustic=data, notes=notes)


def _samples(stored: h5py.Dataset, place: int) -> HDF5ChannelFrames:
    order: tuple[str | int, ...] = ("elements", "samples", place, "frames")
    return channel_frames([stored], order[: len(stored.shape)])


def _choose(
    opened: h5py.File, stored: h5py.Dataset, wanted_nm: float | None, file: Path
) -> tuple[int, float | None]:
    """Return the place of a wavelength along its axis, and which it is."""
    count = stored.shape[2] if len(stored.shape) > 2 else 1
    known = _numbers(opened, "meta_data/acquisition_wavelengths")
    if known is None or known.size != count:
        if count > 1 or wanted_nm is not None:
            raise FormatError(
                f"'{file.name}' has {count} wavelengths, but meta_data does not tell which"
            )
        return 0, None
    known = known * NM_PER_M
    told = ", ".join(f"{value:g}" for value in known[:20])
    if wanted_nm is None:
        if count > 1:
            raise FormatError(
                f"'{file.name}' has frames at {told} nm: say which with wavelength_nm"
            )
        return 0, float(known[0])
    places = np.flatnonzero(abs(known - wanted_nm) < SAME_WAVELENGTH_NM)
    if len(places) == 0:
        raise FormatError(f"'{file.name}' has no frame at {wanted_nm:g} nm, only at {told} nm")
    return int(places[0]), float(known[places[0]])


def _probe(opened: h5py.File, file: Path, notes: dict[str, str]) -> Probe:
    detectors = opened.get(DETECTORS)
    if not isinstance(detectors, h5py.Group) or not 2 <= len(detectors) <= MOST_ELEMENTS:
        raise FormatError(f"'{file.name}' does not tell where its elements are: {DETECTORS}")
    elements = [detectors[name] for name in sorted(detectors)]
    found = [_numbers(element, "detector_position") for element in elements]
    rows = [position for position in found if position is not None and position.size == 3]
    if len(rows) < len(elements):
        raise FormatError(f"an element of '{file.name}' has no detector_position of 3 numbers")
    positions_m = np.array(rows)
    plane_m = plane_coordinates(positions_m, _looks_along(elements, opened, positions_m), file.name)
    pitch_m = float(np.median(np.linalg.norm(np.diff(plane_m, axis=0), axis=1)))
    return Probe(
        name="IPASC",
        element_positions_mm=torch.from_numpy(plane_m * MM_PER_M),
        element_width_mm=pitch_m * MM_PER_M,
        center_frequency_hz=_frequency(elements[0], notes),
    )


def _looks_along(
    elements: list[h5py.Group], opened: h5py.File, positions_m: np.ndarray
) -> np.ndarray | None:
    """Return the mean direction in which the elements look, ``None`` if nothing tells."""
    found = [_numbers(element, "detector_orientation") for element in elements]
    rows = [row for row in found if row is not None and _is_direction(row)]
    if len(rows) == len(elements):
        return np.mean([row / np.linalg.norm(row) for row in rows], axis=0)
    field = _numbers(opened, "meta_data_device/general/field_of_view")
    if field is not None and field.size == 6:
        towards = field.reshape(3, 2).mean(axis=1) - positions_m.mean(axis=0)
        if _is_direction(towards):
            return towards / np.linalg.norm(towards)
    return None


def _is_direction(row: np.ndarray) -> bool:
    return row.size == 3 and 0 < float(np.abs(row).max()) < LONGEST_DIRECTION


def _frequency(element: h5py.Group, notes: dict[str, str]) -> float:
    """Return where the elements respond most."""
    response = element.get("frequency_response")
    if isinstance(response, h5py.Dataset) and response.dtype.kind in "iuf":
        shape = response.shape
        if shape is not None and len(shape) == 2 and shape[0] == 2 and 0 < shape[1] < 10**6:
            frequencies, heights = np.asarray(response[()], np.float64)
            if np.isfinite(heights).all() and frequencies[heights.argmax()] > 0:
                return float(frequencies[heights.argmax()])
    notes["center frequency"] = f"assumed {ASSUMED_FREQUENCY_HZ / 1e6:g} MHz: the file tells none"
    return ASSUMED_FREQUENCY_HZ


def _speed(opened: h5py.File, notes: dict[str, str]) -> float:
    speed = _numbers(opened, "meta_data/speed_of_sound")
    if speed is None or not speed.mean() > 0:
        notes["sound speed"] = f"assumed {ASSUMED_SPEED_M_PER_S:g} m/s: the file tells none"
        return ASSUMED_SPEED_M_PER_S
    return float(speed.mean())


def _times(opened: h5py.File, count: int) -> Tensor | None:
    times = _numbers(opened, "meta_data/measurement_timestamps")
    if times is None or times.size != count or (np.diff(times) <= 0).any():
        return None
    return torch.from_numpy(times - times[0])


def _numbers(group: h5py.Group, name: str) -> np.ndarray | None:
    """Return all numbers of a field, ``None`` if it is absent or the text ``None``."""
    node = group.get(name)
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "iuf" or node.shape is None:
        return None
    values = read_array(node.parent, node.name.rpartition("/")[2], (None,) * len(node.shape))
    if not np.isfinite(values).all():
        raise FormatError(f"'{name}' in '{Path(group.file.filename).name}' are not all numbers")
    return values.ravel() if values.size else None

"""Plane-wave channel data of the PICMUS challenge (HDF5): group ``US/US_DATASET0000``.

======================== ==================================================================
``data/real``            (angles, elements, samples), with frames in front if there are any
``data/imag``            the same, for IQ samples; zeros or absent for RF
``angles``               rad, one for each plane wave
``initial_time``         s, of the first sample
``sampling_frequency``   Hz
``modulation_frequency`` Hz, carrier removed from IQ samples; 0 for RF
``sound_speed``          m/s
``probe_geometry``       m: x, y, z (into the body) × elements
``PRF``                  Hz, if known
======================== ==================================================================

Numbers are arrays of one. Time zero is when the wave passes the middle of the array. Neither
the elements' width nor the center frequency is in the file: the notes say what stands in.

References:
    Liebgott H, Rodriguez-Molares A, Cervenansky F, Jensen JA, Bernard O, "Plane-wave imaging
    challenge in medical ultrasound", IEEE IUS 2016.
"""

import os
from pathlib import Path

import h5py
import numpy as np
import torch

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.channel_frames import HDF5ChannelFrames, channel_frames
from sonosweep.io.element_axes import check_places
from sonosweep.io.hdf5_access import get_dataset, open_hdf5, read_array
from sonosweep.scan import ChannelData, ChannelSweep, Probe

GROUP = "US/US_DATASET0000"
MM_PER_M = 1000.0
SAMPLES_PER_PERIOD = 4  # of the machine that recorded the challenge


def is_picmus(path: str | os.PathLike) -> bool:
    """Say whether an HDF5 file holds channel data in PICMUS's layout."""
    try:
        with open_hdf5(path) as file:
            return isinstance(file.get(f"{GROUP}/data/real"), h5py.Dataset) and (
                "probe_geometry" in file[GROUP]
            )
    except SonosweepError:
        return False


def read_picmus(path: str | os.PathLike) -> ChannelSweep:
    """Return a PICMUS recording as B-mode channel data; samples are read when indexed.

    Raises:
        FormatError: If something is missing or of another form.
        ScanError: If the geometry does not fit the samples.
    """
    file = Path(path)
    with open_hdf5(file) as opened:
        group = opened.get(GROUP)
        if not isinstance(group, h5py.Group):
            raise FormatError(f"'{file.name}' has no group {GROUP}")
        modulation_hz = _number(group, "modulation_frequency", 0.0)
        samples = _samples(group, modulation_hz > 0)
        angles = _values(group, "angles")
        if len(angles) != samples.shape[1]:
            raise FormatError(
                f"'{file.name}' has {samples.shape[1]} transmits but {len(angles)} angles"
            )
        rate_hz = _number(group, "sampling_frequency")
        speed = _number(group, "sound_speed")
        start_s = _number(group, "initial_time", 0.0)
        repetition_hz = _number(group, "PRF", 0.0)
        probe = _probe(group, modulation_hz or rate_hz / SAMPLES_PER_PERIOD)
    positions_m = probe.element_positions_mm.numpy() / MM_PER_M
    delays_s = (
        np.sin(angles)[:, None] * positions_m[:, 0] + np.cos(angles)[:, None] * positions_m[:, 1]
    ) / speed
    notes = {"element width": "assumed to be the pitch: the file tells none"}
    if modulation_hz == 0:
        notes["center frequency"] = "assumed a quarter of the sampling frequency: none in the file"
    data = ChannelData(
        name=file.stem,
        samples=samples,
        probe=probe,
        sampling_frequency_hz=rate_hz,
        demodulation_frequency_hz=modulation_hz,
        start_time_s=torch.full((len(angles),), start_s, dtype=torch.float64),
        transmit_delays_s=torch.from_numpy(delays_s),
        sound_speed_m_per_s=speed,
        pulse_repetition_hz=repetition_hz or None,
    )
    return ChannelSweep(name=file.stem, b_mode=data, notes=notes)


def _samples(group: h5py.Group, is_iq: bool) -> HDF5ChannelFrames:
    data = group.get("data")
    if not isinstance(data, h5py.Group):
        raise FormatError(f"'{Path(group.file.filename).name}' has no group {GROUP}/data")
    parts = [get_dataset(data, name) for name in (("real", "imag") if is_iq else ("real",))]
    axes = ("frames", "transmits", "elements", "samples")
    return channel_frames(parts, axes if len(parts[0].shape) == 4 else axes[1:])


def _values(group: h5py.Group, name: str) -> np.ndarray:
    """Return all numbers of a small data set."""
    axes = len(get_dataset(group, name).shape)
    values = read_array(group, name, (None,) * axes).ravel()
    if not np.isfinite(values).all():
        raise FormatError(f"'{name}' in '{Path(group.file.filename).name}' are not all numbers")
    return values


def _number(group: h5py.Group, name: str, default: float | None = None) -> float:
    if default is not None and name not in group:
        return default
    values = _values(group, name)
    if len(values) != 1:
        raise FormatError(f"'{name}' in '{Path(group.file.filename).name}' must be one number")
    return float(values[0])


def _probe(group: h5py.Group, frequency_hz: float) -> Probe:
    x, y, z = read_array(group, "probe_geometry", (3, None))
    # z points into the body: turned, not mirrored.
    positions_m = np.column_stack([x, z, -y])
    check_places(positions_m, Path(group.file.filename).name)
    positions_mm = positions_m * MM_PER_M
    return Probe(
        name="PICMUS",
        element_positions_mm=torch.from_numpy(positions_mm),
        element_width_mm=float(np.median(np.linalg.norm(np.diff(positions_mm, axis=0), axis=1))),
        center_frequency_hz=frequency_hz,
    )

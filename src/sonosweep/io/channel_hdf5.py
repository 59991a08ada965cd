"""Our own channel-data file: one HDF5 file that holds everything a :class:`ChannelSweep` does.

=============================== ============================================================
``/`` attributes                ``format`` = ``"sonosweep channel data"``, ``format_version`` = 1,
                                ``written_by``, ``name``, ``subject`` (if known)
``b_mode/``                     one group for each modality that there is, see below
``power_doppler/``
``photoacoustic/``
``image_to_reference``          float64 (frames, 4, 4), mm; NaN where the tracker missed a frame
``tracked``                     bool (frames): which poses are valid
``notes``                       JSON text: what the reader of the original file found, by subject
=============================== ============================================================

Each modality has

=============================== ============================================================
attributes                      ``name``, ``sampling_frequency_hz``, ``demodulation_frequency_hz``
                                (0 for RF), ``sound_speed_m_per_s``, ``pulse_repetition_hz`` (if
                                known)
``samples``                     (frames, transmits, elements, samples), any real or complex type,
                                chunks of one transmit; h5py's complex numbers: pairs ``r``, ``i``
``start_time_s``                float64 (transmits): the first sample after time zero; 0 if absent
``transmit_delays_s``           float64 (transmits, elements), NaN for silent elements; absent
                                if nothing is sent
``timestamps_s``                float64 (frames), if known
``probe/`` attributes           ``name``, ``element_width_mm``, ``center_frequency_hz``,
                                ``elevation_aperture_mm`` and ``elevation_focus_mm`` (if known)
``probe/element_positions_mm``  float64 (elements, 3): lateral, axial, elevational
=============================== ============================================================

Text has a fixed length and is UTF-8. Samples are not compressed unless asked: noise in the
last bits of RF leaves little to gain.
"""

import json
import os
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.channel_frames import AXES, channel_frames
from sonosweep.io.disk_sink import DiskSink
from sonosweep.io.hdf5 import Compression, fixed_text, read_notes
from sonosweep.io.hdf5_access import (
    open_hdf5,
    read_array,
    read_number_attribute,
    read_text_attribute,
)
from sonosweep.io.new_hdf5 import new_hdf5
from sonosweep.scan import ChannelData, ChannelSweep, Probe, modalities

FORMAT_NAME = "sonosweep channel data"
FORMAT_VERSION = 1
MODALITIES = ("b_mode", "power_doppler", "photoacoustic")
NUMBERS = ("sampling_frequency_hz", "demodulation_frequency_hz", "sound_speed_m_per_s")
ARRAYS = ("start_time_s", "transmit_delays_s", "timestamps_s")
NO_NAN = ("start_time_s", "timestamps_s", "tracked")
PROBE_NUMBERS = ("element_width_mm", "center_frequency_hz")
PROBE_OPTIONS = ("elevation_aperture_mm", "elevation_focus_mm")


def is_channel_hdf5(path: str | os.PathLike) -> bool:
    """Say whether a file is channel data of ours, of any version."""
    try:
        with open_hdf5(path) as file:
            return read_text_attribute(file, "format") == FORMAT_NAME
    except SonosweepError:
        return False


def write_channels(
    sweep: ChannelSweep, path: str | os.PathLike, compression: Compression | None = None
) -> None:
    """Write channel data to one HDF5 file; samples pass through memory one frame at a time.

    Args:
        sweep: What was recorded; samples and float64 come back bit by bit.
        path: The file to make; it appears only when it is complete.
        compression: ``"lzf"`` is fast, ``"gzip"`` smaller and readable everywhere.

    Raises:
        FormatError: If the sweep has no frames or holds what HDF5 cannot, or the disk is full.
    """
    if any(len(data.samples) == 0 for data in modalities(sweep).values()):
        raise FormatError(f"'{sweep.name}' has no frames: there is nothing to write")
    with new_hdf5(path) as (file, sink):
        _write_sweep(file, sweep, compression, sink)


def read_channels(path: str | os.PathLike) -> ChannelSweep:
    """Return the channel data of one of our files; samples are read when indexed.

    Raises:
        FormatError: If it is not one of our files, is damaged, or is of a later version.
        ScanError: If its parts contradict each other.
    """
    with open_hdf5(path) as file:
        _check_version(file, Path(path).name)
        found = {name: _read_modality(file, name) for name in MODALITIES if name in file}
        count = max((len(data.samples) for data in found.values()), default=None)
        tracked = _optional(file, "tracked", (None,), count)
        return ChannelSweep(
            name=read_text_attribute(file, "name") or Path(path).stem,
            b_mode=found.get("b_mode"),
            power_doppler=found.get("power_doppler"),
            photoacoustic=found.get("photoacoustic"),
            image_to_reference=_optional(file, "image_to_reference", (None, 4, 4), count),
            tracked=None if tracked is None else tracked != 0,
            subject=read_text_attribute(file, "subject"),
            notes=read_notes(file),
        )


def _write_sweep(
    file: h5py.File, sweep: ChannelSweep, compression: Compression | None, sink: DiskSink
) -> None:
    file.attrs["format"] = fixed_text(FORMAT_NAME)
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["written_by"] = fixed_text(f"sonosweep {version('sonosweep')}")
    file.attrs["name"] = fixed_text(sweep.name)
    if sweep.subject is not None:
        file.attrs["subject"] = fixed_text(sweep.subject)
    for name, data in modalities(sweep).items():
        _write_modality(file.create_group(name), data, compression, sink)
    _write_arrays(file, sweep, ("image_to_reference", "tracked"))
    if sweep.notes:
        file["notes"] = fixed_text(json.dumps(dict(sweep.notes)))


def _write_modality(
    group: h5py.Group, data: ChannelData, compression: Compression | None, sink: DiskSink
) -> None:
    group.attrs["name"] = fixed_text(data.name)
    _write_numbers(group, data, (*NUMBERS, "pulse_repetition_hz"))
    _write_arrays(group, data, ARRAYS)
    probe = group.create_group("probe")
    probe.attrs["name"] = fixed_text(data.probe.name)
    _write_numbers(probe, data.probe, (*PROBE_NUMBERS, *PROBE_OPTIONS))
    _write_arrays(probe, data.probe, ("element_positions_mm",))
    shape = tuple(data.samples.shape)
    dataset = group.create_dataset(
        "samples", shape, data.samples.dtype, chunks=(1, 1, *shape[2:]), compression=compression
    )
    for i in range(len(data.samples)):
        dataset[i] = data.samples[i]
        sink.check()


def _write_numbers(group: h5py.Group, owner: object, names: tuple[str, ...]) -> None:
    for name in names:
        if (value := getattr(owner, name)) is not None:
            group.attrs[name] = float(value)


def _write_arrays(group: h5py.Group, owner: object, names: tuple[str, ...]) -> None:
    for name in names:
        values: Tensor | None = getattr(owner, name)
        if values is not None:
            group[name] = values.numpy()


def _check_version(file: h5py.File, name: str) -> None:
    if read_text_attribute(file, "format") != FORMAT_NAME:
        known = ", ".join(list(file)[:12]) or "nothing"
        raise FormatError(f"'{name}' is no sonosweep channel data; it holds {known}")
    found = read_number_attribute(file, "format_version", 1)[0]
    if found > FORMAT_VERSION:
        raise FormatError(
            f"'{name}' is of format version {found:g}, but this sonosweep reads up to"
            f" {FORMAT_VERSION}: update sonosweep"
        )


def _read_modality(file: h5py.File, name: str) -> ChannelData:
    group = _group(file, name)
    if not isinstance(dataset := group.get("samples"), h5py.Dataset):
        raise FormatError(f"'{name}' in '{Path(file.filename).name}' has no samples")
    samples = channel_frames([dataset], AXES)
    frames, transmits = samples.shape[:2]
    numbers = {key: read_number_attribute(group, key, 1)[0] for key in NUMBERS}
    return ChannelData(
        name=read_text_attribute(group, "name") or name,
        samples=samples,
        probe=_read_probe(_group(group, "probe")),
        start_time_s=_optional(group, "start_time_s", (transmits,)),
        transmit_delays_s=_optional(group, "transmit_delays_s", (transmits, None)),
        timestamps_s=_optional(group, "timestamps_s", (None,), frames),
        pulse_repetition_hz=_number(group, "pulse_repetition_hz"),
        **numbers,
    )


def _read_probe(group: h5py.Group) -> Probe:
    width, frequency = (read_number_attribute(group, key, 1)[0] for key in PROBE_NUMBERS)
    aperture, focus = (_number(group, key) for key in PROBE_OPTIONS)
    return Probe(
        name=read_text_attribute(group, "name") or "unnamed",
        element_positions_mm=torch.from_numpy(read_array(group, "element_positions_mm", (None, 3))),
        element_width_mm=width,
        center_frequency_hz=frequency,
        elevation_aperture_mm=aperture,
        elevation_focus_mm=focus,
    )


def _group(parent: h5py.Group, name: str) -> h5py.Group:
    if not isinstance(group := parent.get(name), h5py.Group):
        raise FormatError(f"'{Path(parent.file.filename).name}' has no group '{name}'")
    return group


def _number(group: h5py.Group, name: str) -> float | None:
    return read_number_attribute(group, name, 1)[0] if name in group.attrs else None


def _optional(
    group: h5py.Group, name: str, shape: tuple[int | None, ...], frames: int | None = None
) -> Tensor | None:
    """Return a data set as float64, or ``None`` if there is none of this name."""
    if name not in group:
        return None
    values = read_array(group, name, shape, frames)
    # NaN marks frames that the tracker missed and elements that do not fire.
    if np.isinf(values).any() or (name in NO_NAN and np.isnan(values).any()):
        raise FormatError(f"'{name}' in '{Path(group.file.filename).name}' are not all numbers")
    return torch.from_numpy(values)

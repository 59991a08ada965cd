"""Channel data of the UltraSound ToolBox (USTB): ``uff.channel_data`` objects in HDF5 (.uff).

The first group that has the parts below is read, whatever its name (often ``channel_data``).

============================ ==============================================================
``data``                     (frames, waves, elements, samples), leading axes of length 1 may
                             lack; complex numbers as a group of ``real`` and ``imag``
``sampling_frequency``       Hz
``initial_time``             s, of the first sample; 0 if absent
``modulation_frequency``     Hz, carrier removed from IQ samples; 0 for RF
``sound_speed``              m/s
``PRF``                      Hz, if known
``pulse/center_frequency``   Hz, if known
``probe/geometry``           (7, elements): x, y, z (into the body) in m, two angles, width and
                             height in m; or else ``probe/N``, ``pitch``, ``element_width``,
                             ``radius`` (curved)
``sequence/``                one wave, or a group of them in alphabetical order:
``../wavefront``             0 plane, 1 spherical, 2 photoacoustic; 1 if absent
``../source/``               ``distance`` (m), ``azimuth``, ``elevation`` (rad): where a
                             spherical wave comes from or goes to, or a plane wave's direction
``../origin/``               the same, of the point that the wave passes at time zero; the
                             middle of the array if absent
``../delay``                 s from time zero to the start of the recording; 0 if absent
============================ ==============================================================

A spherical wave whose source is an element is sent by this element alone. Complex samples
without a modulation frequency are analytic signals: their real part is taken. Photoacoustic
waves make photoacoustic channel data, equal waves a Doppler ensemble, all others B-mode.

References:
    Rodriguez-Molares A et al., "The UltraSound ToolBox", IEEE IUS 2017.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.channel_frames import HDF5ChannelFrames, channel_frames
from sonosweep.io.element_axes import check_places
from sonosweep.io.hdf5_access import get_dataset, open_hdf5, read_array
from sonosweep.scan import ChannelData, ChannelSweep, Probe

PARTS = ("data", "sampling_frequency", "sound_speed", "probe", "sequence")
PLANE, SPHERICAL, PHOTOACOUSTIC = 0, 1, 2
MM_PER_M = 1000.0
MOST_WAVES = 10_000
ON_ELEMENT_M = 1e-6
SAMPLES_PER_PERIOD = 4  # assumed where no frequency is known


def is_uff(path: str | os.PathLike) -> bool:
    """Say whether an HDF5 file holds a ``uff.channel_data`` object."""
    try:
        with open_hdf5(path) as file:
            return _find(file) is not None
    except SonosweepError:
        return False


def read_uff(path: str | os.PathLike) -> ChannelSweep:
    """Return the channel data of a UFF file; samples are read when indexed.

    Raises:
        FormatError: If there is none, or something is missing or of another form.
        ScanError: If the geometry does not fit the samples.
    """
    file = Path(path)
    with open_hdf5(file) as opened:
        group = _find(opened)
        if group is None:
            raise FormatError(
                f"'{file.name}' has no channel data: no group holds {', '.join(PARTS)}"
            )
        return _read(group, file)


def _find(file: h5py.File) -> h5py.Group | None:
    candidates: list[h5py.Group] = [file]
    candidates += [item for item in map(file.get, file) if isinstance(item, h5py.Group)]
    return next((group for group in candidates if all(part in group for part in PARTS)), None)


def _read(group: h5py.Group, file: Path) -> ChannelSweep:
    modulation_hz = _number(group, "modulation_frequency", 0.0)
    speed = _number(group, "sound_speed")
    rate_hz = _number(group, "sampling_frequency")
    notes: dict[str, str] = {}
    probe = _probe(_group(group, "probe"), _frequency(group, modulation_hz, rate_hz, notes))
    positions_m = probe.element_positions_mm.numpy() / MM_PER_M
    waves = [_wave(wave, positions_m, speed) for wave in _waves(_group(group, "sequence"))]
    kinds = {kind for kind, _, _ in waves}
    if PHOTOACOUSTIC in kinds and len(kinds) > 1:
        raise FormatError(f"'{file.name}' mixes photoacoustic and transmitted waves")
    late_s = np.array([late for _, _, late in waves])
    samples = _samples(group, modulation_hz, late_s)
    if samples.shape[1] != len(waves):
        raise FormatError(
            f"'{file.name}' has data of {samples.shape[1]} waves but a sequence of {len(waves)}"
        )
    delays = None
    if PHOTOACOUSTIC not in kinds:
        delays = torch.from_numpy(np.stack([delay for _, delay, _ in waves]))
    data = ChannelData(
        name=file.stem,
        samples=samples,
        probe=probe,
        sampling_frequency_hz=rate_hz,
        demodulation_frequency_hz=modulation_hz,
        start_time_s=torch.from_numpy(_number(group, "initial_time", 0.0) + late_s),
        transmit_delays_s=delays,
        sound_speed_m_per_s=speed,
        pulse_repetition_hz=_number(group, "PRF", 0.0) or None,
    )
    return _sweep(file.stem, data, notes)


def _sweep(name: str, data: ChannelData, notes: dict[str, str]) -> ChannelSweep:
    delays = data.transmit_delays_s
    if delays is None:
        return ChannelSweep(name=name, photoacoustic=data, notes=notes)
    if len(delays) > 1 and _are_equal(delays):
        return ChannelSweep(name=name, power_doppler=data, notes=notes)
    return ChannelSweep(name=name, b_mode=data, notes=notes)


def _are_equal(delays: Tensor) -> bool:
    return bool(torch.allclose(delays, delays[:1].expand_as(delays), 0.0, 0.0, equal_nan=True))


def _frequency(
    group: h5py.Group, modulation_hz: float, rate_hz: float, notes: dict[str, str]
) -> float:
    pulse = group.get("pulse")
    if isinstance(pulse, h5py.Group):
        center_hz = _number(pulse, "center_frequency", 0.0)
        if center_hz > 0:
            return center_hz
    if modulation_hz > 0:
        return modulation_hz
    notes["center frequency"] = "assumed a quarter of the sampling frequency: none in the file"
    return rate_hz / SAMPLES_PER_PERIOD


def _samples(group: h5py.Group, modulation_hz: float, late_s: np.ndarray) -> HDF5ChannelFrames:
    data = group["data"]
    is_complex = isinstance(data, h5py.Group)
    if modulation_hz > 0 and not is_complex:
        raise FormatError(
            f"'{Path(group.file.filename).name}' has a modulation frequency of {modulation_hz:g}"
            " Hz, but its samples are real"
        )
    names = ("real", "imag") if modulation_hz > 0 else ("real",)
    parts = (
        [get_dataset(data, name) for name in names] if is_complex else [get_dataset(group, "data")]
    )
    axes = ("frames", "transmits", "elements", "samples")
    missing = 4 - len(parts[0].shape)
    if not 0 <= missing <= 2:
        raise FormatError(
            f"'data' in '{Path(group.file.filename).name}' must be frames, waves, elements and"
            f" samples, but has the shape {parts[0].shape}"
        )
    # USTB's carrier runs from the start of the recording, ours from time zero.
    turns = np.exp(-2j * np.pi * modulation_hz * late_s) if modulation_hz > 0 else None
    return channel_frames(parts, axes[missing:], turns)


def _waves(sequence: h5py.Group) -> list[h5py.Group]:
    if "source" in sequence or "wavefront" in sequence:
        return [sequence]
    if not 0 < len(sequence) <= MOST_WAVES:
        raise FormatError(
            f"the sequence of '{Path(sequence.file.filename).name}' has {len(sequence)} waves"
        )
    return [_group(sequence, name) for name in sorted(sequence)]


def _wave(wave: h5py.Group, positions_m: np.ndarray, speed: float) -> tuple[int, np.ndarray, float]:
    """Return the kind of a wave, when each element fires, and the recording's delay."""
    kind = int(_number(wave, "wavefront", float(SPHERICAL)))
    late_s = _number(wave, "delay", 0.0)
    if kind == PHOTOACOUSTIC:
        return kind, np.zeros(len(positions_m)), late_s
    origin_m = np.zeros(3)
    if isinstance(wave.get("origin"), h5py.Group):
        origin_m = _direction(wave["origin"]) * _number(wave["origin"], "distance", 0.0)
    source = _group(wave, "source")
    direction, distance_m = _direction(source), _number(source, "distance", 0.0, finite=False)
    relative_m = positions_m - origin_m
    if kind == PLANE or np.isinf(distance_m):
        return PLANE, relative_m @ direction / speed, late_s
    if kind != SPHERICAL:
        raise FormatError(
            f"'{Path(wave.file.filename).name}' has a wave of unknown kind {kind}: 0 is plane, 1"
            " spherical, 2 photoacoustic"
        )
    return kind, _spherical(direction * distance_m, origin_m, positions_m, speed), late_s


def _spherical(
    source_m: np.ndarray, origin_m: np.ndarray, positions_m: np.ndarray, speed: float
) -> np.ndarray:
    path_s = np.linalg.norm(positions_m - source_m, axis=1) / speed
    to_origin_s = float(np.linalg.norm(source_m - origin_m)) / speed
    if path_s.min() * speed < ON_ELEMENT_M:
        return np.where(np.arange(len(path_s)) == path_s.argmin(), to_origin_s, np.nan)
    diverges = source_m[1] < 0
    return path_s - to_origin_s if diverges else to_origin_s - path_s


def _direction(point: h5py.Group) -> np.ndarray:
    """Return the direction of a point: lateral, axial, elevational."""
    azimuth, elevation = (_number(point, name, 0.0) for name in ("azimuth", "elevation"))
    return np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            -np.sin(elevation),
        ]
    )


def _probe(group: h5py.Group, frequency_hz: float) -> Probe:
    if "geometry" in group:
        x, y, z, _, _, width, height = read_array(group, "geometry", (7, None))
    else:
        x, y, z, width, height = _regular(group)
    # z points into the body: turned, not mirrored.
    positions_m = np.column_stack([x, z, -y])
    check_places(positions_m, Path(group.file.filename).name)
    positions_mm = positions_m * MM_PER_M
    pitch_mm = float(np.median(np.linalg.norm(np.diff(positions_mm, axis=0), axis=1)))
    width_mm, height_mm = (float(np.median(value)) * MM_PER_M for value in (width, height))
    return Probe(
        name="USTB",
        element_positions_mm=torch.from_numpy(positions_mm),
        element_width_mm=width_mm if width_mm > 0 else pitch_mm,
        center_frequency_hz=frequency_hz,
        elevation_aperture_mm=height_mm if height_mm > 0 else None,
    )


def _regular(group: h5py.Group) -> Iterator[np.ndarray]:
    """Return x, y, z, width and height of a straight or curved array's elements."""
    count, pitch = _number(group, "N"), _number(group, "pitch")
    if not 2 <= count <= 4096 or count != int(count):
        raise FormatError(f"'{Path(group.file.filename).name}' has a probe of {count:g} elements")
    steps = np.arange(int(count)) - (count - 1) / 2
    x, z = steps * pitch, np.zeros(int(count))
    if "radius" in group:
        radius = _number(group, "radius")
        angles = steps * 2 * np.arcsin(min(pitch / 2 / radius, 1.0))
        x, z = radius * np.sin(angles), radius * np.cos(angles) - radius
    yield from (x, 0 * x, z)
    yield _number(group, "element_width", pitch) + 0 * x
    yield _number(group, "element_height", 0.0) + 0 * x


def _group(parent: h5py.Group, name: str) -> h5py.Group:
    if not isinstance(group := parent.get(name), h5py.Group):
        raise FormatError(f"'{Path(parent.file.filename).name}' has no group '{name}'")
    return group


def _number(
    group: h5py.Group, name: str, default: float | None = None, finite: bool = True
) -> float:
    if default is not None and name not in group:
        return default
    dataset = get_dataset(group, name)
    values = read_array(group, name, (None,) * len(dataset.shape)).ravel()
    if default is not None and len(values) == 0:
        return default
    if len(values) != 1 or np.isnan(values[0]) or (finite and np.isinf(values[0])):
        raise FormatError(
            f"'{dataset.name}' in '{Path(group.file.filename).name}' must be one number"
        )
    return float(values[0])

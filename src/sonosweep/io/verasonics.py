"""Channel data of Verasonics machines: a saved MATLAB workspace (``.mat``, any version since 5).

======================================= ==================================================
``RcvData``                             cell per receive buffer: rows (samples of all
                                        acquisitions one below the other) × columns
                                        (channels) × frames, int16
``Receive(k)``                          one entry per acquisition and frame:
``.bufnum .framenum .acqNum``           where it writes; entries of frame 1 are read
``.startSample .endSample``             rows, counted from 1
``.startDepth``                         wavelengths, one way
``.sampleMode``                         ``NS200BW`` (RF), ``NS200BWI`` (pairs of acquisitions,
                                        half a sample apart), ``BS67BW`` (band-pass sampled
                                        RF), ``BS100BW``, ``BS50BW`` (pairs of samples, a
                                        quarter of the carrier's period apart), ``custom``
``.decimSampleRate``                    MHz; or ``.samplesPerWave``
``.demodFrequency``                     MHz, the carrier of pairs
``.Apod``                               0 for elements that do not receive
``.mode``                               1 adds to what is there: no samples of its own
``TX(k)``                               ``.Apod`` (0: silent), ``.Delay`` (wavelengths),
                                        ``.waveform``
``TW(k).peak``                          wavelengths from the start of a pulse to its peak, out
                                        and back
``Event(k)``                            ``.tx .rcv .seqControl``: which transmit belongs to
                                        which acquisition
``SeqControl(k)``                       ``.command`` = ``timeToNextAcq``, ``.argument`` in µs
``Trans``                               ``.frequency`` (MHz), ``.units``, ``.ElementPos`` (x, y,
                                        z into the body, ...), ``.elementWidth``,
                                        ``.lensCorrection``, in these units; ``.Connector`` or
                                        ``.ConnectorES``: column of each element;
                                        ``.elevationApertureMm``, ``.elevationFocusMm``
``Resource``                            ``.Parameters.speedOfSound`` (m/s);
                                        ``.RcvBuffer(b).lastFrame``: the newest frame
``timestamps_s``, ``image_to_reference``, ``tracked``  ours, if added to the file: as in scans
======================================= ==================================================

A wavelength is that of ``Trans.frequency``. Time zero is that of ``TX.Delay``, moved so that
an echo's peak lies at its time of flight: the first sample is at ``2 startDepth - peak -
2 lens``, and for laser pulses at ``2 startDepth - lens``.

What an acquisition is for follows from its transmit: no active element means a laser pulse
(photoacoustic); the same wave two or more times in a row is a Doppler ensemble; the others
make up the B-mode image. Acquisitions in which parts of the array receive one after the other
are joined.

References:
    The meaning of the fields was learnt from published Verasonics scripts and from readers of
    such files; no code was taken.
"""

import os
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.channel_frames import channel_frames, check_sizes
from sonosweep.io.element_axes import check_places
from sonosweep.io.matlab_nodes import MatNode, NewNode, open_mat
from sonosweep.io.verasonics_frames import BufferFrames
from sonosweep.io.verasonics_sequence import (
    HZ_PER_MHZ,
    MM_PER_M,
    Machine,
    Shot,
    number,
    optional_number,
    read_shots,
    vector,
)
from sonosweep.scan import ChannelData, ChannelSweep, Frames, Probe

NEEDED = ("RcvData", "Receive", "TX", "Trans", "Resource")
MOST_BUFFERS = 64
MOST_ELEMENTS = 4096
SAME_INTERVAL = 1e-3  # part of the interval between two transmits


def is_verasonics(path: str | os.PathLike) -> bool:
    """Say whether a MATLAB file is a workspace of a Verasonics machine."""
    with open_mat(Path(path)) as variables:
        return "RcvData" in variables and "Trans" in variables


def read_verasonics(path: str | os.PathLike) -> ChannelSweep:
    """Return the channel data of a Verasonics workspace, by modality.

    Raises:
        FormatError: If something is missing or damaged, contradicts something else, or is not
            understood.
        ScanError: If the geometry does not fit the samples.
    """
    file = Path(path)
    try:
        with open_mat(file) as variables:
            return _read(variables, file)
    except FormatError as error:
        if file.name in str(error):
            raise
        raise FormatError(f"{error} in '{file.name}'") from error


def _read(variables: Mapping[str, MatNode], file: Path) -> ChannelSweep:
    for name in NEEDED:
        if name not in variables:
            raise FormatError(f"'{file.name}' has no {name}: save the whole workspace")
    buffers = _buffers(variables["RcvData"], file)
    probe, machine = _array(variables)
    shapes = {key: (buffer.shape[3], buffer.shape[2]) for key, buffer in buffers.items()}
    shots = read_shots(variables, machine, shapes)
    counts = {len(buffers[shot.buffer]) for shot in shots}
    if len(counts) > 1:
        raise FormatError(f"the receive buffers have different frame counts: {sorted(counts)}")
    count = counts.pop()
    times = _optional(variables, "timestamps_s", (count,))
    if times is None:
        times = _steady_times(shots, count)
    speed = _sound_speed(variables)
    data = {
        name: _channel_data(
            name, found, buffers, _order(variables, found[0].buffer, count), probe, speed, times
        )
        for name, found in _modalities(shots).items()
    }
    tracked = _optional(variables, "tracked", (count,))
    return ChannelSweep(
        name=file.stem,
        b_mode=data.get("b_mode"),
        power_doppler=data.get("power_doppler"),
        photoacoustic=data.get("photoacoustic"),
        image_to_reference=_optional(variables, "image_to_reference", (count, 4, 4)),
        tracked=None if tracked is None else tracked != 0,
    )


def _buffers(node: MatNode, file: Path) -> dict[int, Frames]:
    """Return the receive buffers that hold samples, (frames, 1, channels, rows), by number."""
    if node.kind == "cell":
        if node.count > MOST_BUFFERS:
            raise FormatError(f"RcvData has {node.count} buffers: it is damaged")
        cells = {k: node.cell(k) for k in range(node.count)}
    else:
        cells = {0: node}
    found = {k: cell for k, cell in cells.items() if cell is not None and cell.count}
    if not found:
        raise FormatError(f"RcvData of '{file.name}' holds no samples")
    return {k: _buffer(cell) for k, cell in found.items()}


def _buffer(node: MatNode) -> Frames:
    if node.kind != "numbers" or len(node.shape) not in (2, 3):
        shape = " x ".join(map(str, node.shape))
        raise FormatError(f"{node.name} must be rows x columns x frames of numbers, not {shape}")
    if isinstance(node, NewNode) and isinstance(node.item, h5py.Dataset):
        axes = ("frames", "elements", "samples")[3 - len(node.shape) :]
        return channel_frames([node.item], axes)
    rows, columns, frames = (*node.shape, 1)[:3]
    values = node.numbers()
    check_sizes(node.name, (frames, 1, columns, rows), values.dtype)
    return values.reshape((rows, columns, frames), order="F").T[:, None]


def _array(variables: Mapping[str, MatNode]) -> tuple[Probe, Machine]:
    trans = variables["Trans"]
    if trans.field("HVMux") is not None:
        raise FormatError(
            "the probe is multiplexed (Trans.HVMux): which element is on which channel is not"
            " understood"
        )
    frequency_hz = number(trans.field("frequency"), "Trans.frequency") * HZ_PER_MHZ
    speed = _sound_speed(variables)
    if not frequency_hz > 0:
        raise FormatError(f"Trans.frequency must be above 0 MHz, got {frequency_hz / 1e6:g}")
    wavelength_mm = speed / frequency_hz * MM_PER_M
    unit_mm = _unit_mm(trans, wavelength_mm)
    positions_mm = _positions(trans) * unit_mm
    check_places(positions_mm / MM_PER_M, "Trans.ElementPos")
    width = optional_number(trans.field("elementWidth"))
    pitch_mm = float(np.median(np.linalg.norm(np.diff(positions_mm, axis=0), axis=1)))
    named = trans.field("name")
    probe = Probe(
        name="Verasonics" if named is None or named.count == 0 else named.text(),
        element_positions_mm=torch.from_numpy(positions_mm),
        element_width_mm=pitch_mm if width is None else width * unit_mm,
        center_frequency_hz=frequency_hz,
        elevation_aperture_mm=optional_number(trans.field("elevationApertureMm")) or None,
        elevation_focus_mm=optional_number(trans.field("elevationFocusMm")) or None,
    )
    lens = optional_number(trans.field("lensCorrection")) or 0.0
    lens_s = lens * unit_mm / MM_PER_M / speed
    return probe, Machine(frequency_hz, lens_s, _channels(trans, len(positions_mm)))


def _unit_mm(trans: MatNode, wavelength_mm: float) -> float:
    node = trans.field("units")
    units = "" if node is None or node.count == 0 else node.text()
    if units not in ("mm", "wavelengths"):
        raise FormatError(f"Trans.units must be 'mm' or 'wavelengths', got '{units[:40]}'")
    return 1.0 if units == "mm" else wavelength_mm


def _positions(trans: MatNode) -> np.ndarray:
    """Return lateral, axial and elevational positions; the machine's z points into the body."""
    node = trans.field("ElementPos")
    if node is None or len(node.shape) != 2 or not 3 <= node.shape[1] <= 8:
        found = "is missing" if node is None else f"is {' x '.join(map(str, node.shape))}"
        raise FormatError(f"Trans.ElementPos must be elements x 5 numbers, but {found}")
    if not 2 <= node.shape[0] <= MOST_ELEMENTS:
        raise FormatError(f"Trans.ElementPos has {node.shape[0]} elements")
    x, y, z = node.numbers().astype(np.float64)[:, :3].T
    return np.column_stack([x, z, -y])


def _channels(trans: MatNode, elements: int) -> np.ndarray:
    """Return the column of each element, from 0."""
    for name in ("Connector", "ConnectorES"):
        node = trans.field(name)
        if node is not None and node.count == elements:
            channels = vector(node, node.name, elements).astype(np.int64) - 1
            if channels.min() < 0 or len(np.unique(channels)) != elements:
                raise FormatError(f"Trans.{name} must give each element a channel of its own")
            return channels
    return np.arange(elements)


def _sound_speed(variables: Mapping[str, MatNode]) -> float:
    parameters = variables["Resource"].field("Parameters")
    node = None if parameters is None else parameters.field("speedOfSound")
    speed = number(node, "Resource.Parameters.speedOfSound")
    if not speed > 0:
        raise FormatError(f"Resource.Parameters.speedOfSound must be above 0 m/s, got {speed:g}")
    return speed


def _order(variables: Mapping[str, MatNode], buffer: int, count: int) -> np.ndarray:
    """Return the frames of a ring buffer from the oldest to the newest."""
    rings = variables["Resource"].field("RcvBuffer")
    last = 0.0
    if rings is not None and buffer < rings.count:
        last = optional_number(rings.field("lastFrame", buffer)) or 0.0
    return (np.arange(count) + int(last)) % count


def _modalities(shots: list[Shot]) -> dict[str, list[Shot]]:
    """Return the shots by what they are for."""
    found: dict[str, list[Shot]] = {}
    ensembles = 0
    for (_, is_laser), run in groupby(shots, lambda shot: (shot.wave, shot.delays_s is None)):
        same = list(run)
        if is_laser:
            found.setdefault("photoacoustic", []).extend(same)
        elif len(same) > 1:
            ensembles += 1
            found["power_doppler"] = same
        else:
            found.setdefault("b_mode", []).extend(same)
    if ensembles > 1:
        raise FormatError(
            f"a frame has {ensembles} ensembles of repeated transmits: one Doppler ensemble is"
            " understood"
        )
    return found


def _channel_data(
    name: str,
    shots: list[Shot],
    buffers: dict[int, Frames],
    places: np.ndarray,
    probe: Probe,
    speed: float,
    times: Tensor | None,
) -> ChannelData:
    first = shots[0]
    for what in ("buffer", "rows", "sampling", "rate_hz", "carrier_hz"):
        values = {getattr(shot, what) for shot in shots}
        if len(values) > 1:
            told = ", ".join(map(str, sorted(values)))
            raise FormatError(f"the {name} acquisitions differ in their {what}: {told}")
    starts = np.array([shot.start_s for shot in shots])
    delays = [shot.delays_s for shot in shots if shot.delays_s is not None]
    is_iq = first.sampling == "quadrature"
    samples = BufferFrames(
        buffers[first.buffer],
        places,
        [shot.cuts for shot in shots],
        len(probe.element_positions_mm),
        first.rows,
        first.sampling,
        _carriers(starts, first) if is_iq else None,
        first.rate_hz / (4 * first.carrier_hz) if is_iq else 0.0,
    )
    intervals = np.array([shot.interval_s for shot in shots])
    spread = np.ptp(intervals[:-1]) if len(shots) > 1 else np.nan
    steady = intervals[0] > 0 and spread <= SAME_INTERVAL * intervals[0]
    return ChannelData(
        name=name,
        samples=samples,
        probe=probe,
        sampling_frequency_hz=first.rate_hz,
        demodulation_frequency_hz=first.carrier_hz if is_iq else 0.0,
        start_time_s=torch.from_numpy(starts),
        transmit_delays_s=torch.from_numpy(np.stack(delays)) if delays else None,
        sound_speed_m_per_s=speed,
        timestamps_s=times,
        pulse_repetition_hz=float(1 / intervals[0]) if steady else None,
    )


def _carriers(starts: np.ndarray, shot: Shot) -> np.ndarray:
    """Return what turns analytic samples into baseband samples, by their time."""
    times = starts[:, None] + np.arange(shot.rows // 2) / shot.rate_hz
    return np.exp(-2j * np.pi * np.remainder(shot.carrier_hz * times, 1)).astype(np.complex64)


def _steady_times(shots: list[Shot], count: int) -> Tensor | None:
    """Return frame times from the times between acquisitions, if all are known."""
    period = sum(shot.interval_s for shot in shots)
    if not period > 0:  # NaN if one is not known
        return None
    return torch.arange(count, dtype=torch.float64) * period


def _optional(variables: Mapping[str, MatNode], name: str, shape: tuple[int, ...]) -> Tensor | None:
    """Return a variable of ours with one entry per frame, frames first."""
    if name not in variables:
        return None
    values = variables[name].numbers().astype(np.float64)
    if len(shape) == 1:
        values = values.ravel()
    elif values.shape == (4, 4):
        values = values[..., None]
    values = np.moveaxis(values, -1, 0)
    if values.shape != shape:
        raise FormatError(
            f"there are {shape[0]} frames, but {name} is"
            f" {' x '.join(map(str, variables[name].shape))}"
        )
    return torch.from_numpy(np.ascontiguousarray(values))

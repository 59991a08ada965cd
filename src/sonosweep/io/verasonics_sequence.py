"""What a Verasonics machine sent and recorded in one frame, shot by shot."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sonosweep.errors import FormatError
from sonosweep.io.matlab_nodes import MatNode
from sonosweep.io.verasonics_frames import Cut, Sampling

HZ_PER_MHZ = 1e6
S_PER_US = 1e-6
MM_PER_M = 1000.0
# How the samples of each mode are to be understood, and by how much the machine's
# decimSampleRate (MHz) exceeds the rate of the stored rows.
MODES: dict[str, tuple[Sampling, int]] = {
    "NS200BW": ("rf", 1),
    "NS200BWI": ("interleaved", 2),
    "BS100BW": ("quadrature", 2),
    "BS67BW": ("rf", 1),
    "BS50BW": ("quadrature", 4),
    "custom": ("rf", 1),
}
SAME_DELAY_S = 1e-10
STEP_TOLERANCE = 0.1  # of the joined sampling interval, for interleaved acquisitions


@dataclass(frozen=True, eq=False)
class Machine:
    """What holds for the whole recording.

    Attributes:
        frequency_hz: ``Trans.frequency``, whose wavelength is the unit of length and time.
        lens_s: Time through the lens, one way.
        channels: Column of the receive buffer for each element, from 0.
    """

    frequency_hz: float
    lens_s: float
    channels: np.ndarray


@dataclass(frozen=True, eq=False)
class Shot:
    """One transmit or laser pulse, and where its samples are.

    Attributes:
        buffer: Number of the receive buffer, from 0.
        cuts: The pieces of its samples.
        rows: That it takes in the buffer.
        sampling: What these are.
        rate_hz: Of the samples, once understood.
        carrier_hz: Frequency at which pairs are a quarter of a period apart.
        start_s: Time of the first sample after the transmit's time zero.
        delays_s: When each element fires, NaN for silent elements; ``None`` for a laser
            pulse.
        wave: What tells it from other shots: transmit delays, apodization, waveform.
        interval_s: Until the next acquisition; NaN if not known.
    """

    buffer: int
    cuts: list[Cut]
    rows: int
    sampling: Sampling
    rate_hz: float
    carrier_hz: float
    start_s: float
    delays_s: np.ndarray | None
    wave: tuple[bytes, ...]
    interval_s: float


def read_shots(
    variables: Mapping[str, MatNode], machine: Machine, shapes: Mapping[int, tuple[int, int]]
) -> list[Shot]:
    """Return the shots of the first frame, in the order of time, of all buffers.

    Acquisitions that together make one shot are joined: two interleaved ones (NS200BWI), and
    those of a synthetic aperture, in which parts of the array receive one after the other.

    Args:
        variables: The workspace.
        machine: What holds for all shots.
        shapes: Rows and columns of each receive buffer that holds samples.

    Raises:
        FormatError: If something is missing or contradicts something else.
    """
    receives = _first_frame(variables["Receive"], set(shapes))
    sent = _sent(variables, receives)
    waves: dict[int, _Wave] = {}
    shots: list[Shot] = []
    for receive in receives:
        tx, interval_s = sent[receive]
        if tx not in waves:
            waves[tx] = _read_wave(variables, tx, machine)
        shot = _read_shot(variables["Receive"], receive, waves[tx], machine, shapes)
        shots.append(replace(shot, interval_s=interval_s))
    return _join_apertures(_join_interleaved(shots), len(machine.channels))


def number(node: MatNode | None, name: str) -> float:
    """Return a field that is one finite number.

    Raises:
        FormatError: If it is missing or something else.
    """
    if node is None:
        raise FormatError(f"{name} is missing")
    values = node.numbers()
    if values.size != 1 or not np.isfinite(values).all():
        raise FormatError(f"{node.name} must be one number")
    return float(values.ravel()[0])


def optional_number(node: MatNode | None) -> float | None:
    """Return a field that is one finite number, ``None`` if it is missing or empty."""
    return None if node is None or node.count == 0 else number(node, node.name)


def vector(node: MatNode | None, name: str, length: int) -> np.ndarray:
    """Return a field that is a row or column of so many finite numbers.

    Raises:
        FormatError: If it is missing or something else.
    """
    if node is None:
        raise FormatError(f"{name} is missing")
    values = node.numbers().astype(np.float64)
    if values.size != length or not np.isfinite(values).all():
        shape = " x ".join(map(str, node.shape))
        raise FormatError(f"{node.name} must be {length} numbers, one per element, not {shape}")
    return values.ravel(order="F")


@dataclass(frozen=True, eq=False)
class _Wave:
    """One entry of TX; ``delays_s`` is ``None`` if no element fires."""

    delays_s: np.ndarray | None
    peak_s: float
    key: tuple[bytes, ...]


def _first_frame(receive: MatNode, buffers: set[int]) -> list[int]:
    """Return the entries of Receive that write the first frame of each buffer."""
    found: list[int] = []
    seen = set()
    for k in range(receive.count):
        if (optional_number(receive.field("framenum", k)) or 1) != 1:
            continue
        buffer = int(optional_number(receive.field("bufnum", k)) or 1) - 1
        if buffer not in buffers or (optional_number(receive.field("mode", k)) or 0) != 0:
            continue
        place = buffer, optional_number(receive.field("acqNum", k))
        if place not in seen:
            seen.add(place)
            found.append(k)
    if not found:
        raise FormatError("Receive has no entry for the first frame of RcvData")
    return found


def _sent(variables: Mapping[str, MatNode], receives: list[int]) -> dict[int, tuple[int, float]]:
    """Return for each receive the number of its transmit, and the time to the next one."""
    if "Event" not in variables:
        count = variables["TX"].count
        if count not in (1, len(receives)):
            raise FormatError(
                f"there are {count} TX for {len(receives)} acquisitions in a frame, and no Event"
                " that tells which belong together: save Event too"
            )
        return {receive: (k % count, math.nan) for k, receive in enumerate(receives)}
    events, wanted = variables["Event"], set(receives)
    sent: dict[int, tuple[int, float]] = {}
    for k in range(events.count):
        receive = int(optional_number(events.field("rcv", k)) or 0) - 1
        if receive in wanted and receive not in sent:
            tx = int(optional_number(events.field("tx", k)) or 0) - 1
            sent[receive] = tx, _interval(variables, events.field("seqControl", k))
            if len(sent) == len(wanted):
                break
    if missing := wanted - set(sent):
        raise FormatError(f"no Event refers to Receive({min(missing) + 1})")
    for receive, (tx, _) in sent.items():
        if tx < 0:
            raise FormatError(f"the Event of Receive({receive + 1}) has no transmit (tx is 0)")
    return sent


def _interval(variables: Mapping[str, MatNode], controls: MatNode | None) -> float:
    """Return the time to the next acquisition that an event asks for; NaN if it does not."""
    if controls is None or "SeqControl" not in variables:
        return math.nan
    for entry in controls.numbers().ravel().tolist():
        if entry < 1:
            continue
        command = variables["SeqControl"].field("command", int(entry) - 1)
        if command is not None and command.text() == "timeToNextAcq":
            argument = variables["SeqControl"].field("argument", int(entry) - 1)
            return number(argument, "SeqControl.argument") * S_PER_US
    return math.nan


def _read_wave(variables: Mapping[str, MatNode], tx: int, machine: Machine) -> _Wave:
    node, elements = variables["TX"], len(machine.channels)
    weights = vector(node.field("Apod", tx), f"TX({tx + 1}).Apod", elements)
    if not weights.any():
        return _Wave(None, 0.0, (b"laser",))
    delays = vector(node.field("Delay", tx), f"TX({tx + 1}).Delay", elements)
    delays_s = np.where(weights != 0, delays / machine.frequency_hz, np.nan)
    waveform = int(optional_number(node.field("waveform", tx)) or 1)
    peak = None
    if "TW" in variables:
        peak = optional_number(variables["TW"].field("peak", waveform - 1))
    steps = np.where(weights != 0, np.rint(delays / machine.frequency_hz / SAME_DELAY_S), 0)
    key = (steps.tobytes(), weights.tobytes(), str(waveform).encode())
    return _Wave(delays_s, (peak or 0.0) / machine.frequency_hz, key)


def _read_shot(
    receive: MatNode,
    k: int,
    wave: _Wave,
    machine: Machine,
    shapes: Mapping[int, tuple[int, int]],
) -> Shot:
    def need(name: str) -> float:
        return number(receive.field(name, k), f"Receive({k + 1}).{name}")

    buffer = int(optional_number(receive.field("bufnum", k)) or 1) - 1
    rows, columns = shapes[buffer]
    first, last = int(need("startSample")) - 1, int(need("endSample"))
    if not 0 <= first < last <= rows:
        raise FormatError(
            f"Receive({k + 1}) writes rows {first + 1} to {last}, but RcvData{{{buffer + 1}}} has"
            f" {rows} rows"
        )
    sampling, rate_hz, carrier_hz = _sampling(receive, k, machine)
    one_way = wave.delays_s is None
    late_s = machine.lens_s if one_way else wave.peak_s + 2 * machine.lens_s
    active = _active(receive, k, len(machine.channels))
    channels = machine.channels[active]
    if channels.max() >= columns:
        # A machine with fewer receive channels switches them between parts of the array.
        channels = channels % columns
    if len(set(channels.tolist())) != len(channels):
        raise FormatError(
            f"Receive({k + 1}) takes {len(channels)} elements from {columns} columns of RcvData:"
            " this multiplexed aperture is not understood"
        )
    return Shot(
        buffer=buffer,
        cuts=[Cut(active, channels, first)],
        rows=last - first,
        sampling=sampling,
        rate_hz=rate_hz,
        carrier_hz=carrier_hz,
        start_s=2 * need("startDepth") / machine.frequency_hz - late_s,
        delays_s=wave.delays_s,
        wave=wave.key,
        interval_s=math.nan,
    )


def _active(receive: MatNode, k: int, elements: int) -> np.ndarray:
    node = receive.field("Apod", k)
    if node is None or node.count == 0:
        return np.arange(elements)
    active = np.flatnonzero(vector(node, node.name, elements))
    if len(active) == 0:
        raise FormatError(f"{node.name} is all zero: nothing was received")
    return active


def _sampling(receive: MatNode, k: int, machine: Machine) -> tuple[Sampling, float, float]:
    """Return how samples are to be understood, their rate, and the frequency of pairs."""
    node = receive.field("sampleMode", k)
    mode = "NS200BW" if node is None or node.count == 0 else node.text()
    if mode not in MODES:
        raise FormatError(
            f"Receive({k + 1}).sampleMode is '{mode[:40]}', but must be one of {', '.join(MODES)}"
        )
    sampling, factor = MODES[mode]
    rate_mhz = optional_number(receive.field("decimSampleRate", k))
    per_wave = optional_number(receive.field("samplesPerWave", k))
    if rate_mhz is not None:
        rows_hz = rate_mhz * HZ_PER_MHZ / factor
    elif per_wave is not None:
        rows_hz = per_wave * machine.frequency_hz
    else:
        raise FormatError(f"Receive({k + 1}) has neither decimSampleRate nor samplesPerWave")
    if not rows_hz > 0:
        raise FormatError(f"the sampling frequency of Receive({k + 1}) is {rows_hz:g} Hz")
    demodulation = optional_number(receive.field("demodFrequency", k))
    carrier_hz = machine.frequency_hz if demodulation is None else demodulation * HZ_PER_MHZ
    rate_hz = {"rf": rows_hz, "quadrature": rows_hz / 2, "interleaved": rows_hz * 2}[sampling]
    return sampling, rate_hz, carrier_hz


def _join_interleaved(shots: list[Shot]) -> list[Shot]:
    """Join pairs whose transmits are half a sample apart; the later one starts earlier."""
    joined: list[Shot] = []
    waiting: Shot | None = None
    for shot in shots:
        if shot.sampling != "interleaved":
            joined.append(shot)
        elif waiting is None:
            waiting = shot
        else:
            joined.append(_interleave(waiting, shot))
            waiting = None
    if waiting is not None:
        raise FormatError(
            "interleaved acquisitions (NS200BWI) must come in pairs; one is left over"
        )
    return joined


def _interleave(first: Shot, second: Shot) -> Shot:
    if first.delays_s is None or second.delays_s is None:
        raise FormatError("photoacoustic acquisitions cannot be interleaved (NS200BWI)")
    if (first.rows, first.buffer) != (second.rows, second.buffer):
        raise FormatError("two interleaved acquisitions (NS200BWI) must be of the same length")
    late_s = first.delays_s - second.delays_s
    steps = late_s[np.isfinite(late_s)] * first.rate_hz
    misses = np.abs(np.abs(steps) - 1)
    if len(steps) == 0 or max(misses.max(), np.ptp(steps)) > STEP_TOLERANCE:
        raise FormatError(
            "the transmits of two interleaved acquisitions (NS200BWI) must be half a sample"
            f" ({1 / first.rate_hz:.3g} s) apart"
        )
    # Seen from its transmit, the acquisition whose transmit is later has earlier samples.
    early, late = (first, second) if steps[0] > 0 else (second, first)
    cuts = [replace(cut, step=0) for cut in early.cuts] + [
        replace(cut, step=1) for cut in late.cuts
    ]
    start_s = late.start_s - 1 / late.rate_hz
    return replace(
        late,
        cuts=cuts,
        start_s=start_s,
        interval_s=first.interval_s + second.interval_s,
    )


def _join_apertures(shots: list[Shot], elements: int) -> list[Shot]:
    """Join shots of the same wave that other parts of the array received."""
    joined: list[Shot] = []
    received: set[int] = set()
    for shot in shots:
        own = {int(element) for cut in shot.cuts for element in cut.elements}
        last = joined[-1] if joined else None
        goes_on = (
            last is not None
            and len(received) < elements
            and not own & received
            and (last.wave, last.buffer, last.rows, last.start_s)
            == (shot.wave, shot.buffer, shot.rows, shot.start_s)
        )
        if goes_on and last is not None:
            joined[-1] = replace(
                last, cuts=last.cuts + shot.cuts, interval_s=last.interval_s + shot.interval_s
            )
            received |= own
        else:
            joined.append(shot)
            received = own
    return joined

"""Photoacoustic scans of iThera's MSOT machines: a folder with ``.msot``, ``.bin`` and ``.irf``.

=================== ======================================================================
``Scan_9.msot``     XML: the array, the wavelengths, and when each frame was taken
``Scan_9.bin``      uint16, little-endian: (frames, elements, samples); the wavelengths of a
                    repetition follow one another
``Scan_9.irf``      float64: electrical impulse response, as long as a recording; the number
                    1000 is added to its first value (see :func:`read_msot_impulse_response`)
=================== ======================================================================

What is taken from the XML:

============================================= ============================================
``HARDWARE-DESC/SAMPLING-FREQUENCY``          MHz
``HARDWARE-DESC/FRAME-DESC/PROJECTION``       one per element, ``VALUE`` × 3: position in m;
                                              the origin is the middle of the ring
``MEASUREMENT-DESC/RECORDED-LENGTH``          samples
``MEASUREMENT-DESC/REPETITION-RATE``          laser shots per second
``MEASUREMENT-DESC/WAVELENGTHS/WAVELENGTH``   nm
``ScanNode/ScanFrames/DataModelScanFrame/Frame``  ``timestamp`` in 100 ns, ``WAVELENGTH``,
                                              ``TEMPERATURE`` (°C), ``LASER-ENERGY`` (mJ),
                                              ``Z-POS`` (mm)
============================================= ============================================

The origin stays the middle of the ring. The array is turned in its plane so that the first
element is on the left and the axial axis points from the arc's middle to the origin; a turn
does not mirror. The stored numbers are centered at 2¹⁵, which is taken off. Neither the sound
speed nor the elements' band is in the file; the notes say what stands in for them.

References:
    Marczak W, "Water as a standard in the measurements of speed of sound in liquids", JASA
    102:2776, 1997 (speed of sound in water from its temperature).
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float

from sonosweep.errors import FormatError
from sonosweep.io.channel_frames import check_sizes
from sonosweep.io.element_axes import plane_coordinates
from sonosweep.io.safe_xml import parse_xml
from sonosweep.scan import ChannelData, ChannelSweep, LazyFrames, Probe

MM_PER_M = 1000.0
TICKS_PER_S = 1e7
LONGEST_TIMESTAMP = 20
HALF_RANGE = 2**15
LARGEST_XML_MB = 256  # some hundred thousand frames
ASSUMED_FREQUENCY_HZ = 5e6
ASSUMED_SPEED_M_PER_S = 1500.0
# Marczak's polynomial, m/s, of the temperature in °C from 0 to 95.
WATER_SPEED = (1402.385, 5.038813, -5.799136e-2, 3.287156e-4, -1.398845e-6, 2.787860e-9)
IRF_MARK = 1000.0
SAME_WAVELENGTH_NM = 0.01


class MsotFrames(LazyFrames):
    """Samples ``(frames, 1, elements, samples)`` of a ``.bin`` file, read when indexed.

    Args:
        path: The file.
        places: Which of the stored frames, in this order.
        elements: Of the array.
        samples: Of one recording.
    """

    def __init__(self, path: Path, places: np.ndarray, elements: int, samples: int) -> None:
        super().__init__((len(places), 1, elements, samples), np.dtype(np.int16))
        self._path, self._places = path, places

    def _read(self, frame: int) -> np.ndarray:
        count = self._shape[2] * self._shape[3]
        offset = 2 * count * int(self._places[frame])
        try:
            stored = np.fromfile(self._path, "<u2", count, offset=offset)
        except OSError as error:
            raise FormatError(f"cannot read '{self._path}': {error.strerror or error}") from error
        if len(stored) != count:
            raise FormatError(f"'{self._path.name}' changed after it was opened: open it again")
        return (stored.astype(np.int32) - HALF_RANGE).astype(np.int16).reshape(self._shape[1:])


@dataclass(frozen=True)
class Shot:
    """One laser shot (or the mean of several) as the XML tells it; ``nan`` for what is not told.

    Attributes:
        time_s: From an arbitrary zero.
        wavelength_nm: Of the laser.
        temperature_c: Of the water.
        energy_mj: Of the laser.
        z_mm: Where the stage was.
    """

    time_s: float
    wavelength_nm: float
    temperature_c: float
    energy_mj: float
    z_mm: float


def is_msot(path: str | os.PathLike) -> bool:
    """Say whether a path is an ``.msot`` file or a folder with one."""
    path = Path(path)
    return path.suffix.lower() == ".msot" or (path.is_dir() and any(path.glob("*.msot")))


def read_msot(path: str | os.PathLike, *, wavelength_nm: float | None = None) -> ChannelSweep:
    """Return an MSOT scan as photoacoustic channel data.

    Args:
        path: The ``.msot`` file, or the folder that holds it.
        wavelength_nm: Which frames to take; needed if the scan has several wavelengths.

    Raises:
        FormatError: If a file is missing, damaged or shorter than the XML says, the array is
            not plane, or the wavelength is not there.
    """
    file = _find(Path(path))
    root = parse_xml(file, "MSOT scan", LARGEST_XML_MB)
    positions_m = _positions(root, file)
    samples = int(_number(_need(root, "RECORDED-LENGTH", file), file))
    shots = _shots(root, file)
    stored = _beside(file, ".bin")
    check_sizes(f"'{stored.name}'", (len(shots), 1, len(positions_m), samples), np.dtype("<u2"))
    _check_length(stored, len(shots), len(positions_m), samples)
    chosen = _choose(shots, wavelength_nm, file)
    taken = [shots[place] for place in chosen]
    speed, said = _sound_speed(taken)
    data = ChannelData(
        name=file.stem,
        samples=MsotFrames(stored.absolute(), chosen, len(positions_m), samples),
        probe=_probe(positions_m, root, file),
        sampling_frequency_hz=_number(_need(root, "SAMPLING-FREQUENCY", file), file) * 1e6,
        start_time_s=torch.zeros(1, dtype=torch.float64),
        sound_speed_m_per_s=speed,
        timestamps_s=_times(taken),
        pulse_repetition_hz=_optional_number(root, "REPETITION-RATE", file),
    )
    return ChannelSweep(name=file.stem, photoacoustic=data, notes=_notes(taken, said))


def read_msot_impulse_response(path: str | os.PathLike) -> Float[np.ndarray, " samples"]:
    """Return the electrical impulse response of an MSOT scan, sampled as the recordings.

    Args:
        path: The ``.msot`` file, or the folder that holds it.

    Raises:
        FormatError: If there is none, or it is no list of numbers.
    """
    file = _beside(_find(Path(path)), ".irf")
    if file.stat().st_size % 8 or not 0 < file.stat().st_size < 2**24:
        raise FormatError(f"'{file.name}' is no impulse response: expected float64 numbers")
    response = np.fromfile(file, "<f8").astype(np.float64)
    if not np.isfinite(response).all():
        raise FormatError(f"'{file.name}' is damaged: not all of it are numbers")
    if response[0] >= IRF_MARK:
        response[0] -= IRF_MARK
    return response


def _find(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = sorted(path.glob("*.msot"))
    if len(found) != 1:
        raise FormatError(f"folder '{path.name}' holds {len(found)} .msot files: name one")
    return found[0]


def _beside(file: Path, suffix: str) -> Path:
    if not (other := file.with_suffix(suffix)).is_file():
        raise FormatError(f"'{file.name}' needs '{other.name}' beside it, which is not there")
    return other


def _need(root: Element, name: str, file: Path) -> Element:
    if (node := root.find(f".//{name}")) is None:
        raise FormatError(f"'{file.name}' is no MSOT scan: it has no {name}")
    return node


def _number(node: Element, file: Path) -> float:
    try:
        value = float(node.text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(f"{node.tag} in '{file.name}' must be a number, got '{node.text}'"[:300])
    return value


def _optional_number(node: Element, name: str, file: Path) -> float | None:
    found = node.find(f".//{name}")
    if found is None or not (found.text or "").strip():
        return None
    return _number(found, file) or None


def _positions(root: Element, file: Path) -> np.ndarray:
    rows = [
        [_number(value, file) for value in projection.iter("VALUE")]
        for projection in _need(root, "FRAME-DESC", file).iter("PROJECTION")
    ]
    if len(rows) < 2 or {len(row) for row in rows} != {3}:
        raise FormatError(f"'{file.name}' does not tell where its elements are, x, y and z of each")
    return np.array(rows)


def _shots(root: Element, file: Path) -> list[Shot]:
    def number(frame: Element, name: str) -> float:
        found = frame.find(name)
        return math.nan if found is None or not found.text else _number(found, file)

    frames = _need(root, "ScanFrames", file).iter("Frame")
    shots = [
        Shot(
            time_s=_ticks(frame) / TICKS_PER_S,
            wavelength_nm=number(frame, "WAVELENGTH"),
            temperature_c=number(frame, "TEMPERATURE"),
            energy_mj=number(frame, "LASER-ENERGY"),
            z_mm=number(frame, "Z-POS"),
        )
        for frame in frames
    ]
    if not shots:
        raise FormatError(f"'{file.name}' has no frames")
    return _with_wavelengths(shots, root, file)


def _ticks(frame: Element) -> float:
    text = frame.get("timestamp", "")
    # Since the year 1: the difference to a day nearby keeps 100 ns in a float64.
    is_number = text.isdecimal() and len(text) < LONGEST_TIMESTAMP
    return float(int(text) - 630_000_000_000_000_000) if is_number else math.nan


def _with_wavelengths(shots: list[Shot], root: Element, file: Path) -> list[Shot]:
    """Return the shots with the scan's list of wavelengths, where they tell none themselves."""
    if all(math.isfinite(shot.wavelength_nm) for shot in shots):
        return shots
    table = root.find(".//WAVELENGTHS")
    listed = [] if table is None else [_number(node, file) for node in table.iter("WAVELENGTH")]
    if not listed:
        raise FormatError(f"'{file.name}' does not tell the wavelength of its frames")
    return [
        Shot(shot.time_s, listed[k % len(listed)], shot.temperature_c, shot.energy_mj, shot.z_mm)
        for k, shot in enumerate(shots)
    ]


def _check_length(stored: Path, frames: int, elements: int, samples: int) -> None:
    """A scan that was stopped early has more frames in the XML's plan than there are."""
    frame_bytes = 2 * elements * samples
    size = stored.stat().st_size
    if size < frames * frame_bytes or size % frame_bytes:
        raise FormatError(
            f"'{stored.name}' has {size:,} bytes, but {frames} frames of {elements} elements and"
            f" {samples} samples are {frames * frame_bytes:,}: copy it again"
        )


def _choose(shots: list[Shot], wavelength_nm: float | None, file: Path) -> np.ndarray:
    """Return the places of the frames of one wavelength."""
    found = np.array([shot.wavelength_nm for shot in shots])
    known = sorted(set(found.tolist()))
    told = ", ".join(f"{value:g}" for value in known[:20])
    if wavelength_nm is None:
        if len(known) > 1:
            raise FormatError(
                f"'{file.name}' has frames at {told} nm: say which with wavelength_nm"
            )
        wavelength_nm = known[0]
    places = np.flatnonzero(abs(found - wavelength_nm) < SAME_WAVELENGTH_NM)
    if len(places) == 0:
        raise FormatError(f"'{file.name}' has no frame at {wavelength_nm:g} nm, only at {told} nm")
    return places


def _probe(positions_m: np.ndarray, root: Element, file: Path) -> Probe:
    named = root.find(".//TRANSDUCER")
    plane = plane_coordinates(positions_m, None, file.name)
    return Probe(
        name=(named.text if named is not None and named.text else "MSOT").strip()[:80],
        element_positions_mm=torch.from_numpy(plane * MM_PER_M),
        element_width_mm=MM_PER_M
        * float(np.median(np.linalg.norm(np.diff(plane, axis=0), axis=1))),
        center_frequency_hz=ASSUMED_FREQUENCY_HZ,
    )


def _sound_speed(shots: list[Shot]) -> tuple[float, str]:
    temperatures = [shot.temperature_c for shot in shots if 0 < shot.temperature_c < 95]
    if not temperatures:
        speed = ASSUMED_SPEED_M_PER_S
        return speed, f"assumed {speed:g} m/s: the file tells no temperature"
    temperature = float(np.mean(temperatures))
    speed = float(np.polynomial.polynomial.polyval(temperature, WATER_SPEED))
    return speed, f"{speed:.1f} m/s, of water at {temperature:.1f} °C: the file tells none"


def _times(shots: list[Shot]) -> torch.Tensor | None:
    times = np.array([shot.time_s for shot in shots])
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        return None
    return torch.from_numpy(times - times[0])


def _notes(shots: list[Shot], sound_speed: str) -> dict[str, str]:
    notes = {
        "wavelength": f"{shots[0].wavelength_nm:g} nm",
        "sound speed": sound_speed,
        "center frequency": f"assumed {ASSUMED_FREQUENCY_HZ / 1e6:g} MHz: the file tells none",
        "origin": "middle of the ring, not of the array's face",
    }
    kinds: tuple[tuple[str, str, Callable[[Shot], float]], ...] = (
        ("laser energy", "mJ", lambda shot: shot.energy_mj),
        ("stage position", "mm", lambda shot: shot.z_mm),
    )
    for what, unit, get in kinds:
        values = [get(shot) for shot in shots if math.isfinite(get(shot))]
        if values:
            notes[what] = f"{min(values):g} to {max(values):g} {unit}"
    return notes

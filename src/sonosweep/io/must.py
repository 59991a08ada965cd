"""Channel data as users of the MATLAB toolbox MUST (and PyMUST) save it.

=============== ==========================================================================
``RF``          samples × elements × frames; the third axis counts transmits instead if
                ``param.TXdelay`` has that many rows
``param``       a struct, numbers in SI units:
``.fs``         sampling frequency
``.fc``         center frequency of the probe; may be above half of ``.fs`` (band-pass
                sampling)
``.pitch``      distance of neighboring elements, along the arc's chord if curved
``.width``      of an element; or ``.kerf``, the gap between two
``.radius``     of a curved array; absent or infinite if it is straight
``.TXdelay``    when each element fires; (transmits ×) elements; 0 if absent
``.t0``         time of the first sample; 0 if absent
``.c``          sound speed; 1540 m/s if absent
``.PRF``        frames (or transmits) per second, if known
``.Nelements``  if there, it must agree with ``RF``
``.height``, ``.focus``  elevation aperture and focus, if known
=============== ==========================================================================

The middle of the array's face is the origin. Files of any MATLAB version since 5 are read;
before ``-v7.3`` the samples can only be read whole, when the first frame is asked for.

References:
    Garcia D, "Make the most of MUST, an open-source MATLAB UltraSound Toolbox", IEEE IUS 2021.
"""

import os
from pathlib import Path

import h5py
import numpy as np
import torch

from sonosweep.errors import FormatError
from sonosweep.io.channel_frames import check_sizes
from sonosweep.io.matlab_variables import Variable, explaining, list_new, list_old
from sonosweep.scan import ChannelData, ChannelSweep, Frames, LazyFrames, Probe

MM_PER_M = 1000.0
LARGEST_PITCH_M = 1.0
LARGEST_PARAMETER = 4096 * 4096  # delays of 4096 transmits and elements


class MustFrames(LazyFrames):
    """Samples ``(frames, transmits, elements, samples)`` of ``samples × elements`` matrices.

    Args:
        matrices: One matrix for each transmit of each frame.
        transmits: How many of them make a frame.
    """

    def __init__(self, matrices: Frames, transmits: int) -> None:
        count, samples, elements = matrices.shape
        super().__init__((count // transmits, transmits, elements, samples), matrices.dtype)
        self._matrices, self._transmits = matrices, transmits

    def _read(self, frame: int) -> np.ndarray:
        first = frame * self._transmits
        stack = self._matrices[first : first + self._transmits]
        return np.ascontiguousarray(stack.swapaxes(1, 2))


def is_must(path: str | os.PathLike) -> bool:
    """Say whether a MATLAB file holds channel data in MUST's manner."""
    variables = _list(Path(path))
    return "RF" in variables and any(f"param.{name}" in variables for name in ("fs", "fc"))


def read_must(path: str | os.PathLike) -> ChannelSweep:
    """Return MUST's channel data as B-mode channel data of a sweep.

    Raises:
        FormatError: If ``RF`` or a needed parameter is missing or of another form.
        ScanError: If the geometry does not fit the samples.
    """
    file = Path(path)
    variables = _list(file)
    matrices = _matrices(variables.get("RF"), file)
    elements = matrices.shape[2]
    parameters = Parameters(variables, file)
    if (stated := parameters.get("Nelements")) not in (None, elements):
        raise FormatError(
            f"param.Nelements of '{file.name}' is {stated:g}, but RF has {elements} columns: RF"
            " must be samples x elements x frames"
        )
    delays = parameters.delays(elements)
    transmits = len(delays)
    if transmits not in (1, len(matrices)):
        raise FormatError(
            f"param.TXdelay of '{file.name}' has {transmits} rows, but RF has {len(matrices)}"
            " matrices: needed is one row for each transmit, or one for all"
        )
    rate = parameters.get("PRF")
    times = None
    if rate is not None and transmits == 1:
        times = torch.arange(len(matrices), dtype=torch.float64) / rate
    data = ChannelData(
        name=file.stem,
        samples=MustFrames(matrices, transmits),
        probe=_probe(parameters, elements),
        sampling_frequency_hz=parameters.need("fs"),
        start_time_s=torch.full((transmits,), parameters.get("t0") or 0.0, dtype=torch.float64),
        transmit_delays_s=torch.from_numpy(delays),
        sound_speed_m_per_s=parameters.get("c") or 1540.0,
        timestamps_s=times,
        pulse_repetition_hz=rate,
    )
    return ChannelSweep(name=file.stem, b_mode=data)


class Parameters:
    """MUST's ``param``, as numbers.

    Args:
        variables: Of the whole file.
        file: For messages.
    """

    def __init__(self, variables: dict[str, Variable], file: Path) -> None:
        self._variables, self._file = variables, file

    def values(self, name: str) -> np.ndarray | None:
        """Return a parameter, ``None`` if it is absent or empty.

        Raises:
            FormatError: If it holds something but finite numbers, or infinity.
        """
        variable = self._variables.get(f"param.{name}")
        if variable is None or 0 in variable.shape:
            return None
        if not variable.numeric or np.prod(variable.shape, dtype=float) > LARGEST_PARAMETER:
            raise FormatError(f"param.{name} of '{self._file.name}' must hold numbers")
        values = np.atleast_2d(variable.load().astype(np.float64))
        if np.isnan(values).any():
            raise FormatError(
                f"param.{name} of '{self._file.name}' holds values that are no numbers"
            )
        return values

    def get(self, name: str) -> float | None:
        """Return a parameter that is one number, ``None`` if it is absent."""
        values = self.values(name)
        if values is None:
            return None
        if values.size != 1:
            raise FormatError(f"param.{name} of '{self._file.name}' must be one number")
        return float(values.item())

    def need(self, name: str) -> float:
        """Return a parameter that is one number and must be there."""
        value = self.get(name)
        if value is None or not np.isfinite(value):
            raise FormatError(f"'{self._file.name}' lacks the number param.{name}")
        return value

    def delays(self, elements: int) -> np.ndarray:
        """Return when each element fires, (transmits, elements); 0 if nothing is said."""
        delays = self.values("TXdelay")
        if delays is None:
            return np.zeros((1, elements))
        if delays.shape[1] != elements and delays.shape[0] == elements:
            delays = delays.T
        if delays.shape[1] != elements:
            raise FormatError(
                f"param.TXdelay of '{self._file.name}' is {delays.shape[0]} x {delays.shape[1]},"
                f" but RF has {elements} columns"
            )
        return np.ascontiguousarray(delays)


def _list(file: Path) -> dict[str, Variable]:
    if not file.is_file():
        raise FormatError(f"there is no file '{file}'")
    with explaining(file):
        is_new = bool(h5py.is_hdf5(str(file)))
    return list_new(file) if is_new else list_old(file, "param.fs")


def _matrices(variable: Variable | None, file: Path) -> Frames:
    """Return the samples x elements matrices of RF."""
    if variable is None or not variable.numeric or len(variable.shape) not in (2, 3):
        found = "is missing" if variable is None else f"has the shape {variable.shape}"
        raise FormatError(
            f"RF of '{file.name}' must be real numbers, samples x elements x frames, but {found}"
        )
    shape = (*variable.shape, 1)[:3]
    check_sizes(f"RF of '{file.name}'", (shape[2], 1, shape[1], shape[0]), np.dtype(np.float64))
    return variable.load()[None] if len(variable.shape) == 2 else variable.frames()


def _probe(parameters: Parameters, elements: int) -> Probe:
    pitch, radius = parameters.need("pitch"), parameters.get("radius")
    if not 0 < pitch < LARGEST_PITCH_M:
        raise FormatError(f"param.pitch must be above 0 and below 1 m, got {pitch:g}")
    width = parameters.get("width")
    if width is None:
        width = pitch - (parameters.get("kerf") or 0.0)
    steps = np.arange(elements) - (elements - 1) / 2
    positions = np.zeros((elements, 3))
    positions[:, 0] = steps * pitch
    if radius is not None and np.isfinite(radius):
        angles = steps * 2 * np.arcsin(min(pitch / 2 / radius, 1.0))
        positions[:, 0], positions[:, 1] = radius * np.sin(angles), radius * (np.cos(angles) - 1)
    height, focus = parameters.get("height"), parameters.get("focus")
    return Probe(
        name="MUST",
        element_positions_mm=torch.from_numpy(positions * MM_PER_M),
        element_width_mm=width * MM_PER_M,
        center_frequency_hz=parameters.need("fc"),
        elevation_aperture_mm=_finite_mm(height),
        elevation_focus_mm=_finite_mm(focus),
    )


def _finite_mm(value_m: float | None) -> float | None:
    """MUST says infinite for an array without a lens."""
    return None if value_m is None or not np.isfinite(value_m) else value_m * MM_PER_M

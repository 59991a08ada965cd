"""The one place that looks at a path and decides how its channel data is read."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.io.open import HDF5, printable
from sonosweep.scan import ChannelSweep

KNOWN = "MUST and Verasonics (.mat), HDF5 (.h5 .hdf5 .uff) and MSOT (.msot or its folder)"
CHANNEL_HDF5 = (*HDF5, ".uff")
Reader = Callable[[Path], ChannelSweep]


def open_channel_data(
    path: str | os.PathLike, *, wavelength_nm: float | None = None
) -> ChannelSweep:
    """Return the channel data in a file or folder of any format that we read.

    Samples are read when indexed, where the format allows it.

    Args:
        path: A file, or the folder of an MSOT scan.
        wavelength_nm: Which frames of a photoacoustic recording of several wavelengths.

    Raises:
        FormatError: If the file is missing, of no known format, broken, or beamformed
            already.
        ScanError: If its parts contradict each other.
    """
    file = Path(path)
    if file.name in ("", ".."):  # the folder where one is has a name too
        file = file.resolve()
    if not file.exists():
        raise FormatError(f"there is no '{file}'")
    sweep = _read(file, wavelength_nm)
    return replace(sweep, name=printable(sweep.name))


def is_channel_data(path: str | os.PathLike) -> bool:
    """Say whether :func:`open_channel_data` knows the format of a file or folder."""
    from sonosweep.io.msot import is_msot

    file = Path(path)
    try:
        if is_msot(file):
            return True
        if not file.is_file():
            return False
        return _mat_reader(file) is not None or _hdf5_reader(file) is not None
    except SonosweepError:
        return False


def _read(file: Path, wavelength_nm: float | None) -> ChannelSweep:
    from sonosweep.io.hdf5_access import open_hdf5
    from sonosweep.io.ipasc import read_ipasc
    from sonosweep.io.msot import is_msot, read_msot

    if is_msot(file):
        return read_msot(file, wavelength_nm=wavelength_nm)
    if file.is_dir():
        raise FormatError(f"folder '{file.name}' holds no channel data; we read {KNOWN}")
    if file.stat().st_size == 0:
        raise FormatError(f"'{file.name}' is empty")
    if file.suffix.lower() in CHANNEL_HDF5:
        with open_hdf5(file):  # says it if the file is damaged, which is no question of layout
            pass
    read = _mat_reader(file) or _hdf5_reader(file)
    if read is None:
        raise FormatError(_unknown(file))
    if read is read_ipasc:
        return read_ipasc(file, wavelength_nm=wavelength_nm)
    if wavelength_nm is not None:
        raise FormatError(f"'{file.name}' does not tell wavelengths: leave out wavelength_nm")
    return read(file)


def _mat_reader(file: Path) -> Reader | None:
    from sonosweep.io.must import is_must, read_must
    from sonosweep.io.verasonics import is_verasonics, read_verasonics

    if file.suffix.lower() != ".mat":
        return None
    if is_verasonics(file):
        return read_verasonics
    return read_must if is_must(file) else None


def _hdf5_reader(file: Path) -> Reader | None:
    """Ask each layout whether the file is one of its own."""
    from sonosweep.io.channel_hdf5 import is_channel_hdf5, read_channels
    from sonosweep.io.ipasc import is_ipasc, read_ipasc
    from sonosweep.io.picmus import is_picmus, read_picmus
    from sonosweep.io.uff import is_uff, read_uff

    if file.suffix.lower() not in CHANNEL_HDF5:
        return None
    layouts: tuple[tuple[Callable[[Path], bool], Reader], ...] = (
        (is_channel_hdf5, read_channels),
        (is_ipasc, read_ipasc),
        (is_picmus, read_picmus),
        (is_uff, read_uff),
    )
    return next((read for recognizes, read in layouts if recognizes(file)), None)


def _unknown(file: Path) -> str:
    from sonosweep.io.hdf5 import is_scan_hdf5

    if file.suffix.lower() == ".mat":
        return (
            f"'{file.name}' holds no channel data that we know: neither Verasonics' RcvData and"
            " Trans nor MUST's RF and param"
        )
    if file.suffix.lower() not in CHANNEL_HDF5:
        return f"'{file.name}' is of no format that holds channel data; we read {KNOWN}"
    if is_scan_hdf5(file):
        return f"'{file.name}' is a scan, which is beamformed already: use 'sonosweep reconstruct'"
    return f"'{file.name}' is HDF5 but holds no channel data of a layout we know"

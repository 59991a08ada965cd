"""The one place that looks at a path and decides how its channel data is read."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sonosweep.errors import FormatError
from sonosweep.io.open import HDF5, printable
from sonosweep.scan import ChannelSweep

KNOWN = "MUST and Verasonics (.mat), HDF5 (.h5 .hdf5 .uff) and MSOT (.msot or its folder)"
CHANNEL_HDF5 = (*HDF5, ".uff")


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


def _read(file: Path, wavelength_nm: float | None) -> ChannelSweep:
    from sonosweep.io.msot import is_msot, read_msot

    if is_msot(file):
        return read_msot(file, wavelength_nm=wavelength_nm)
    if file.is_dir():
        raise FormatError(f"folder '{file.name}' holds no channel data; we read {KNOWN}")
    if file.stat().st_size == 0:
        raise FormatError(f"'{file.name}' is empty")
    if file.suffix.lower() == ".mat":
        return _read_mat(file)
    if file.suffix.lower() in CHANNEL_HDF5:
        return _read_hdf5(file, wavelength_nm)
    raise FormatError(f"'{file.name}' is of no format that holds channel data; we read {KNOWN}")


def _read_mat(file: Path) -> ChannelSweep:
    from sonosweep.io.must import is_must, read_must
    from sonosweep.io.verasonics import is_verasonics, read_verasonics

    if is_verasonics(file):
        return read_verasonics(file)
    if is_must(file):
        return read_must(file)
    raise FormatError(
        f"'{file.name}' holds no channel data that we know: neither Verasonics' RcvData and Trans"
        " nor MUST's RF and param"
    )


def _read_hdf5(file: Path, wavelength_nm: float | None) -> ChannelSweep:
    from sonosweep.io.channel_hdf5 import is_channel_hdf5, read_channels
    from sonosweep.io.hdf5 import is_scan_hdf5
    from sonosweep.io.hdf5_access import open_hdf5
    from sonosweep.io.ipasc import is_ipasc, read_ipasc
    from sonosweep.io.picmus import is_picmus, read_picmus
    from sonosweep.io.uff import is_uff, read_uff

    with open_hdf5(file):  # says it if the file is damaged, which is no question of layout
        pass
    if is_ipasc(file):
        return read_ipasc(file, wavelength_nm=wavelength_nm)
    layouts: tuple[tuple[Callable[[Path], bool], Callable[[Path], ChannelSweep]], ...] = (
        (is_channel_hdf5, read_channels),
        (is_picmus, read_picmus),
        (is_uff, read_uff),
    )
    for recognizes, read in layouts:
        if recognizes(file):
            return read(file)
    if is_scan_hdf5(file):
        raise FormatError(
            f"'{file.name}' is a scan, which is beamformed already: use 'sonosweep reconstruct'"
        )
    raise FormatError(f"'{file.name}' is HDF5 but holds no channel data of a layout we know")

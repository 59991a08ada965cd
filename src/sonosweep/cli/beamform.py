"""``sonosweep beamform``: channel data to a scan."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from sonosweep.cli.inputs import OUTPUT, Force, Json
from sonosweep.cli.whole_number import WHOLE, WHOLE_OR_AUTO

IMAGE = Group("Where the pixels lie", sort_key=2)
BEAMFORMING = Group("Beamforming", sort_key=2)


@Parameter(name="*", group=IMAGE)
@dataclass(frozen=True)
class PixelOptions:
    """Where the pixels lie; what is not given follows from the array and the recording.

    Attributes:
        columns: Pixels across.
        rows: Pixels in depth.
        pixel_mm: Distance between pixels.
        depth_mm: Depth at which the image ends; in an array that surrounds the body, how far
            from its middle.
    """

    columns: Annotated[int | None, WHOLE] = None
    rows: Annotated[int | None, WHOLE] = None
    pixel_mm: float | None = None
    depth_mm: float | None = None


@Parameter(name="*", group=BEAMFORMING)
@dataclass(frozen=True)
class BeamformingOptions:
    """How channel data become frames.

    Attributes:
        sound_speed: In the medium, m/s; what the file says otherwise.
        f_number: Depth over width of the receive aperture, or "all" elements. Otherwise 1.5
            for echoes, 1 for photoacoustics, and all in an array that surrounds the body.
        dynamic_range_db: Of B-mode; 60 otherwise, and 40 where photoacoustic frames stand in.
        power_doppler_range_db: Of power Doppler; 30 otherwise.
        clutter_rank: How many slow-time components of an ensemble are tissue, or "auto", as
            otherwise.
        photoacoustic_band_mhz: Lower and upper edge of what to keep of photoacoustic samples.
        wavelength_nm: Which frames of a photoacoustic recording of several wavelengths.
        amplitude: Keep the amplitude before log compression as well.
    """

    sound_speed: float | None = None
    f_number: float | Literal["all"] | None = None
    dynamic_range_db: float | None = None
    power_doppler_range_db: float | None = None
    clutter_rank: Annotated[int | Literal["auto"] | None, WHOLE_OR_AUTO] = None
    photoacoustic_band_mhz: Annotated[tuple[float, float] | None, Parameter(negative="")] = None
    wavelength_nm: float | None = None
    amplitude: Annotated[bool, Parameter(negative="")] = False


def beamform(
    data: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], group=OUTPUT)],
    pixels: PixelOptions | None = None,
    beamforming: BeamformingOptions | None = None,
    anonymize: Annotated[bool, Parameter(group=OUTPUT)] = True,
    force: Force = False,
    json: Json = False,
) -> None:
    """Turn channel data into B-mode, power Doppler and photoacoustic frames.

    Reads Verasonics and MUST (.mat), UFF, PICMUS, IPASC and our own HDF5, and MSOT. The
    frames make a scan that reconstruct takes; only .h5 holds power Doppler and photoacoustic
    frames beside B-mode.

    Args:
        data: File or folder of channel data.
        output: Where to write: as for convert.
        anonymize: Leave out who was scanned.
    """
    from sonosweep.cli.beamform_job import run_beamform
    from sonosweep.cli.output import say

    line, facts = run_beamform(
        data,
        output,
        pixels or PixelOptions(),
        beamforming or BeamformingOptions(),
        keep_subject=not anonymize,
        force=force,
    )
    say(line, facts, json)

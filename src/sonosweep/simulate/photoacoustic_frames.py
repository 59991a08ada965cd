"""Photoacoustic frames at 750 nm: blood and skin that absorb light, heard by the array."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex64, Float, Float32, UInt8

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.blood import amplitudes_for_level, draw_blood, push_aside
from sonosweep.simulate.body import Body, Tissue
from sonosweep.simulate.deformation import STILL, Deformation
from sonosweep.simulate.point_spread import slice_width_mm
from sonosweep.simulate.speckle import render_points
from sonosweep.simulate.tissue_motion import body_to_plane

MELANIN_STEP_MM = (0.2, 0.5)  # between absorbers of the skin, lateral and elevational


@dataclass(frozen=True)
class PhotoacousticSettings:
    """Light, absorbers, noise.

    Attributes:
        fluence_per_mm: How fast light fades below the skin, on which it falls from the
            probe's side.
        blood_db: Pressure of blood in full light; the levels are those of a scanner.
        skin_db: Pressure of the melanin of the skin.
        noise_db: Electronic noise.
    """

    fluence_per_mm: float = 0.11
    blood_db: float = 0.0
    skin_db: float = -10.0
    noise_db: float = -40.0

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ScanError: If light grows with depth or a level is not a number.
        """
        if not np.isfinite(list(vars(self).values())).all() or self.fluence_per_mm < 0:
            raise ScanError(f"photoacoustics needs finite levels and fading light, got {self}")


def one_way_beam(beam: Beam) -> Beam:
    """Return the beam of an array that only listens.

    Sound travels once, so that phase turns half as fast and beams are wider by sqrt(2); the
    pulse is as long in time, which is twice as long in depth, but its band is wider by
    sqrt(2) because it passes the array only once.
    """
    return replace(
        beam,
        center_frequency_hz=beam.center_frequency_hz / 2,
        axial_fwhm_mm=beam.axial_fwhm_mm * float(np.sqrt(2)),
        lateral_fwhm_mm=beam.lateral_fwhm_mm * float(np.sqrt(2)),
        elevation_waist_mm=beam.elevation_waist_mm * float(np.sqrt(2)),
    )


def photoacoustic_iq(
    body: Body,
    plane_to_body: Float[np.ndarray, "4 4"],
    tissue: UInt8[np.ndarray, "rows columns"],
    grid: PixelGrid,
    beam: Beam,
    settings: PhotoacousticSettings,
    generator: np.random.Generator,
    deformation: Deformation = STILL,
) -> Complex64[np.ndarray, "rows columns"]:
    """Return the IQ of a photoacoustic frame; its magnitude is the image.

    Args:
        body: Its vessels and skin absorb.
        plane_to_body: Of the image.
        tissue: Label of each pixel, which says where the skin begins.
        grid: Of the image.
        beam: Of the array when it sends and listens.
        settings: Light and absorbers.
        generator: Draws blood and noise.
        deformation: How tissue is displaced.
    """
    listening = one_way_beam(beam)
    blood = draw_blood(body, plane_to_body, grid, listening, generator, deformation)
    level = amplitudes_for_level(settings.blood_db, blood.places_mm[:, 1], grid, listening)
    skin = _melanin(body, plane_to_body, grid, listening, deformation)
    # A sheet of absorbers adds up in phase.
    coherent = listening.elevation_waist_mm * listening.lateral_fwhm_mm
    part = 10 ** (settings.skin_db / 20) * MELANIN_STEP_MM[0] * MELANIN_STEP_MM[1] / coherent
    places = np.concatenate([blood.places_mm, skin])
    amplitudes = np.concatenate([level, np.full(len(skin), part)])
    iq = render_points(places, amplitudes, listening, grid)
    iq *= fluence(tissue, grid, settings.fluence_per_mm)
    noise = generator.standard_normal((grid.rows, 2 * grid.columns), np.float32)
    iq.view(np.float32)[:] += np.float32(10 ** (settings.noise_db / 20) / np.sqrt(2)) * noise
    return iq


def fluence(
    tissue: UInt8[np.ndarray, "rows columns"], grid: PixelGrid, per_mm: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return the light at each pixel, in parts of that on the skin above it."""
    bare = (tissue == Tissue.OUTSIDE) | (tissue == Tissue.GEL)
    first = np.where(bare.all(axis=0), 0, (~bare).argmax(axis=0))
    depth = np.arange(grid.rows, dtype=np.float32)[:, np.newaxis] - first.astype(np.float32)
    return np.exp(np.float32(-per_mm * grid.spacing_mm[1]) * np.maximum(depth, np.float32(0)))


def _melanin(
    body: Body,
    plane_to_body: Float[np.ndarray, "4 4"],
    grid: PixelGrid,
    beam: Beam,
    deformation: Deformation,
) -> Float[np.ndarray, "absorbers xyz=3"]:
    """Return absorbers on the skin's outer surface, in plane coordinates."""
    lateral = np.arange(grid.lateral_mm[0] - 1, grid.lateral_mm[-1] + 1, MELANIN_STEP_MM[0])
    reach = 1.4 * float(slice_width_mm(beam, np.zeros(1))[0])
    height = np.arange(-reach, reach, MELANIN_STEP_MM[1])
    x, z = (places.ravel() for places in np.meshgrid(lateral, height))
    affine = body_to_plane(plane_to_body, deformation)
    there = (np.stack([x, 0 * x, z], axis=1) - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
    there[:, 1] = _skin_depth(body, there[:, 0], there[:, 2])
    return push_aside(there @ affine[:3, :3].T + affine[:3, 3], deformation)


def _skin_depth(
    body: Body, x_mm: Float[np.ndarray, " places"], z_mm: Float[np.ndarray, " places"]
) -> Float[np.ndarray, " places"]:
    """Return the skin's depth at places of the body, interpolated between voxels."""
    rows, columns = body.skin_depth_mm.shape
    z = np.clip((z_mm - body.origin_mm[2]) / body.spacing_mm, 0, rows - 1.001)
    x = np.clip((x_mm - body.origin_mm[0]) / body.spacing_mm, 0, columns - 1.001)
    row, column = z.astype(np.int64), x.astype(np.int64)
    below, right = np.minimum(row + 1, rows - 1), np.minimum(column + 1, columns - 1)
    down, across = z - row, x - column
    skin = body.skin_depth_mm
    near = skin[row, column] * (1 - across) + skin[row, right] * across
    far = skin[below, column] * (1 - across) + skin[below, right] * across
    return near * (1 - down) + far * down

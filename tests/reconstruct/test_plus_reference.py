"""Volumes that PLUS made from a tracked sweep of a spine phantom, made again."""

import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import SimpleITK
import torch

from sonosweep.geometry import invert_pose, nearest_pose
from sonosweep.reconstruct.clip import Fan
from sonosweep.reconstruct.compound import compound_frames
from sonosweep.reconstruct.grid import grid_of_sweep
from sonosweep.scan import calibration_from_matrix, pixel_to_image

# PLUS truncates its mean at every insertion and uses fixed point: up to 2.9 gray levels.
LOWEST_CORRELATION = 0.985
LOWEST_PSNR_DB = 30.0
ORIGIN_DIGITS_MM = 1e-3  # PLUS prints six digits of coordinates around 100 mm


@pytest.fixture(scope="module")
def spine(recordings):
    """Return the frames, the tracker's poses of the probe, and the folder."""
    folder = recordings / "plus_spine_freehand"
    header, pixels = (
        (folder / "SpinePhantomFreehand.igs.mha")
        .read_bytes()
        .split(b"ElementDataFile = LOCAL\n", 1)
    )
    frames = np.frombuffer(zlib.decompress(pixels), np.uint8).reshape(21, 616, 820)

    def poses(name: str) -> torch.Tensor:
        found = re.findall(rf"{name}ToTrackerTransform = (.*)", header.decode())
        return torch.tensor([[float(v) for v in line.split()] for line in found]).double()

    return frames, poses("Probe").reshape(-1, 4, 4), poses("Reference").reshape(-1, 4, 4), folder


def image_to_probe(configuration: Path) -> torch.Tensor:
    """Return PLUS's matrix from pixels to the probe."""
    for transform in ElementTree.parse(configuration).iter("Transform"):
        if (transform.get("From"), transform.get("To")) == ("Image", "Probe"):
            numbers = [float(v) for v in transform.attrib["Matrix"].split()]
            return torch.tensor(numbers, dtype=torch.float64).reshape(4, 4)
    raise AssertionError("the configuration has no ImageToProbe")


CASES = {
    "vtkVolumeReconstructorTestNNLATEvolumeRef.mha": (
        "PlusDeviceSet_VolumeReconstructionOnly_SonixRP_TRUS_D70mm_NN_LATE.xml",
        {
            "compounding": "latest",
            "rectangle_px": (192, 16, 420, 580),
            "fan": Fan((-45.0, 45.0), (380.0, 20.0), 120.0, 360.0),
        },
    ),
    "vtkVolumeReconstructorTestNNMEANvolumeRef.mha": (
        "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN.xml",
        {"compounding": "mean", "fill": "stick"},
    ),
    "vtkVolumeReconstructorTestLNMAXIvolumeRef.mha": (
        "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_LN_MAXI.xml",
        {"interpolation": "linear", "compounding": "maximum"},
    ),
    "SpinePhantomFreehandReconstructed.mha": (
        "PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml",
        {"interpolation": "linear", "compounding": "mean", "fill": "stick"},
    ),
}


@pytest.mark.parametrize("reference", CASES)
def test_reproduces_plus(spine, reference):
    """A sweep that PLUS reconstructed gives the same volume here, in PLUS's own words."""
    frames, probe, tracker, folder = spine
    configuration, options = CASES[reference]
    expected = SimpleITK.ReadImage(str(folder / reference))
    calibration = calibration_from_matrix(image_to_probe(folder / configuration))
    image_to_reference = (
        invert_pose(nearest_pose(tracker)) @ nearest_pose(probe) @ calibration.image_to_probe
    )
    pixel_mm = pixel_to_image(calibration)
    grid = grid_of_sweep(image_to_reference, pixel_mm, 616, 820, 0.5, options.get("rectangle_px"))

    volume = compound_frames(
        frames, image_to_reference, pixel_mm, grid, method="forward", threads=1, **options
    )

    # Older references lack the last slice of an axis.
    assert all(0 <= a - b <= 1 for a, b in zip(grid.size, expected.GetSize(), strict=True))
    assert grid.origin_mm == pytest.approx(expected.GetOrigin(), abs=ORIGIN_DIGITS_MM)
    theirs = SimpleITK.GetArrayFromImage(expected).astype(np.float64)
    ours = volume.voxels[tuple(slice(n) for n in theirs.shape)].astype(np.float64)
    # PLUS does not store which voxels it hit: what is black there and here was, if we saw it.
    seen = volume.coverage[tuple(slice(n) for n in theirs.shape)] > 0
    both = ((theirs > 0) & (ours > 0)) | (seen & (theirs == 0) & (ours == 0))
    error = (ours - theirs)[both]
    correlation = np.corrcoef(ours[both], theirs[both])[0, 1]
    psnr_db = 20 * np.log10(255 / np.sqrt(np.mean(error**2)))
    assert (both & (theirs > 0)).sum() > 0.95 * (theirs > 0).sum()
    assert correlation >= LOWEST_CORRELATION
    assert psnr_db >= LOWEST_PSNR_DB

"""PLUS's own jobs, through the command line, against the volumes that PLUS made of them."""

import numpy as np
import pytest
import SimpleITK as sitk

CONFIG = "PlusDeviceSet_VolumeReconstructionOnly_"
JOBS = {
    "PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml": (
        "SpinePhantomFreehandReconstructed.mha"
    ),
    f"{CONFIG}SonixRP_TRUS_D70mm_NN_LATE.xml": "vtkVolumeReconstructorTestNNLATEvolumeRef.mha",
    f"{CONFIG}SpinePhantom_LN_MAXI.xml": "vtkVolumeReconstructorTestLNMAXIvolumeRef.mha",
    f"{CONFIG}SpinePhantom_NN_MEAN.xml": "vtkVolumeReconstructorTestNNMEANvolumeRef.mha",
}
# PLUS rounds its fixed-point weights and truncates its means, which come out up to five gray
# levels dark. Over the voxels that a pixel hit in both (filled holes are no hits) this leaves:
LEAST_CORRELATION = 0.985
LEAST_PSNR_DB = 30.0
ORIGIN_MM = 1e-3  # PLUS prints six digits


@pytest.mark.parametrize("config", JOBS)
def test_plus_configurations_give_plus_volumes(run, recordings, tmp_path, config):
    """Size and origin are PLUS's own, and so are the gray levels where both have some."""
    folder = recordings / "plus_spine_freehand"

    ran = run(
        "reconstruct", folder / "SpinePhantomFreehand.igs.mha", "--poses", "tracked",
        "--plus-config", folder / config, "--volume-format", "mha", "-o", "out",
    )  # fmt: skip

    assert ran.code == 0, ran.error
    ours = sitk.ReadImage(str(tmp_path / "out" / "volume.mha"))
    theirs = sitk.ReadImage(str(folder / JOBS[config]))
    assert np.allclose(ours.GetOrigin(), theirs.GetOrigin(), atol=ORIGIN_MM)
    assert np.allclose(ours.GetSpacing(), theirs.GetSpacing())
    assert np.allclose(ours.GetDirection(), theirs.GetDirection())
    coverage = sitk.ReadImage(str(tmp_path / "out" / "coverage.mha"))
    a, b = common(sitk.GetArrayFromImage(ours), sitk.GetArrayFromImage(theirs))
    hit, _ = common(sitk.GetArrayFromImage(coverage), b)
    both = (hit > 0) & (a > 0) & (b > 0)
    assert both.sum() > 50_000
    a, b = a[both].astype(float), b[both].astype(float)
    psnr = 10 * np.log10(255**2 / np.mean((a - b) ** 2))
    assert np.corrcoef(a, b)[0, 1] >= LEAST_CORRELATION
    assert psnr >= LEAST_PSNR_DB


def common(a, b):
    """Cut to the common corner: older reference volumes lack the last slice of an axis."""
    assert all(0 <= n - m <= 1 for n, m in zip(a.shape, b.shape, strict=True)), (a.shape, b.shape)
    size = tuple(slice(n) for n in np.minimum(a.shape, b.shape))
    return a[size], b[size]


def test_what_is_not_followed_is_said(run, sweep, tmp_path):
    """A PLUS user reads which words of the configuration changed nothing."""
    (tmp_path / "plus.xml").write_text(
        '<PlusConfiguration><VolumeReconstruction OutputSpacing="0.4 0.4 0.4" FillHoles="ON"'
        ' EnableFanAnglesAutoDetect="TRUE" Colour="blue"><HoleFilling>'
        '<HoleFillingElement Type="GAUSSIAN" Size="5" Stdev="1" MinimumKnownVoxelsRatio="0.5"/>'
        '<HoleFillingElement Type="STICK" StickLengthLimit="9" NumberOfSticksToUse="1"/>'
        "</HoleFilling></VolumeReconstruction></PlusConfiguration>"
    )

    ran = run(
        "reconstruct", sweep, "--poses", "tracked", "--plus-config", "plus.xml", "-o", "out"
    )  # fmt: skip

    assert ran.code == 0, ran.error
    (line,) = [line for line in ran.error.splitlines() if line.startswith("not followed")]
    for word in ("plus.xml", "Colour", "EnableFanAnglesAutoDetect", "GAUSSIAN", "STICK"):
        assert word in line

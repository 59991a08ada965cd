"""From transforms to poses: chains, pixel sizes, what is missing, on real sweeps too."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given

from sonosweep.errors import ScanError
from sonosweep.geometry import invert_pose, nearest_pose
from sonosweep.io.plus_config import PlusConfig, read_plus_config
from sonosweep.io.sequence import Sequence, read_sequence
from sonosweep.io.sequence_fields import FrameTransforms
from sonosweep.io.sequence_scan import read_plus, scan_from_sequence, trajectory_from_sequence
from sonosweep.io.transform_graph import find_chain, transform_graph
from sonosweep.scan import Calibration, pixel_to_image

from ..strategies import poses, sweeps
from .plus_files import shift, some_pixels, write_mha

ROUND_OFF_MM = 1e-9  # float64 on coordinates below 1 m
PRINTED_MM = 2e-3  # six digits of coordinates below 1 m, through two rotations
README_MM = 0.05  # it gives one digit after the point
SCALE = pixel_to_image(Calibration((0.2, 0.1), shear=0.03))


def frame_transforms(matrices, statuses=None) -> FrameTransforms:
    """Return transforms that are all seen, unless their statuses say otherwise."""
    return FrameTransforms(matrices, statuses or ("OK",) * len(matrices))


def tracked_sequence(transforms, static=None, **fields) -> Sequence:
    """Return a sequence of random frames with these transforms."""
    count = len(next(iter(transforms.values())).matrices) if transforms else 3
    return Sequence("a", count, some_pixels(count), transforms, static or {}, **fields)


def config_of(**transforms) -> PlusConfig:
    """Return a configuration from matrices by name, as in ImageToProbe=..."""
    named = {}
    for name, matrix in transforms.items():
        source, target = name.split("To")
        named[source, target] = matrix
    return PlusConfig(path=Path("device.xml"), transforms=named)


@given(probe=sweeps(5), reference=sweeps(5), image=poses())
def test_a_pose_is_the_product_of_the_chain(probe, reference, image):
    """image_to_reference = inv(ReferenceToTracker) @ ProbeToTracker @ ImageToProbe."""
    sequence = tracked_sequence(
        {
            ("Probe", "Tracker"): frame_transforms(probe),
            ("Stylus", "Tracker"): frame_transforms(probe),
            ("Reference", "Tracker"): frame_transforms(reference),
        }
    )

    scan = scan_from_sequence(sequence, config_of(ImageToProbe=image @ SCALE))

    expected = invert_pose(reference) @ probe @ image
    assert float((scan.image_to_reference - expected).abs().max()) < ROUND_OFF_MM
    assert scan.calibration.spacing_mm == pytest.approx((0.2, 0.1))
    assert scan.calibration.shear == pytest.approx(0.03)
    assert float((scan.calibration.image_to_probe - image).abs().max()) < ROUND_OFF_MM
    assert scan.tracked is None


@given(probe=sweeps(5), image=poses(), marker=poses())
def test_links_are_walked_backwards_where_they_must(probe, image, marker):
    """A chain may go through fixed and moving transforms in either direction."""
    sequence = tracked_sequence(
        {("Tracker", "Marker"): frame_transforms(invert_pose(probe))},
        {("Table", "Tracker"): marker},
    )
    config = config_of(
        ProbeToImage=torch.linalg.inv(image @ SCALE), ProbeToMarker=torch.eye(4).double()
    )

    scan = scan_from_sequence(sequence, config, reference="Table")

    expected = invert_pose(marker) @ probe @ image
    assert float((scan.image_to_reference - expected).abs().max()) < ROUND_OFF_MM


@given(probe=sweeps(5), image=poses())
def test_the_third_column_of_a_calibration_means_nothing(probe, image):
    """A pixel has no third coordinate; files write any length there, and either sign."""
    sequence = tracked_sequence({("Probe", "Tracker"): frame_transforms(probe)})
    scaled = image @ SCALE
    other = scaled.clone()
    other[:3, 2] *= -7

    ours = scan_from_sequence(sequence, config_of(ImageToProbe=scaled))
    theirs = scan_from_sequence(sequence, config_of(ImageToProbe=other))

    assert torch.equal(ours.image_to_reference, theirs.image_to_reference)


def test_without_a_reference_the_tracker_is_one():
    """Poses in the tracker are better than none, and the scan says so."""
    identity = torch.eye(4, dtype=torch.float64)
    sequence = tracked_sequence({("Probe", "Tracker"): frame_transforms(identity.repeat(3, 1, 1))})

    scan = scan_from_sequence(sequence, config_of(ImageToProbe=SCALE))

    assert scan.image_to_reference is not None
    assert "poses are in Tracker" in scan.notes["reference"]


def test_a_missing_link_is_named_with_the_known_ones(recordings):
    """The bone sweep without its configuration lacks ImageToProbe."""
    scan = read_plus(recordings / "plus_bone_l14" / "BoneUltrasound_L14.igs.mha")

    assert scan.image_to_reference is None
    assert scan.calibration is None
    note = scan.notes["poses"]
    assert "from Image to Reference or Probe" in note
    assert "ProbeToTracker (valid in 21 frames)" in note
    assert "--plus-config" in note


@pytest.mark.parametrize(
    ("sequence", "config", "note"),
    [
        (tracked_sequence({}), None, "it was not tracked"),
        (
            tracked_sequence({}),
            config_of(ImageToProbe=SCALE, ProbeToReference=torch.eye(4).double()),
            "it was not tracked",
        ),
        (
            tracked_sequence({("A", "B"): frame_transforms(torch.eye(4).double().repeat(3, 1, 1))}),
            config_of(ImageToProbe=SCALE, ProbeToReference=torch.eye(4).double()),
            "is fixed: nothing was tracked",
        ),
    ],
    ids=["nothing", "only fixed", "tracked elsewhere"],
)
def test_a_scan_that_was_not_tracked_says_why(sequence, config, note):
    """Fixed transforms alone are no motion."""
    scan = scan_from_sequence(sequence, config)

    assert scan.image_to_reference is None
    assert note in scan.notes["poses"]


def test_a_tool_that_was_never_seen_makes_no_chain():
    """A link without a valid frame is as good as missing, and is listed with its 0 frames."""
    identity = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    sequence = tracked_sequence(
        {("Probe", "Tracker"): frame_transforms(identity, ("MISSING",) * 3)}
    )

    scan = scan_from_sequence(sequence, config_of(ImageToProbe=SCALE))

    assert scan.image_to_reference is None
    assert "ProbeToTracker (valid in 0 frames)" in scan.notes["poses"]
    # The pixel size is known all the same.
    assert scan.calibration is not None
    assert scan.calibration.spacing_mm == pytest.approx((0.2, 0.1))


def test_frames_that_the_tracker_missed_have_no_pose():
    """One tool out of view is enough, and other frames are not affected."""
    identity = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    sequence = tracked_sequence(
        {
            ("Probe", "Tracker"): frame_transforms(identity, ("OK", "OUT_OF_VIEW", "OK")),
            ("Reference", "Tracker"): frame_transforms(identity, ("OK", "OK", "INVALID")),
        }
    )

    scan = scan_from_sequence(sequence, config_of(ImageToProbe=SCALE))

    assert scan.tracked is not None
    assert scan.image_to_reference is not None
    assert scan.tracked.tolist() == [True, False, False]
    assert torch.isnan(scan.image_to_reference[1:]).all()
    assert torch.isfinite(scan.image_to_reference[0]).all()


@pytest.mark.parametrize(
    "spoil",
    [lambda m: m * 2, lambda m: m * float("nan"), lambda m: -m, lambda m: m + 0.01],
    ids=["scaled", "nan", "mirrored", "bent"],
)
def test_a_transform_that_cannot_be_is_named(spoil):
    """The sentence tells frame and transform."""
    matrices = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    matrices[1, :3, :3] = spoil(matrices[1, :3, :3])
    sequence = tracked_sequence({("Probe", "Tracker"): frame_transforms(matrices)})

    with pytest.raises(ScanError, match="ProbeToTracker of frame 1 in 'a' is no"):
        scan_from_sequence(sequence, config_of(ImageToProbe=SCALE))


def test_rounded_rotations_are_made_rotations_again(recordings):
    """Six printed digits are no rotation to the last bit; poses of scans are."""
    folder = recordings / "plus_spine_freehand"
    config = read_plus_config(folder / "PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml")
    sequence = read_sequence(folder / "SpinePhantomFreehand.igs.mha")

    scan = scan_from_sequence(sequence, config)

    poses_ = scan.image_to_reference
    assert poses_ is not None
    assert float((nearest_pose(poses_) - poses_).abs().max()) < ROUND_OFF_MM
    literal = (
        torch.linalg.inv(sequence.transforms[("Reference", "Tracker")].matrices)
        @ sequence.transforms[("Probe", "Tracker")].matrices
        @ config.transforms[("Image", "Probe")]
    )
    corners = torch.tensor([[0, 0, 0, 1], [819, 615, 0, 1]], dtype=torch.float64)
    ours = poses_ @ pixel_to_image(scan.calibration) @ corners.T
    assert float((ours - literal @ corners.T).abs().max()) < PRINTED_MM


def test_the_real_sweeps_move_as_their_readme_says(recordings):
    """The middle of the image travels 33.6 mm over the spine and 10.5 mm over the bone."""
    for folder, name, config, expected in (
        (
            "plus_spine_freehand",
            "SpinePhantomFreehand",
            "PlusDeviceSet_SpinePhantomFreehandReconstructionOnly",
            33.6,
        ),
        ("plus_bone_l14", "BoneUltrasound_L14", "BoneUltrasound_L14_config", 10.5),
    ):
        scan = read_plus(
            recordings / folder / f"{name}.igs.mha", recordings / folder / f"{config}.xml"
        )
        assert scan.image_to_reference is not None
        center = pixel_to_image(scan.calibration) @ torch.tensor([410.0, 308, 0, 1]).double()
        path = (scan.image_to_reference @ center)[:, :3].diff(dim=0).norm(dim=1).sum()

        assert float(path) == pytest.approx(expected, abs=README_MM)
        assert scan.tracked is None
        assert scan.notes == {}


def test_a_tracker_recording_is_a_trajectory_of_the_probe(recordings):
    """Without images there is no Image, but the probe's motion is known 5000 times."""
    sequence = read_sequence(
        recordings / "plus_watertank_temporal" / "WaterTankBottomTranslationTrackerBuffer.igs.mha"
    )

    trajectory = trajectory_from_sequence(sequence, image="Probe")

    valid = sequence.transforms[("Probe", "Tracker")].valid
    valid = valid & sequence.transforms[("Reference", "Tracker")].valid
    assert len(trajectory.image_to_reference) == int(valid.sum())
    assert trajectory.timestamps_s is not None
    with pytest.raises(ScanError, match="no transform leads from Image"):
        trajectory_from_sequence(sequence)
    with pytest.raises(ScanError, match="transforms but no images"):
        scan_from_sequence(sequence)


def test_frames_without_image_are_left_out():
    """A blank frame is no ultrasound: its pose and time go with it."""
    identity = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    sequence = tracked_sequence(
        {("Probe", "Tracker"): frame_transforms(identity)},
        timestamps_s=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64),
        image_valid=torch.tensor([True, False, True]),
    )

    scan = scan_from_sequence(sequence, config_of(ImageToProbe=SCALE))

    np.testing.assert_array_equal(scan.frames[:], some_pixels()[[0, 2]])
    assert scan.timestamps_s is not None
    assert scan.timestamps_s.tolist() == [1, 3]
    assert len(scan.image_to_reference) == 2
    assert "1 frames hold no image" in scan.notes["frames"]


@pytest.mark.parametrize("times", [[1.0, 1.0, 2.0], [3.0, 2.0, 1.0], [1.0, float("nan"), 2.0]])
def test_times_that_do_not_increase_are_not_used(times):
    """A clock that stood still does not spoil a sweep, and the notes tell of it."""
    sequence = tracked_sequence({}, timestamps_s=torch.tensor(times, dtype=torch.float64))

    scan = scan_from_sequence(sequence)

    assert scan.timestamps_s is None
    assert "do not increase" in scan.notes["timestamps"]


def test_the_pixel_size_comes_from_the_best_source(tmp_path):
    """What the user says wins over the calibration, and that over the file's spacing."""
    path = write_mha(tmp_path / "a.mha", some_pixels(), {"ElementSpacing": "0.4 0.3 1"})
    config = config_of(ImageToProbe=SCALE)

    def spacing(*arguments):
        return read_plus(path, *arguments).calibration.spacing_mm

    assert spacing() == (0.4, 0.3)
    assert spacing(config) == pytest.approx((0.2, 0.1))
    assert spacing(config, (0.7, 0.6)) == (0.7, 0.6)
    assert spacing(None, (0.7, 0.6)) == (0.7, 0.6)
    plain = write_mha(tmp_path / "b.mha", some_pixels())
    assert "how large a pixel is" in read_plus(plain).notes["calibration"]


def test_rf_is_no_scan_and_unknown_orientation_is_told(tmp_path):
    """RF lines must become B-mode first; '??' is taken as MF and noted."""
    rf = write_mha(tmp_path / "a.mha", some_pixels(), {"UltrasoundImageType": "RF_REAL"})
    unknown = write_mha(tmp_path / "b.mha", some_pixels(), {"UltrasoundImageOrientation": "??"})

    with pytest.raises(ScanError, match="RF_REAL lines, not B-mode"):
        read_plus(rf)
    assert "taken as MF" in read_plus(unknown).notes["orientation"]
    assert "orientation" not in read_plus(unknown, orientation="UF").notes


def test_the_graph_lists_every_transform_and_where_it_is_from():
    """What info prints: per-frame transforms with their valid frames, then fixed ones."""
    identity = torch.eye(4, dtype=torch.float64)
    sequence = tracked_sequence(
        {("Probe", "Tracker"): frame_transforms(identity.repeat(3, 1, 1), ("OK", "MISSING", "OK"))},
        {("Image", "Probe"): identity},
    )

    links = transform_graph(sequence, config_of(ImageToProbe=SCALE))

    assert [(link.name, link.origin, link.valid) for link in links] == [
        ("ProbeToTracker", "frames", 2),
        ("ImageToProbe", "configuration", 3),
        ("ImageToProbe", "file", 3),
    ]
    chain = find_chain(links, "Tracker", "Image")
    assert chain is not None
    assert [(link.name, link.origin, link.inverted) for link in chain] == [
        ("ProbeToTracker", "frames", True),
        ("ImageToProbe", "configuration", True),
    ]
    assert find_chain(links, "Image", "Moon") is None
    assert find_chain(links, "Image", "Image") == []


def test_a_foreign_image_to_reference_is_taken_as_it_is(tmp_path):
    """Slicer and others write ImageToReference with the pixel size in its columns."""
    fields = {
        f"Seq_Frame{k:04d}_ImageToReferenceTransform": f"0.2 0 0 {k} 0 0 -5 0 0 0.1 0 3 0 0 0 1"
        for k in range(3)
    }

    scan = read_plus(write_mha(tmp_path / "a.mha", some_pixels(), fields))

    assert scan.calibration is not None
    assert scan.calibration.spacing_mm == pytest.approx((0.2, 0.1))
    assert scan.calibration.image_to_probe is None
    expected = [[1, 0, 0, 2], [0, 0, -1, 0], [0, 1, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(scan.image_to_reference[2], expected, atol=ROUND_OFF_MM)


def test_an_image_whose_size_changes_is_refused(tmp_path):
    """Zooming during a sweep would need one pixel size per frame."""
    fields = {
        "Seq_Frame0000_ImageToReferenceTransform": shift(1),
        "Seq_Frame0001_ImageToReferenceTransform": "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1",
    }

    with pytest.raises(ScanError, match="ImageToReference of frame 1"):
        read_plus(write_mha(tmp_path / "a.mha", some_pixels(), fields))

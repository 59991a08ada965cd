"""Simulated sweeps as scans: exact truth, the same pixels whatever is read first."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sonosweep.errors import ScanError
from sonosweep.imaging import SectorGrid, centered_grid
from sonosweep.io.hdf5 import read_scan, write_scan
from sonosweep.reconstruct import image_companions
from sonosweep.simulate import (
    Beam,
    Body,
    BodyMotionSettings,
    Scanner,
    SweepSettings,
    draw_sweep,
    simulate_sweep,
)
from sonosweep.simulate.tracker import TrackerSettings
from tests.simulate.sweep_bodies import SMALL_GRID, arm, steady

LIVING = BodyMotionSettings(
    strain=0.04, strain_variation=0.01, pulse=0.1, heart_rate_hz=1.3, breathing_mm=0.2
)
SETTINGS = SweepSettings(
    900001,
    3,
    motion=steady(hand_unsteadiness=0.5, tremor_mm=0.02),
    body_motion=LIVING,
    scanner=Scanner(persistence_frames=3, speckle_reduction=0.5),
    grid=SMALL_GRID,
)
CONVEX = SectorGrid(
    lines=48,
    samples=80,
    line_spacing_rad=0.02,
    sample_spacing_mm=0.25,
    first_depth_mm=0.5,
    radius_mm=40.0,
)
SECTOR = replace(
    SETTINGS,
    beam=Beam(
        center_frequency_hz=3e6,
        axial_fwhm_mm=0.5,
        lateral_fwhm_mm=1.0,
        elevation_waist_mm=1.2,
        curvature_radius_mm=40.0,
    ),
    sector=CONVEX,
    grid=centered_grid(120, 96, (0.5, 0.3), -5.0),
)


@pytest.fixture(scope="module")
def body() -> Body:
    """Return an arm with an artery and a vein."""
    return arm()


def test_frames_do_not_depend_on_what_was_read_before(body: Body) -> None:
    """In order, in reverse, twice, or one alone: the same pixels, with persistence and pulse."""
    settings = replace(SETTINGS, modalities=("power_doppler", "photoacoustic"))
    straight, jumping = simulate_sweep(settings, body), simulate_sweep(settings, body)
    stack = straight.frames[:]
    for frame in (11, 0, 5, 5, 1):
        assert np.array_equal(jumping.frames[frame], stack[frame])
    doppler, light = (straight.companions[name].frames for name in settings.modalities)
    assert np.array_equal(jumping.companions["power_doppler"].frames[4], doppler[4])
    assert np.array_equal(jumping.companions["photoacoustic"].frames[4], light[4])
    assert np.array_equal(simulate_sweep(settings, body).frames[7], stack[7])


def test_another_scan_or_subject_gives_other_frames(body: Body) -> None:
    """Scans differ in motion and noise; subjects also in their scatterers."""
    others = (SETTINGS, replace(SETTINGS, scan=4), replace(SETTINGS, subject=900002))
    frames = [simulate_sweep(settings, body).frames[2] for settings in others]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert (frames[first] != frames[second]).mean() > 0.5


def test_another_process_gets_the_same_frames(body: Body) -> None:
    """Frames survive pickling, as worker processes need."""
    frames = simulate_sweep(SETTINGS, body).frames
    expected = frames[3]
    assert np.array_equal(pickle.loads(pickle.dumps(frames))[3], expected)


def test_a_sweep_back_shows_the_same_frames_in_reverse(body: Body) -> None:
    """Without noise nothing tells forward from backward, whatever persistence does."""
    still = replace(
        SETTINGS,
        body_motion=BodyMotionSettings(),
        scanner=replace(SETTINGS.scanner, noise_db=-300.0),
    )
    back = replace(still, motion=replace(still.motion, backward=True))
    forward, backward = simulate_sweep(still, body), simulate_sweep(back, body)
    assert forward.image_to_reference is not None
    assert backward.image_to_reference is not None
    assert torch.allclose(
        forward.image_to_reference, backward.image_to_reference.flip(0), atol=1e-9
    )
    difference = forward.frames[:].astype(int) - backward.frames[::-1]
    assert np.abs(difference).max() <= 1  # rounding of sums in another order


def test_persistence_mixes_neighbors_evenly(body: Body) -> None:
    """A frame is the mean of itself and as many before it as after it."""
    scanner = Scanner(persistence_frames=3)
    chosen = replace(SETTINGS, scanner=scanner, modalities=("amplitude",))
    mixed = simulate_sweep(chosen, body).companions["amplitude"].frames
    single = replace(chosen, scanner=replace(scanner, persistence_frames=1))
    alone = simulate_sweep(single, body).companions["amplitude"].frames
    assert np.allclose(mixed[5], (alone[4] + alone[5] + alone[6]) / 3, rtol=1e-5)
    assert np.allclose(mixed[0], (alone[0] + alone[1]) / 2, rtol=1e-5)


def test_poses_place_the_first_pixel(body: Body) -> None:
    """image_to_reference takes (0, 0) to the body, the grid's origin beside the array."""
    scan = simulate_sweep(replace(SETTINGS, motion=steady()), body)
    assert scan.image_to_reference is not None
    assert scan.timestamps_s is not None
    assert scan.calibration is not None
    assert scan.calibration.image_to_probe is not None
    poses = scan.image_to_reference
    x, y, z = poses[:, :3, 3].T
    assert torch.allclose(x, torch.full_like(x, SMALL_GRID.origin_mm[0]), atol=1e-6)
    # The face floats on 0.5 mm of gel and the first row is 0.5 mm below it.
    assert torch.allclose(y, torch.zeros_like(y), atol=1e-6)
    assert float(z[-1] - z[0]) == pytest.approx(6.0, abs=1e-6)
    probe = poses @ torch.linalg.inv(scan.calibration.image_to_probe)
    assert torch.allclose(probe[:, 0, 3], torch.zeros_like(x), atol=1e-6)
    assert torch.allclose(scan.timestamps_s.diff(), torch.full((11,), 0.05, dtype=torch.float64))


def test_a_tracker_reports_near_the_truth(body: Body) -> None:
    """Its noise is on the poses and not on the frames; lost frames are marked."""
    tracker = TrackerSettings(position_noise_mm=0.1, rotation_noise_deg=0.05)
    exact = simulate_sweep(SETTINGS, body)
    tracked = simulate_sweep(replace(SETTINGS, tracker=tracker), body)
    assert exact.image_to_reference is not None
    assert tracked.image_to_reference is not None
    assert tracked.tracked is not None
    away = (tracked.image_to_reference - exact.image_to_reference)[tracked.tracked, :3, 3].norm(
        dim=1
    )
    assert 0.02 < float(away.mean()) < 0.5
    assert np.array_equal(exact.frames[2], tracked.frames[2])


def test_the_scan_says_that_it_is_simulated(body: Body) -> None:
    """Notes hold all settings; what power Doppler's gray levels mean is said too."""
    settings = replace(SETTINGS, modalities=("power_doppler", "photoacoustic", "iq"))
    notes = simulate_sweep(settings, body).notes
    told = json.loads(notes["simulation"])
    assert told["simulated"] is True
    assert (told["subject"], told["scan"]) == (900001, 3)
    assert told["scanner"]["persistence_frames"] == 3
    assert told["body_motion"]["heart_rate_hz"] == 1.3
    assert "dB above the noise" in notes["power_doppler"]


def test_a_simulated_scan_goes_through_a_file(body: Body, tmp_path: Path) -> None:
    """All modalities come back bit by bit; all but IQ can be made into volumes."""
    settings = replace(
        SETTINGS,
        motion=steady(frames=4, length_mm=1.0),
        modalities=("amplitude", "iq", "power_doppler", "photoacoustic"),
    )
    scan = simulate_sweep(settings, body)
    write_scan(scan, tmp_path / "sweep.h5")
    read = read_scan(tmp_path / "sweep.h5")
    assert np.array_equal(read.frames[:], scan.frames[:])
    for name, companion in scan.companions.items():
        assert np.array_equal(read.companions[name].frames[:], companion.frames[:]), name
    assert set(image_companions(read)) == {"amplitude", "power_doppler", "photoacoustic"}


def test_sector_frames_are_black_outside_the_sector(body: Body) -> None:
    """A convex probe's image is a fan; its region says where."""
    scan = simulate_sweep(SECTOR, body)
    frame = scan.frames[4]
    assert scan.region is not None
    assert scan.region.mask is not None
    assert frame.shape == (96, 120)
    assert not frame[~scan.region.mask].any()
    assert frame[scan.region.mask].mean() > 20
    assert np.array_equal(scan.frames[4], frame)


def test_what_cannot_be_simulated_is_refused(body: Body) -> None:
    """One sentence for each."""
    with pytest.raises(ScanError, match=r"unknown modality 'elastography'"):
        replace(SETTINGS, modalities=("elastography",))
    with pytest.raises(ScanError, match=r"'iq' frames are simulated for linear arrays only"):
        replace(SECTOR, modalities=("iq",))
    with pytest.raises(ScanError, match=r"number of a scan must be 0 or more, got -1"):
        replace(SETTINGS, scan=-1)
    with pytest.raises(ScanError, match=r"leaves phantom 'block'"):
        simulate_sweep(replace(SETTINGS, motion=steady(length_mm=40.0, frames=60)), body)
    with pytest.raises(ScanError, match=r"compresses tissue by 0.25 at most"):
        BodyMotionSettings(strain=0.4)
    with pytest.raises(ScanError, match=r"a probe is 'linear' or 'convex', got 'round'"):
        draw_sweep(900001, 0, probe="round")
    with pytest.raises(ScanError, match=r"a scanner is 'research', .*, got 'toy'"):
        draw_sweep(900001, 0, scanner="toy")


def test_drawn_sweeps_differ_within_their_ranges() -> None:
    """Each scan has its own probe and scanner; the same numbers give the same ones."""
    sweeps = [draw_sweep(900001 + k // 10, k % 10) for k in range(60)]
    assert draw_sweep(900003, 4) == draw_sweep(900003, 4)
    waists = [sweep.beam.elevation_waist_mm for sweep in sweeps]
    assert len(set(waists)) == 60
    assert 0.5 <= min(waists) < 0.55
    assert 0.7 < max(waists) <= 0.75
    assert {sweep.scanner.persistence_frames for sweep in sweeps} == {1, 3, 5}
    assert min(sweep.scanner.speckle_reduction for sweep in sweeps) == 0
    assert all(0 <= sweep.body_motion.strain <= 0.08 for sweep in sweeps)


@pytest.mark.parametrize(
    ("probe", "pixels", "shape"),
    [
        ("linear", None, (256, 256)),
        ("linear", (128, 128), (128, 128)),
        ("convex", None, (480, 640)),
    ],
)
def test_fields_of_view_do_not_depend_on_the_pixels(probe, pixels, shape) -> None:
    """256 pixels of 0.1484 mm, or half as many twice as large; 0.22 mm of a convex probe."""
    grid = draw_sweep(900001, 0, probe=probe, pixels=pixels).grid
    assert (grid.rows, grid.columns) == shape
    width = grid.columns * grid.spacing_mm[0]
    assert width == pytest.approx(256 * 0.1484 if probe == "linear" else 640 * 0.22)

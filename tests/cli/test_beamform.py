"""``beamform``: a file of channel data becomes a scan that the other verbs take."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sonosweep.io import open_scan
from sonosweep.io.channel_hdf5 import write_channels
from tests.imaging import channel_sweeps as made

SMALL = ("--columns", "60", "--rows", "80", "--pixel-mm", "0.1")


@pytest.fixture
def channels(tmp_path):
    """A file of three tracked frames with all modalities."""
    write_channels(made.sweep(), tmp_path / "raw.h5")


def test_all_modalities_arrive(run, channels, tmp_path):
    """The scan holds B-mode and its companions; one line says so, progress goes elsewhere."""
    ran = run("beamform", "raw.h5", "-o", "scan.h5", *SMALL, "--clutter-rank", "1", "--amplitude")

    assert ran.code == 0, ran.error
    assert ran.out == (
        "points: 3 frames of 60 x 80 pixels of 0.1 mm, B-mode, power Doppler, photoacoustic ->"
        " scan.h5\n"
    )
    assert "beamforming: 12 of 12" in ran.error
    scan = open_scan(tmp_path / "scan.h5")
    assert scan.frames.shape == (3, 80, 60)
    assert set(scan.companions) == {"amplitude", "power_doppler", "photoacoustic"}
    assert scan.calibration.spacing_mm == (0.1, 0.1)
    assert scan.subject is None
    row, column = np.unravel_index(np.argmax(scan.frames[0]), (80, 60))
    assert (0.1 * (column - 29.5), 0.5 + 0.1 * row) == pytest.approx(made.TISSUE_MM, abs=0.101)


def test_the_scan_is_reconstructed(run, channels, tmp_path):
    """Volumes of all modalities on one grid, where the tracker saw the wire."""
    assert run("beamform", "raw.h5", "-o", "scan.h5", *SMALL).code == 0

    ran = run("reconstruct", "scan.h5", "--poses", "tracked", "--voxel-mm", "0.2", "-o", "out")

    assert ran.code == 0, ran.error
    written = {file.name for file in (tmp_path / "out").glob("volume*.nrrd")}
    assert written == {"volume.nrrd", "volume_power_doppler.nrrd", "volume_photoacoustic.nrrd"}


def test_facts_for_machines(run, channels):
    """What was made, and how, as JSON."""
    ran = run("beamform", "raw.h5", "-o", "scan.h5", *SMALL, "--sound-speed", "1500", "--json")

    facts = json.loads(ran.out)
    assert facts["modalities"] == ["b_mode", "power_doppler", "photoacoustic"]
    assert (facts["columns"], facts["rows"], facts["frames"]) == (60, 80, 3)
    assert "f-number 1.5, 1500 m/s" in facts["notes"]["b_mode"]
    assert "f-number 1, 1500 m/s" in facts["notes"]["photoacoustic"]


def test_options_reach_the_beamformer(run, channels, tmp_path):
    """All elements, another gray scale, a band, the subject's code kept."""
    ran = run(
        *("beamform", "raw.h5", "-o", "scan.h5", *SMALL, "--f-number", "all"),
        *("--dynamic-range-db", "40", "--photoacoustic-band-mhz", "2", "8", "--no-anonymize"),
    )

    assert ran.code == 0, ran.error
    scan = open_scan(tmp_path / "scan.h5")
    assert "all elements" in scan.notes["b_mode"]
    assert "40 dB less" in scan.notes["b_mode"]
    assert scan.subject == "900001"


def test_formats_without_companions_say_what_is_lost(run, channels, tmp_path):
    """A sequence file holds B-mode and poses; the line names what is left out."""
    ran = run("beamform", "raw.h5", "-o", "scan.igs.mha", *SMALL)

    assert ran.code == 0, ran.error
    assert "photoacoustic, power_doppler left out: only .h5 holds companions" in ran.out
    poses = open_scan(tmp_path / "scan.igs.mha").image_to_reference
    origin = torch.tensor([-2.95, 0.5, 0.3], dtype=torch.float64)
    assert torch.allclose(poses[1, :3, 3], origin, atol=1e-4)


def test_nothing_is_overwritten(run, channels, tmp_path):
    """Without --force an existing file stays as it is."""
    (tmp_path / "scan.h5").write_text("mine")

    refused = run("beamform", "raw.h5", "-o", "scan.h5", *SMALL)
    forced = run("beamform", "raw.h5", "-o", "scan.h5", *SMALL, "--force")

    assert refused.code == 1
    assert "'scan.h5' exists" in refused.sentence
    assert forced.code == 0
    assert len(open_scan(tmp_path / "scan.h5").frames) == 3


def with_nan():
    """Return the sweep whose last frame holds a sample that is not a number."""
    sweep = made.sweep()
    samples = np.asarray(sweep.photoacoustic.samples).copy()
    samples[2, 0, 3, 7] = np.nan
    return replace(sweep, photoacoustic=replace(sweep.photoacoustic, samples=samples))


def echoes_only():
    """Return the sweep with B-mode alone."""
    return replace(made.sweep(), power_doppler=None, photoacoustic=None)


@pytest.mark.parametrize(
    ("sweep", "words", "sentence"),
    [
        (made.sweep, ("--f-number", "0"), "f-number must be above 0, got 0"),
        (made.sweep, ("--sound-speed", "-1"), "sound speed must be from 100 to 10000 m/s, got -1"),
        (made.sweep, ("--columns", "0"), "columns of an image must be above 0, got 0"),
        (made.sweep, ("--clutter-rank", "8"), "from 0 to 7 for 8 pulses, got 8"),
        (made.sweep, ("--clutter-rank", "1.5"), "a whole number is needed, got 1.5"),
        (made.sweep, ("--dynamic-range-db", "0"), "dynamic range"),
        (made.sweep, ("--photoacoustic-band-mhz", "2", "30"), "must lie between 0 and 1e+07 Hz"),
        (made.sweep, ("--rows", "9", "--depth-mm", "9", "--columns", "9"), "only one of --rows"),
        (echoes_only, ("--clutter-rank", "2"), "no power Doppler data for --clutter-rank"),
        (echoes_only, ("--photoacoustic-band-mhz", "1", "8"), "no photoacoustic data for"),
        (with_nan, (), "frame 2: samples of 'points' are not all numbers"),
    ],
)
def test_one_sentence_and_no_file(run, tmp_path, sweep, words, sentence):
    """What makes no sense is refused, and no half-written scan is left behind."""
    write_channels(sweep(), tmp_path / "raw.h5")
    size = () if {"--columns", "--rows"} & set(words) else SMALL

    ran = run("beamform", "raw.h5", "-o", "scan.h5", *size, *words)

    assert ran.code == 1
    assert sentence in ran.sentence
    assert "Traceback" not in ran.error
    assert [file.name for file in tmp_path.iterdir()] == ["raw.h5"]


def test_an_unknown_suffix_is_refused_before_the_work(run, channels):
    """Nothing is beamformed for a file that cannot be written."""
    ran = run("beamform", "raw.h5", "-o", "scan.docx", *SMALL)

    assert ran.code == 1
    assert "cannot write a scan as 'scan.docx'" in ran.sentence
    assert "beamforming" not in ran.error


def test_a_scan_is_no_channel_data(run, channels):
    """Frames that are beamformed already are refused."""
    assert run("beamform", "raw.h5", "-o", "scan.h5", *SMALL).code == 0

    ran = run("beamform", "scan.h5", "-o", "again.h5")

    assert ran.code == 1
    assert "is beamformed already" in ran.sentence


def test_the_ring_of_an_msot_machine(run, recordings, tmp_path):
    """A photoacoustic recording of a ring array needs no options."""
    ran = run("beamform", recordings / "patato_msot_scan9", "-o", "mouse.h5", "--columns", "64")

    assert ran.code == 0, ran.error
    scan = open_scan(tmp_path / "mouse.h5")
    assert scan.frames.shape == (1, 64, 64)
    assert "one-way" in scan.notes["photoacoustic"]
    assert "all elements" in scan.notes["photoacoustic"]

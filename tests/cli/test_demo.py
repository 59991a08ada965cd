"""The demo: one real sweep with its tracker and without, and how far apart the two are."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sonosweep.io import read_trajectory, read_volume
from sonosweep.metrics import compare_volumes


def covered_volume(folder):
    """The B-mode volume in a folder, with its coverage."""
    volume = read_volume(folder / "volume.nrrd")
    return replace(volume, coverage=read_volume(folder / "coverage.nrrd").voxels)


def test_the_demo_compares_both_ways(run, tmp_path):
    """Both reconstructions lie on one grid from one first frame; the report says how alike."""
    ran = run("demo", "-o", "out", "--json")

    assert ran.code == 0, ran.error
    summary = json.loads(ran.out)
    folder = tmp_path / "out"
    tracked, sensorless = (covered_volume(folder / name) for name in ("tracked", "sensorless"))
    assert tracked.grid == sensorless.grid
    assert {run["name"]: run["method"] for run in summary["runs"]}["tracked"] == "tracked"
    found = summary["runs"][1]["metrics"]
    alike = compare_volumes(sensorless, tracked)
    assert 0 < alike.overlap < 1
    for name, value in alike.as_dict().items():
        assert found[name] == pytest.approx(value), name
    first = [
        read_trajectory(folder / name / "trajectory.csv").image_to_reference[0].numpy()
        for name in ("tracked", "sensorless")
    ]
    assert np.allclose(*first, atol=1e-6)
    assert set(summary["files"]) <= {
        path.relative_to(folder).as_posix() for path in folder.rglob("*")
    }
    assert any("poor" in line or "usable" in line or "good" in line for line in summary["verdict"])
    path_mm = found["path_length_mm"]
    page = (folder / "report.html").read_text()
    assert f"After {path_mm:.1f} mm of tracked path" in page
    assert f"Tracked path</dt><dd>{path_mm:.1f} mm<" in page  # one length, not two
    for words in (
        "Difference between tracked and sensorless",
        "Drift: distance from the tracked position",
        "Maximum along the elevational axis",
        "The elevational scale is a guess",
        "The tracker told that the probe swept backward",
        "ImFusion GmbH, CC BY 4.0",
    ):
        assert words in page, words

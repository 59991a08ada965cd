"""What 3D Slicer opens beside volumes: the curve and the script."""

import ast
import json
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import pytest
import torch

from sonosweep.io.slicer_markups import MOST_POINTS, write_slicer_curve
from sonosweep.io.slicer_script import write_slicer_script
from sonosweep.scan import Trajectory


def straight_sweep(frames: int) -> Trajectory:
    """Frames 0.5 mm apart along z, the first at (1, 2, 3)."""
    poses = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    poses[:, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    poses[:, 2, 3] += 0.5 * torch.arange(frames)
    return Trajectory(poses)


def positions(path: Path) -> list[list[float]]:
    """The control points of the file's curve."""
    markup = json.loads(path.read_text())["markups"][0]
    assert markup["type"] == "Curve"
    assert markup["coordinateSystem"] == "LPS"
    assert all(point["positionStatus"] == "defined" for point in markup["controlPoints"])
    return [point["position"] for point in markup["controlPoints"]]


@pytest.mark.parametrize(("world", "sign"), [("ras", -1), ("lps", 1)])
def test_the_curve_follows_a_point_of_the_image(tmp_path: Path, world, sign: int):
    """10 mm to the right and 20 mm deep of frames at (1, 2, z): (11, 22, z) of the reference."""
    path = tmp_path / "trajectory.mrk.json"

    write_slicer_curve(straight_sweep(3), path, world, point_mm=(10.0, 20.0))

    assert positions(path) == [[sign * 11, sign * 22, z] for z in (3.0, 3.5, 4.0)]


def test_long_curves_are_thinned_and_keep_their_ends(tmp_path: Path):
    """Ten thousand frames become a thousand points from the first to the last."""
    write_slicer_curve(straight_sweep(10_000), tmp_path / "t.mrk.json", "lps")

    points = positions(tmp_path / "t.mrk.json")
    assert len(points) == MOST_POINTS
    assert points[0][2] == 3
    assert points[-1][2] == pytest.approx(3 + 0.5 * 9999)


def test_one_frame_is_one_point(tmp_path: Path):
    """The shortest trajectory there is."""
    write_slicer_curve(straight_sweep(1), tmp_path / "t.mrk.json")

    assert positions(tmp_path / "t.mrk.json") == [[-1, -2, 3]]


def run_script(path: Path, monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Run a script as Slicer would, with a Slicer that writes down what it is asked."""
    slicer = MagicMock()
    monkeypatch.setitem(__import__("sys").modules, "slicer", slicer)
    script = ModuleType("open_in_slicer")
    script.__file__ = str(path)
    exec(compile(path.read_text(), str(path), "exec"), script.__dict__)  # our own text
    return slicer


def test_the_script_loads_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """B-mode first, companions after it, no coverage, the curve and the sweep."""
    for name in (
        "volume_power_doppler.nrrd",
        "volume.nrrd",
        "volume_coverage.nrrd",
        "trajectory.mrk.json",
        "sweep.igs.mha",
        "report.html",
    ):
        (tmp_path / name).write_bytes(b"")

    script = write_slicer_script(tmp_path)
    slicer = run_script(script, monkeypatch)

    assert script.name == "open_in_slicer.py"
    loaded = [call.args[0] for call in slicer.util.loadVolume.call_args_list]
    assert loaded == [str(tmp_path / "volume.nrrd"), str(tmp_path / "volume_power_doppler.nrrd")]
    slicer.util.loadMarkups.assert_called_once_with(str(tmp_path / "trajectory.mrk.json"))
    assert slicer.util.loadNodeFromFile.call_args.args[0] == str(tmp_path / "sweep.igs.mha")


def test_a_missing_extension_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    """Without SlicerIGSIO the sweep is left out and the user is told."""
    (tmp_path / "sweep.igs.mha").write_bytes(b"")
    slicer = MagicMock()
    slicer.util.loadNodeFromFile.side_effect = RuntimeError
    monkeypatch.setitem(__import__("sys").modules, "slicer", slicer)

    exec(write_slicer_script(tmp_path).read_text(), {"__file__": str(tmp_path / "s.py")})

    assert "SlicerIGSIO" in capsys.readouterr().out


def test_the_script_names_no_folder_of_ours(tmp_path: Path):
    """The results can be moved, and names with quotes do not break the script."""
    name = "volume 'it''s'.nrrd"

    script = write_slicer_script(tmp_path, volumes=(name,))

    text = script.read_text()
    ast.parse(text)
    assert str(tmp_path) not in text

"""Every example runs."""

import runpy
from pathlib import Path

import pytest
import torch

from sonosweep.estimators.weights import load_weights
from sonosweep.evaluate.methods import Network
from sonosweep.simulate import uniform_phantom, vessel_phantom
from tests.estimators.tiny_weights import tiny_weights

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name):
    """Return the example's main function."""
    return example_globals(name)["main"]


def example_globals(name):
    """Return all that the example defines."""
    return runpy.run_path(str(EXAMPLES / name))


def test_reconstruct_sweep(tmp_path, capsys):
    """A volume, a trajectory, and how far it is off."""
    example("reconstruct_sweep.py")(frames=6, folder=tmp_path)

    assert {path.name for path in tmp_path.iterdir()} == {"volume.nrrd", "trajectory.csv"}
    assert "final drift" in capsys.readouterr().out


def test_images_and_poses(tmp_path, capsys):
    """A sequence file that reads back."""
    example("images_and_poses.py")(frames=5, folder=tmp_path)

    assert capsys.readouterr().out == "sweep: 5 frames with poses\n"


def test_overview_picture(tmp_path):
    """The README's picture can be made again."""
    example("overview_picture.py")(tmp_path / "overview.png", voxel_mm=3.0)

    assert (tmp_path / "overview.png").read_bytes().startswith(b"\x89PNG")


def test_pack_demo_sweep(tmp_path, recordings):
    """The packaged sweep comes out of the recording byte by byte."""
    packed = Path(__file__).parents[1] / "src" / "sonosweep" / "data"

    example("pack_demo_sweep.py")(recordings / "imfusion_liver_sweep" / "liver_sweep.h5", tmp_path)

    name = "liver_sweep_poses.csv"
    assert (tmp_path / name).read_bytes() == (packed / name).read_bytes()


def test_attention_maps(tmp_path):
    """The figure of the estimators page, of any weights and any body."""
    spacing = 38.0 / 64
    weights = tiny_weights(tmp_path, "moglo", spacing_mm=(spacing, spacing))

    example("attention_maps.py")(
        tmp_path / "maps.png",
        str(weights),
        frames=20,
        body=uniform_phantom(size_mm=(60.0, 60.0, 60.0)),
    )

    assert (tmp_path / "maps.png").read_bytes().startswith(b"\x89PNG")


def test_simulated_vessels(tmp_path):
    """The pictures of the pages on simulation and imaging can be made again."""
    body = vessel_phantom(size_mm=(80.0, 48.0, 60.0))

    example("simulated_vessels.py")(tmp_path, body, length_mm=4.0, frames=20)

    assert {path.name for path in tmp_path.iterdir()} == {
        "modalities.png",
        "vessels_photoacoustic.png",
        "vessels_power_doppler.png",
    }


def test_ship_weights(tmp_path):
    """Half the size, nearly the same motion, and what the test said."""
    path = tiny_weights(tmp_path, "moglo")
    names = [column for column, _ in example_globals("ship_weights.py")["TOLD"].values()]
    table = tmp_path / "table.csv"
    own = Network("moglo", path).origin["weights"]
    lines = [f"moglo,{own},a{k},p{k // 2},{','.join([str(k)] * len(names))}" for k in range(3)]
    other = f"moglo,0123,a0,p0,{','.join(['9'] * len(names))}"  # another training of the name
    table.write_text("\n".join([f"method,weights,scan,subject,{','.join(names)}", *lines, other]))

    example("ship_weights.py")(table, tmp_path / "out", [str(path)])

    before, _ = load_weights(path)
    after, info = load_weights(tmp_path / "out" / "moglo.safetensors")
    frames = torch.rand((1, 3, 1, 64, 64), generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        motion, shipped = before(frames).motion, after(frames).motion
    assert float((shipped - motion).norm() / motion.norm()) < 0.01  # 11 bits in some ten layers
    assert (tmp_path / "out" / "moglo.safetensors").stat().st_size < 0.7 * path.stat().st_size
    assert info.metrics["test_rae"] == 1.0
    assert info.metrics["r_elevational"] == 0.5
    card = (tmp_path / "out" / "moglo.md").read_text()
    assert "Mean over 3 simulated test sweeps of 2 subjects" in card
    assert "| correlation, elevational | 1 |" in card
    table.write_text(f"method,weights,scan,subject,{','.join(names)}\n{other}\n")
    with pytest.raises(SystemExit, match="no rows of the weights of"):
        example("ship_weights.py")(table, tmp_path / "out", [str(path)])

"""Whole runs: what they leave behind, and that a kill changes no number."""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sonosweep.cli.main import main
from sonosweep.errors import FormatError, RecipeError, ScanError, TrainingError
from sonosweep.estimators.weights import load_weights
from sonosweep.training.recipe import recipe_from_text, recipe_text
from sonosweep.training.run import train
from sonosweep.training.scans import open_data
from sonosweep.training.sequences import motion_statistics
from tests.training.tiny import (
    build,
    telling_files,
    tiny_files,
    tiny_recipe,
    tiny_scan,
    write_files,
)

PAIRS = 2 * 24
ROUND_OFF = 1e-6  # float32: gradients summed in another order, for ten steps


class Killed(Exception):
    """What a run is ended with."""


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> list[str]:
    """Return two scans to train on and one for validation."""
    return tiny_files(tmp_path_factory.mktemp("scans"))


@pytest.fixture(scope="module")
def finished(files, tmp_path_factory) -> Path:
    """Return the folder of a run that was not disturbed."""
    folder = tmp_path_factory.mktemp("finished")
    train(tiny_recipe(files), folder, build=build, device="cpu")
    return folder


def state(folder: Path) -> dict[str, torch.Tensor]:
    """Return the weights that a run left."""
    return load_weights(folder / "weights.safetensors", build)[0].state_dict()


def rows(folder: Path) -> list[dict[str, str]]:
    """Return the log of a run, without the time that it took."""
    table = csv.DictReader((folder / "log.csv").read_text().splitlines())
    return [{name: text for name, text in row.items() if name != "cpu_s"} for row in table]


def cpu_times(folder: Path) -> list[float]:
    """Return the CPU time that a log tells."""
    table = csv.DictReader((folder / "log.csv").read_text().splitlines())
    return [float(row["cpu_s"]) for row in table]


def end_at(pairs: int, error: type[BaseException] = Killed):
    """Return a progress function that ends the run once so many pairs are done."""

    def progress(done: int, total: int) -> None:
        if done >= pairs:
            raise error

    return progress


def test_a_run_leaves_weights_that_say_what_they_need(files, finished):
    """Network, input, spacing, scale, recipe and data are in the file of the weights."""
    recipe = tiny_recipe(files)
    pool, _ = open_data(recipe.data, recipe.input)

    network, info = load_weights(finished / "weights.safetensors", build)

    assert not network.training
    assert info.network == "tiny"
    assert info.window == 4
    assert info.spacing_mm == pytest.approx((0.3, 0.2))
    assert info.center_mm == pytest.approx((0.3 * 15.5, 0.2 * 15.5))
    torch.testing.assert_close(
        torch.tensor(info.motion_scale, dtype=torch.float64), motion_statistics(pool).scale
    )
    assert recipe_from_text(info.recipe) == recipe
    assert {"r_elevational", "rae", "fdr", "rae_of_mean"} <= set(info.metrics)


def test_a_run_leaves_a_log_a_page_and_its_recipe(files, finished):
    """Ten steps, measured twice; the page shows the curves and needs no other file."""
    log = rows(finished)
    page = (finished / "training.html").read_text()

    assert [row["step"] for row in log] == [str(k) for k in range(1, 11)]
    assert log[-1]["pairs"] == str(PAIRS)
    assert [bool(row["rae"]) for row in log].count(True) == 2
    assert "<svg" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    assert (finished / "recipe.toml").read_text() == recipe_text(tiny_recipe(files))


def test_a_run_learns(tmp_path):
    """Where brightness tells how far the probe went, that is read off unseen scans."""
    stages = [{"pairs": 1600, "window": 2, "batch": 16, "learning_rate": 3e-2}]
    plain = {"gain": 0.0, "contrast": 0.0, "gamma": 0.0, "noise": 0.0}
    recipe = tiny_recipe(
        telling_files(tmp_path),
        stages=stages,
        network={"name": "tiny", "options": {"drop": 0.0}},
        augment=plain,
    )

    metrics = train(recipe, tmp_path / "run", build=build, device="cpu").metrics

    # Of numbers that tell nothing, 59 steps correlate by less than 4 / sqrt(59).
    assert metrics["r_elevational"] > 0.52


@pytest.mark.parametrize("pairs", [8, 20, 36])
def test_a_run_that_was_killed_ends_with_the_same_numbers(files, finished, tmp_path, pairs):
    """Before and after a checkpoint, in the first stage and the second: bit by bit."""
    recipe = tiny_recipe(files, checkpoint_minutes=1e-9)
    with pytest.raises(Killed):
        train(recipe, tmp_path, build=build, device="cpu", progress=end_at(pairs))
    assert not (tmp_path / "weights.safetensors").exists()

    train(recipe, tmp_path, resume=True, build=build, device="cpu")

    for name, value in state(finished).items():
        assert torch.equal(state(tmp_path)[name], value)
    assert rows(tmp_path) == rows(finished)
    assert cpu_times(tmp_path) == sorted(cpu_times(tmp_path))


def test_a_run_without_a_checkpoint_begins_again(files, finished, tmp_path):
    """Killed before the first one, it still ends with the same numbers."""
    with pytest.raises(Killed):
        train(tiny_recipe(files), tmp_path, build=build, device="cpu", progress=end_at(4))
    assert not (tmp_path / "checkpoint.ckpt").exists()

    train(tiny_recipe(files), tmp_path, resume=True, build=build, device="cpu")

    assert rows(tmp_path) == rows(finished)


def test_a_finished_run_can_be_resumed(files, finished, tmp_path):
    """There is nothing left to do, and the weights are written again."""
    recipe = tiny_recipe(files)
    first = train(recipe, tmp_path, build=build, device="cpu")
    before = state(tmp_path)
    (tmp_path / "weights.safetensors").unlink()

    again = train(recipe, tmp_path, resume=True, build=build, device="cpu")

    assert all(torch.equal(value, before[name]) for name, value in state(tmp_path).items())
    assert again.metrics == pytest.approx(first.metrics, nan_ok=True)


def test_another_recipe_cannot_go_on(files, finished):
    """The sentence shows the first line that differs."""
    with pytest.raises(RecipeError, match="had another recipe, beginning with 'seed = 5'"):
        train(tiny_recipe(files, seed=5), finished, resume=True, build=build, device="cpu")


def test_a_checkpoint_is_no_program(finished):
    """It holds tensors and plain values, which are read without running code."""
    checkpoint = torch.load(finished / "checkpoint.ckpt", weights_only=True)

    assert checkpoint["global_step"] == 10


def test_ctrl_c_stays_ctrl_c(files, tmp_path):
    """An interrupt comes out as one, and the next one is heard too."""
    before = signal.getsignal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(
            tiny_recipe(files),
            tmp_path,
            build=build,
            device="cpu",
            progress=end_at(8, KeyboardInterrupt),
        )

    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(("infinite_slope", "what"), [(False, "loss"), (True, "gradient")])
def test_a_loss_that_is_no_number_stops_the_run(files, tmp_path, infinite_slope, what):
    """It is said where, and the last good checkpoint is kept."""
    network = {"name": "broken", "options": {"after": 7, "infinite_slope": infinite_slope}}
    stages = [{"pairs": 24, "window": 2, "batch": 4}, {"pairs": 8, "window": 2, "batch": 2}]
    recipe = tiny_recipe(files, network=network, checkpoint_minutes=1e-9, stages=stages)

    with pytest.raises(TrainingError, match=f"{what}.* is not a number at step 7 .stage 1"):
        train(recipe, tmp_path, build=build, device="cpu")

    checkpoint = torch.load(tmp_path / "checkpoint.ckpt", weights_only=True)
    assert checkpoint["global_step"] == 7
    assert bool(checkpoint["state_dict"]["network.weight"].isfinite().all())


def test_a_new_run_leaves_nothing_of_the_one_before(files, tmp_path):
    """Weights of the old recipe beside the new one would pass for the new run's."""
    train(tiny_recipe(files), tmp_path, build=build, device="cpu")
    before = (tmp_path / "recipe.toml").read_text()

    with pytest.raises(Killed):
        train(tiny_recipe(files, seed=5), tmp_path, build=build, device="cpu", progress=end_at(8))

    assert (tmp_path / "recipe.toml").read_text() != before
    assert not (tmp_path / "weights.safetensors").exists()


def test_data_that_cannot_be_used_leave_no_run(files, tmp_path):
    """Nor do they harm the one that is there."""
    absent = str(tmp_path / "absent.h5")
    data = {"train": [absent], "validation": files[2:]}

    with pytest.raises(FormatError, match="absent"):
        train(tiny_recipe(files, data=data), tmp_path / "run", build=build, device="cpu")

    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("train_frames", "validation_frames", "message"),
    [
        (4, 12, "'scan0' has no 5 tracked frames in a row: shorten the window"),
        (12, 1, "'scan1' has no two tracked frames in a row to measure on"),
    ],
)
def test_short_scans_are_refused_at_the_start(tmp_path, train_frames, validation_frames, message):
    """Before the first stage, and not when the last one comes to them."""
    paths = write_files(tmp_path, [tiny_scan(0, train_frames), tiny_scan(1, validation_frames)])
    stages = [{"pairs": 8, "window": 2, "batch": 2}, {"pairs": 8, "window": 5, "batch": 2}]
    data = {"train": paths[:1], "validation": paths[1:]}

    with pytest.raises(ScanError, match=message):
        train(
            tiny_recipe(paths, data=data, stages=stages),
            tmp_path / "run",
            build=build,
            device="cpu",
        )


def test_short_memory_says_which_knob(files, tmp_path, monkeypatch):
    """What PyTorch says of memory becomes a sentence about the recipe."""

    def no_memory(*_):
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr("sonosweep.training.module.total_loss", no_memory)

    with pytest.raises(TrainingError, match=r"lower the batch \(4\) or window \(2\) of stage 0"):
        train(tiny_recipe(files), tmp_path, build=build, device="cpu")


def test_a_network_of_windows_needs_its_window(files, tmp_path):
    """It reads three frames, so stages of two or four are refused."""
    recipe = tiny_recipe(files, network={"name": "window"})

    with pytest.raises(RecipeError, match="reads 3 frames at once: the window of stage 0"):
        train(recipe, tmp_path, build=build, device="cpu")


def test_a_network_of_windows_is_trained_and_measured(files, tmp_path):
    """With its own window it runs, and gives a motion for each step of a scan."""
    stages = [{"pairs": 16, "window": 3, "batch": 4, "learning_rate": 1e-3}]

    run = train(
        tiny_recipe(files, network={"name": "window"}, stages=stages),
        tmp_path,
        build=build,
        device="cpu",
    )

    assert run.pairs == 16
    assert run.metrics["rae"] > 0


def test_bf16_trains_too(files, tmp_path):
    """Half the bits give finite weights."""
    train(tiny_recipe(files, precision="bf16"), tmp_path, build=build, device="cpu")

    assert all(bool(value.isfinite().all()) for value in state(tmp_path).values())


def test_the_command_trains_a_network_of_ours(files, tmp_path, capsys):
    """From a recipe on the command line to weights that are read again."""
    stages = [{"pairs": 8, "window": 2, "batch": 4}]
    network = {"name": "cnn", "options": {"width": 4}}
    size = {"rows": 64, "columns": 64}
    recipe = tiny_recipe(files, network=network, stages=stages, input=size)
    path = tmp_path / "recipe.toml"
    path.write_text(recipe_text(recipe))

    main(["train", str(path), "-o", str(tmp_path / "run"), "--set", "seed=3", "--device", "cpu"])

    assert "cnn" in capsys.readouterr().out
    _, info = load_weights(tmp_path / "run" / "weights.safetensors")
    assert recipe_from_text(info.recipe).seed == 3


def test_the_command_overwrites_no_run(finished, tmp_path, capsys):
    """Without --resume or --force a run that is there stays."""
    path = tmp_path / "recipe.toml"
    path.write_text((finished / "recipe.toml").read_text())

    with pytest.raises(SystemExit):
        main(["train", str(path), "-o", str(finished)])

    assert "exists" in capsys.readouterr().err


SCRIPT = """
import sys, torch
from tests.training.tiny import build, tiny_recipe
from sonosweep.training.run import train
torch.set_num_threads(1)
files, folder = sys.argv[2:], sys.argv[1]
network = {"name": "tiny", "options": {"drop": 0.0}}
recipe = tiny_recipe(files, network=network, augment={"noise": 0.0})
train(recipe, folder, build=build, device="cpu", resume=True)
"""


@pytest.mark.slow
def test_two_processes_give_what_one_does(files, tmp_path):
    """Both share each batch and average their gradients: the same weights, to round-off."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = Path(__file__).parents[2]
    launch = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    launch += ["--master-port", "29517", str(script), str(tmp_path / "two"), *files]
    network = {"name": "tiny", "options": {"drop": 0.0}}

    done = subprocess.run(
        launch,
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=240,
    )
    recipe = tiny_recipe(files, network=network, augment={"noise": 0.0})
    train(recipe, tmp_path / "one", build=build, device="cpu")

    assert done.returncode == 0, done.stderr
    for name, value in state(tmp_path / "one").items():
        torch.testing.assert_close(state(tmp_path / "two")[name], value, atol=ROUND_OFF, rtol=0)
    assert json.dumps([row["step"] for row in rows(tmp_path / "two")]) == json.dumps(
        [row["step"] for row in rows(tmp_path / "one")]
    )

"""Networks on the command line; untrained ones, whose motion is finite and nothing more."""

import json
import pickle

import h5py
import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from sonosweep.estimators.weights import DIGEST, FORMAT, INFO_DIGEST, KEY
from sonosweep.io import read_trajectory
from tests.cli.test_bad_input import one_sentence
from tests.estimators.tiny_weights import tiny_weights

FIELD_MM = 16.0  # the width of the sweep's frames


@pytest.fixture
def weights(tmp_path):
    """Return the file of weights that the sweep fits."""
    return tiny_weights(tmp_path, spacing_mm=(FIELD_MM / 64, FIELD_MM / 64))


def test_a_sweep_is_reconstructed_with_weights(run, sweep, weights, tmp_path):
    """The summary names the network, and the report says what it is good for."""
    ran = run("reconstruct", sweep, "--estimator", weights, "--voxel-mm", "1", "-o", "out")

    assert ran.code == 0, ran.error
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["runs"][0]["method"] == "cnn"
    assert any("holds for tissue" in sentence for sentence in summary["assumptions"])
    assert "estimating motion: 12 of 12" in ran.error
    assert "holds for tissue" in (tmp_path / "out" / "report.html").read_text()


def test_a_run_folder_is_an_estimator(run, sweep, weights, tmp_path):
    """Backward sweeps are mirrored, whatever read them."""
    weights.rename(tmp_path / "weights.safetensors")

    for way in ("forward", "backward"):
        ran = run(
            "estimate", sweep, "--estimator", ".", "--direction", way, "-o", f"{way}.csv", "--json"
        )
        assert ran.code == 0, ran.error

    assert json.loads(ran.out)["method"] == "cnn"
    forward, backward = (
        read_trajectory(f"{way}.csv").image_to_reference[:, :3, 3]
        for way in ("forward", "backward")
    )
    mirror = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert float(forward[-1, 2].abs()) > 0.1
    torch.testing.assert_close(backward, forward * mirror, atol=1e-6, rtol=0)


def test_info_describes_weights(run, weights):
    """Which network, what it reads and how good it was."""
    ran = run("info", weights)
    as_json = json.loads(run("info", weights, "--json").out)

    assert ran.code == 0, ran.error
    for words in ("cnn", "64 x 64 pixels", "16.0 x 16.0 mm", "r_elevational 0.5", "2026-01-02"):
        assert words in ran.out
    assert as_json["network"] == "cnn"
    assert as_json["spacing_mm"] == [0.25, 0.25]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--estimator", "mogli"), "no estimator is called 'mogli'; give decorrelation"),
        (("--estimator", "gone.safetensors"), "there is no 'gone.safetensors'"),
        (("--calibration", "x.toml"), "a network has learned its own"),
        (("--poses", "tracked"), "--estimator is for estimating"),
        (("--maps",), "network 'cnn' has no maps to show"),
        (("--pixel-spacing", "0.1", "0.1"), "is 8.0 mm wide"),
        (("--pixel-spacing", "0.7", "0.7"), "too coarse"),
        (("--device", "abacus"), "abacus"),
    ],
)
def test_what_does_not_go_together_is_refused(run, sweep, weights, tmp_path, words, expected):
    """In one sentence, with nothing left behind."""
    named = () if "--estimator" in words else ("--estimator", weights)

    one_sentence(run("reconstruct", sweep, *named, *words, "-o", "out"), tmp_path, expected)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--maps",), "name one with --estimator"),
        (("--precision", "bf16"), "--precision is about a network"),
        (("--device", "cpu"), "--device is about a network"),
        (("--poses", "tracked", "--maps"), "name one with --estimator"),
    ],
)
def test_options_of_networks_need_one(run, sweep, tmp_path, words, expected):
    """An option is obeyed or refused, never passed over."""
    one_sentence(run("reconstruct", sweep, *words, "-o", "out"), tmp_path, expected)


def _truncated(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _header_cut(path):
    path.write_bytes(path.read_bytes()[:20])


def _empty(path):
    path.write_bytes(b"")


def _flipped_header(path):
    content = bytearray(path.read_bytes())
    content[9] ^= 0xFF
    path.write_bytes(bytes(content))


def _flipped_length(path):
    content = bytearray(path.read_bytes())
    content[6] ^= 0xFF
    path.write_bytes(bytes(content))


def _flipped_number(path):
    content = bytearray(path.read_bytes())
    content[-100] ^= 0x01
    path.write_bytes(bytes(content))


def _pickle(path):
    path.write_bytes(pickle.dumps({"weights": [1, 2, 3]}))


def _torch_file(path):
    torch.save({"weight": torch.zeros(3)}, path)


def _rewritten(path, change_tensors=lambda tensors: None, change_facts=lambda facts: None):
    with safe_open(path, framework="pt") as file:
        metadata = dict(file.metadata())
    tensors = load_file(path)
    facts = json.loads(metadata[KEY])
    change_tensors(tensors)
    change_facts(facts)
    del metadata[DIGEST], metadata[INFO_DIGEST]  # what is wrong here was wrong from the start
    save_file(tensors, path, metadata | {KEY: json.dumps(facts)})


def _wrong_keys(path):
    _rewritten(path, lambda tensors: tensors.update(other=tensors.pop(next(iter(tensors)))))


def _wrong_shapes(path):
    def change(tensors):
        name = next(name for name, values in tensors.items() if values.ndim == 4)
        tensors[name] = tensors[name][:1].clone()

    _rewritten(path, change)


def _not_finite(path):
    def change(tensors):
        name = next(name for name, values in tensors.items() if values.ndim == 4)
        tensors[name][0, 0, 0, 0] = float("nan")

    _rewritten(path, change)


def _unknown_network(path):
    _rewritten(path, change_facts=lambda facts: facts.update(network="oracle"))


def _unknown_option(path):
    _rewritten(path, change_facts=lambda facts: facts["options"].update(wings=2))


def _missing_fact(path):
    _rewritten(path, change_facts=lambda facts: facts.pop("spacing_mm"))


def _of_others(path):
    save_file({"weight": torch.zeros(3)}, path, {"format": "pt"})


DAMAGE = {
    _truncated: "damaged",
    _header_cut: "damaged",
    _empty: "damaged",
    _flipped_header: "damaged",
    _flipped_length: "damaged",
    _flipped_number: "damaged: its numbers are not those",
    _pickle: "damaged, or no safetensors file",
    _torch_file: "damaged, or no safetensors file",
    _wrong_keys: "do not fit network 'cnn'",
    _wrong_shapes: "do not fit network 'cnn'",
    _not_finite: "not finite",
    _unknown_network: "no network is called 'oracle'",
    _unknown_option: "no option 'wings'",
    _missing_fact: "cannot be read",
    _of_others: f"holds no weights of ours ({FORMAT})",
}


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda damage: damage.__name__.strip("_"))
def test_weights_that_are_damaged_or_foreign(run, sweep, weights, tmp_path, damage):
    """Each kind is one sentence that names the file; nothing in it is ever executed."""
    damage(weights)

    ran = run("reconstruct", sweep, "--estimator", weights, "-o", "out")

    one_sentence(ran, tmp_path, DAMAGE[damage])
    assert weights.name in ran.sentence


def test_a_missing_channel_is_named(run, sweep, tmp_path):
    """A network that reads IQ is of no use to a recording of B-mode."""
    reads = {"rows": 64, "columns": 64, "channels": "b_mode+iq"}
    weights = tiny_weights(tmp_path, input=reads, spacing_mm=(0.25, 0.25))

    ran = run("reconstruct", sweep, "--estimator", weights, "-o", "out")

    one_sentence(ran, tmp_path, "need the companion 'iq'")


def test_maps_are_written(run, sweep, tmp_path):
    """One attention and one correlation map a step, and a picture."""
    weights = tiny_weights(tmp_path, "moglo", spacing_mm=(0.25, 0.25))

    ran = run(
        "reconstruct", sweep, "--estimator", weights, "--maps", "--voxel-mm", "1", "-o", "out"
    )

    assert ran.code == 0, ran.error
    with h5py.File(tmp_path / "out" / "maps.h5") as file:
        shapes = {name: values.shape for name, values in file.items()}
        attention = file["attention"][:]
    assert shapes == {"attention": (11, 4, 4), "correlation": (11, 5, 5)}
    assert np.isfinite(attention).all()
    assert attention.std(axis=(1, 2)).min() > 0
    picture = np.asarray(Image.open(tmp_path / "out" / "maps.png"))
    assert picture.shape == (44 + 3 * 382, 12 + 4 * 352, 3)
    assert {"maps.h5", "maps.png"} <= set(
        json.loads((tmp_path / "out" / "summary.json").read_text())["files"]
    )

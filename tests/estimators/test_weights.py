"""Files of weights: they come back, and what is no such file is said so in one sentence."""

import hashlib
import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from sonosweep.errors import FormatError
from sonosweep.estimators.network import FrameShape
from sonosweep.estimators.network_input import InputSettings
from sonosweep.estimators.network_names import build_network
from sonosweep.estimators.weights import (
    WeightsInfo,
    load_weights,
    read_weights_info,
    save_weights,
)

INFO = WeightsInfo(
    network="cnn",
    preset="compact",
    options={"width": 4, "hidden": 4},
    input=InputSettings(rows=64, columns=64),
    spacing_mm=(0.3, 0.2),
    center_mm=(9.45, 6.3),
    window=2,
    motion_scale=(0.1, 0.2, 0.3, 0.01, 0.02, 0.03),
    mean_motion=(0.0, 0.0, 0.2, 0.0, 0.0, 0.0),
    parameters=1,
    recipe="seed = 0\n",
    data="0123",
    metrics={"rae": 0.05, "fdr": None},
    made="2030-01-02",
    version="0.1.0",
)


@pytest.fixture
def path(tmp_path) -> Path:
    """Return a file of weights of a small network."""
    torch.manual_seed(0)
    network = build_network("cnn", INFO.options, FrameShape(1, 64, 64))
    save_weights(tmp_path / "weights.safetensors", network, INFO)
    return tmp_path / "weights.safetensors"


def rewritten(path: Path, **changes: object) -> Path:
    """Write the file again with other facts about the weights; ``None`` leaves one out."""
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = file.metadata()
    facts = json.loads(metadata["sonosweep"]) | changes
    kept = {name: value for name, value in facts.items() if value is not None}
    said = json.dumps(kept)
    digest = hashlib.sha256(said.encode()).hexdigest()
    save_file(tensors, path, metadata | {"sonosweep": said, "sonosweep_sha256": digest})
    return path


def test_weights_come_back(path):
    """The same answers, bit by bit, and the same facts."""
    torch.manual_seed(0)
    network = build_network("cnn", INFO.options, FrameShape(1, 64, 64)).eval()
    frames = torch.rand(1, 2, 1, 64, 64)

    loaded, info = load_weights(path)

    assert info == INFO
    assert read_weights_info(path) == INFO
    assert not loaded.training
    assert torch.equal(loaded(frames).motion, network(frames).motion)


def test_a_changed_digit_of_what_is_said_is_noticed(path):
    """A scale that is nine times too large would be a silent wrong answer."""
    content = path.read_bytes()
    assert content.count(b'"motion_scale\\":[0.1,') == 1
    path.write_bytes(content.replace(b'"motion_scale\\":[0.1,', b'"motion_scale\\":[0.9,'))

    with pytest.raises(FormatError, match="is damaged: what it says is not what was written"):
        load_weights(path)


def test_any_cut_of_a_file_is_refused(path):
    """A download that broke off at any place is damaged."""
    whole = path.read_bytes()
    for size in (0, 1, 8, 9, 200, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(FormatError, match="is damaged, or no safetensors file"):
            load_weights(path)


def test_a_pickle_is_refused(path):
    """What torch.save writes is never opened."""
    torch.save({"weight": torch.zeros(3)}, path)

    with pytest.raises(FormatError, match="no safetensors file"):
        load_weights(path)


def test_weights_of_others_are_refused(path):
    """A safetensors file that does not say what it is for."""
    save_file({"weight": torch.zeros(3)}, path)

    with pytest.raises(FormatError, match="holds no weights of ours"):
        load_weights(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"network": "mogli"}, "no network is called 'mogli'"),
        ({"preset": "tiny"}, "no preset 'tiny'"),
        ({"options": {"width": 8, "hidden": 4}}, "do not fit network 'cnn'"),
        ({"options": {"widht": 8}}, "widht"),
        ({"made": None}, "cannot be read"),
        ({"surprise": 1}, "cannot be read"),
        ({"motion_scale": [1.0, 2.0]}, "cannot be read"),
        ({"motion_scale": [1.0, 2.0, 3.0, 4.0, 5.0, -6.0]}, "cannot be read"),
        ({"spacing_mm": [0.0, 0.2]}, "cannot be read"),
    ],
)
def test_facts_that_do_not_fit_are_refused(path, changes, message):
    """Another network, other options, or facts that are missing or make no sense."""
    with pytest.raises(FormatError, match=message):
        load_weights(rewritten(path, **changes))


def test_weights_that_are_no_numbers_are_refused(path):
    """A network that overflowed is of no use."""
    network = build_network("cnn", INFO.options, FrameShape(1, 64, 64))
    with torch.no_grad():
        next(network.parameters()).fill_(torch.nan)
    save_weights(path, network, INFO)

    with pytest.raises(FormatError, match="are not finite"):
        load_weights(path)


def test_a_missing_file_is_said(tmp_path):
    """There is none of that name."""
    with pytest.raises(FormatError, match="cannot read weights"):
        load_weights(tmp_path / "nowhere.safetensors")

"""A file must never be able to run a program: nothing is unpickled."""

import ast
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

import sonosweep
from sonosweep.errors import SonosweepError
from sonosweep.estimators.curve_file import read_curve
from sonosweep.io import open_scan, read_trajectory, read_volume
from sonosweep.io.plus_config import read_plus_config

SOURCE = Path(sonosweep.__file__).parent
UNPICKLERS = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
LOADERS = {("np", "load"), ("numpy", "load"), ("torch", "load"), ("pandas", "read_pickle")}
READERS = (open_scan, read_volume, read_trajectory, read_curve, read_plus_config)
SUFFIXES = """npy npz pkl pickle pt pth mat h5 hdf5 mha igs.mha nrrd igs.nrrd seq.nrrd nii
nii.gz dcm mp4 png csv txt tum tfm toml xml zarr""".split()  # noqa: SIM905, readable so


class Planted:
    """What makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        """Remember which folder."""
        self.folder = folder

    def __reduce__(self):
        """Say what unpickling calls."""
        return os.mkdir, (str(self.folder),)


def names_in(tree: ast.AST) -> set[str]:
    """Return what a module imports, loads and passes that could unpickle."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {name.name.split(".")[0] for name in node.names} & UNPICKLERS
        elif isinstance(node, ast.ImportFrom):
            found |= {(node.module or "").split(".")[0]} & UNPICKLERS
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if (node.value.id, node.attr) in LOADERS:
                found.add(f"{node.value.id}.{node.attr}")
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            found.add("allow_pickle")
    return found


def test_no_module_can_unpickle():
    """No module of the package imports an unpickler or calls a loader that has one."""
    modules = list(SOURCE.rglob("*.py"))

    assert len(modules) > 100
    assert {
        path.name: found for path in modules if (found := names_in(ast.parse(path.read_text())))
    } == {}


@pytest.mark.parametrize("kind", ["pickle", "npy", "torch"])
def test_a_planted_program_is_not_run(tmp_path, kind):
    """A pickle, NumPy's or PyTorch's, is refused under every name and by every reader."""
    made = tmp_path / "made"
    stored = tmp_path / "stored"
    with stored.open("wb") as file:
        if kind == "pickle":
            pickle.dump(Planted(made), file)
        elif kind == "npy":
            np.save(file, np.array([Planted(made)], dtype=object), allow_pickle=True)
        else:
            torch.save({"weights": Planted(made)}, file)

    for suffix in SUFFIXES:
        path = tmp_path / f"scan.{suffix}"
        path.write_bytes(stored.read_bytes())
        for read in READERS:
            with pytest.raises(SonosweepError):
                read(path)
    assert not made.exists()

    if kind == "pickle":  # the trap works
        pickle.loads(stored.read_bytes())
        assert made.is_dir()

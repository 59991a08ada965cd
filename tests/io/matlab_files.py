"""MATLAB workspaces written as MATLAB writes them, both as version 5 and as ``-v7.3``.

A dictionary is a struct, a list of dictionaries an array of structs, a tuple cells, a string
text, anything else numbers.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.io import savemat


def save_mat(path: Path, workspace: dict[str, Any], version: str, **options: Any) -> Path:
    """Write a workspace, ``"5"`` or ``"7.3"``, and return where."""
    if version == "5":
        values = {name: _old(value) for name, value in workspace.items()}
        savemat(path, values, oned_as="row", **options)
        return path
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in workspace.items():
            _Writer(file).put(file, name, value)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def _old(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _old(inner) for name, inner in value.items()}
    if isinstance(value, list):
        structs = np.empty((1, len(value)), [(name, object) for name in value[0]])
        for k, struct in enumerate(value):
            structs[0, k] = tuple(_old(inner) for inner in struct.values())
        return structs
    if isinstance(value, tuple):
        cells = np.empty((1, len(value)), object)
        for k, inner in enumerate(value):
            cells[0, k] = _old(inner)
        return cells
    return value


class _Writer:
    """Puts values into an HDF5 file as MATLAB does."""

    def __init__(self, file: h5py.File) -> None:
        self._refs = file.require_group("#refs#")

    def put(self, group: h5py.Group, name: str, value: Any) -> h5py.HLObject:
        """Write a value and return its group or data set."""
        if isinstance(value, dict):
            node = group.create_group(name)
            node.attrs["MATLAB_class"] = np.bytes_("struct")
            for inner_name, inner in value.items():
                self.put(node, inner_name, inner)
            return node
        if isinstance(value, list):
            node = group.create_group(name)
            node.attrs["MATLAB_class"] = np.bytes_("struct")
            for field in value[0]:
                self._references(node, field, [struct[field] for struct in value])
            return node
        if isinstance(value, tuple):
            node = self._references(group, name, list(value))
            node.attrs["MATLAB_class"] = np.bytes_("cell")
            return node
        return self._array(group, name, value)

    def _references(self, group: h5py.Group, name: str, values: list) -> h5py.Dataset:
        dataset = group.create_dataset(name, (len(values), 1), h5py.ref_dtype)
        for k, value in enumerate(values):
            place = f"r{len(self._refs)}"
            dataset[k, 0] = self.put(self._refs, place, value).ref
        return dataset

    def _array(self, group: h5py.Group, name: str, value: Any) -> h5py.Dataset:
        is_text = isinstance(value, str)
        array = np.frombuffer(value.encode("utf-16-le"), np.uint16) if is_text else value
        array = np.atleast_2d(np.asarray(array))
        if array.size == 0:
            node = group.create_dataset(name, data=np.array(array.shape, np.uint64))
            node.attrs["MATLAB_empty"] = np.int32(1)
        else:
            node = group.create_dataset(name, data=array.T)
        known = {"float64": "double", "float32": "single"}
        kind = "char" if is_text else known.get(str(array.dtype), str(array.dtype))
        node.attrs["MATLAB_class"] = np.bytes_(kind)
        return node

"""Maps of a network on disk."""

import h5py
import pytest
import torch

from sonosweep.errors import FormatError
from sonosweep.io.map_file import MapFile, read_maps


def test_maps_come_back_step_by_step(tmp_path):
    """However many arrive at a time, in half precision."""
    maps = torch.rand(40, 3, 2, generator=torch.Generator().manual_seed(0))

    with MapFile(tmp_path / "maps.h5") as file:
        for first, count in ((0, 1), (1, 38), (39, 1)):
            file.append(first, {"attention": maps[first : first + count]})

    with h5py.File(tmp_path / "maps.h5") as stored:
        assert stored["attention"].shape == (40, 3, 2)
    for step in (0, 17, 39):
        found = read_maps(tmp_path / "maps.h5", step)["attention"]
        torch.testing.assert_close(found, maps[step], atol=2**-11, rtol=0)


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    """In one sentence."""
    with pytest.raises(FormatError, match="cannot write"):
        MapFile(tmp_path / "no" / "maps.h5")

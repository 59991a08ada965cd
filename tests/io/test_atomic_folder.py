"""Folders of results are whole or not there, on whatever disk they lie."""

import pytest

from sonosweep.errors import FormatError
from sonosweep.io.atomic_folder import temporary_for, write_folder_beside


def test_an_existing_folder_is_filled_from_within(tmp_path):
    """It may be a disk of its own, into which nothing can be renamed from outside."""
    (tmp_path / "disk").mkdir()

    temporary = temporary_for(tmp_path / "disk")

    assert temporary.parent == tmp_path / "disk"


def test_of_two_that_make_one_folder_the_second_is_refused(tmp_path):
    """The first one's files stay together."""

    def slow():
        with write_folder_beside(tmp_path / "out", ("*.a",)) as folder:
            (folder / "slow.a").write_text("slow")
            with write_folder_beside(tmp_path / "out", ("*.a",)) as quick:
                (quick / "quick.a").write_text("quick")

    with pytest.raises(FormatError, match="cannot write"):
        slow()

    assert [path.name for path in (tmp_path / "out").iterdir()] == ["quick.a"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_older_files_of_ours_go_and_an_error_keeps_them(tmp_path):
    """A shorter series leaves no slice of the longer one; a failed one changes nothing."""
    with write_folder_beside(tmp_path / "out", ("*.a",)) as folder:
        (folder / "0.a").write_text("old")
        (folder / "1.a").write_text("old")

    def interrupted():
        with write_folder_beside(tmp_path / "out", ("*.a",)) as folder:
            (folder / "0.a").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    kept = {path.name: path.read_text() for path in (tmp_path / "out").iterdir()}
    with write_folder_beside(tmp_path / "out", ("*.a",)) as new:
        (new / "0.a").write_text("new")

    assert kept == {"0.a": "old", "1.a": "old"}
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == {"0.a": "new"}

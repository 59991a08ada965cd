"""NRRD as other programs write it, and headers that promise the impossible."""

import gzip
from dataclasses import replace
from pathlib import Path

import nrrd
import numpy as np
import pytest

from sonosweep.errors import FormatError
from sonosweep.io.nrrd import read_nrrd, write_nrrd
from tests.io.damage import resident_mb_after
from tests.io.volume_files import random_volume

HEADER = "NRRD0004\ntype: {type}\ndimension: 3\nsizes: {sizes}\nencoding: {encoding}\n"
SMALL_MB = 400  # Python, NumPy and torch alone; a terabyte would show


def write_raw(path: Path, header: str, voxels: bytes) -> Path:
    """A NRRD file made by hand."""
    path.write_bytes(header.encode() + b"\n" + voxels)
    return path


def test_pynrrd_reads_what_we_write(tmp_path: Path):
    """The library of others finds the same voxels, space and provenance."""
    volume = random_volume(np.random.default_rng(0), dtype="int16", channels=2)
    write_nrrd(volume, tmp_path / "volume.nrrd", "lps")

    voxels, header = nrrd.read(str(tmp_path / "volume.nrrd"), index_order="C")

    np.testing.assert_array_equal(voxels, volume.voxels)
    assert header["space"] == "left-posterior-superior"
    assert header["kinds"] == ["vector", "domain", "domain", "domain"]
    assert header["sonosweep world"] == "lps"


def test_writing_twice_gives_the_same_bytes(tmp_path: Path):
    """No date or file name hides in the file."""
    volume = random_volume(np.random.default_rng(1))

    write_nrrd(volume, tmp_path / "a.nrrd")
    write_nrrd(volume, tmp_path / "b.nrrd")

    assert (tmp_path / "a.nrrd").read_bytes() == (tmp_path / "b.nrrd").read_bytes()


def test_settings_may_hold_any_text(tmp_path: Path):
    """Line breaks, colons and umlauts in provenance neither break the header nor get lost."""
    settings = {"file": "C:\\sweeps\\Knöchel:=1", "note": "two\nlines", "empty": ""}
    volume = replace(random_volume(np.random.default_rng(2)), settings=settings)

    write_nrrd(volume, tmp_path / "volume.nrrd")

    assert read_nrrd(tmp_path / "volume.nrrd").settings == settings


@pytest.mark.parametrize("space", ["right-anterior-superior", "RAS", "left-anterior-superior"])
def test_other_spaces_are_turned_to_lps(tmp_path: Path, space: str):
    """A point 1 mm right and 2 mm in front is at (-1, -2) of LPS; LAS differs in x only."""
    header = HEADER.format(type="uint8", sizes="2 2 2", encoding="raw")
    header += f"space: {space}\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (1,2,3)\n"

    volume = read_nrrd(write_raw(tmp_path / "v.nrrd", header, bytes(range(8))), "lps")

    # Left-anterior-superior axes are left-handed, so its two slices are counted from the top.
    expected = (1, -2, 4) if space.startswith("left") else (-1, -2, 3)
    assert volume.grid.origin_mm == pytest.approx(expected)


def test_channels_may_be_the_last_axis(tmp_path: Path):
    """Some programs store colour planes one after the other."""
    voxels = np.arange(3 * 2 * 4 * 5, dtype=np.uint8).reshape(3, 2, 4, 5)
    header = {
        "space": "left-posterior-superior",
        "space directions": [[1, 0, 0], [0, 1, 0], [0, 0, 1], [np.nan] * 3],
        "kinds": ["domain"] * 3 + ["list"],
    }
    nrrd.write(str(tmp_path / "v.nrrd"), voxels.T, header)

    assert np.array_equal(read_nrrd(tmp_path / "v.nrrd").voxels, np.moveaxis(voxels, 0, -1))


def test_a_header_may_stand_apart_and_count_in_big_endian(tmp_path: Path):
    """``.nhdr`` with its voxels in a file beside it, as scanners' exporters write."""
    voxels = np.arange(24, dtype=">i2").reshape(2, 3, 4)
    (tmp_path / "v.raw").write_bytes(b"skipped" + voxels.tobytes())
    header = HEADER.format(type="short", sizes="4 3 2", encoding="raw")
    header += "endian: big\nspacings: 0.5 0.5 2\nbyte skip: -1\ndata file: v.raw\n"

    volume = read_nrrd(write_raw(tmp_path / "v.nhdr", header, b""))

    np.testing.assert_array_equal(volume.voxels, voxels)
    assert volume.voxels.dtype.isnative
    assert volume.grid.spacing_mm == (0.5, 0.5, 2)


@pytest.mark.parametrize("name", ["../secret.raw", "/etc/hostname", "LIST", "slice%03d.raw"])
def test_data_files_elsewhere_are_refused(tmp_path: Path, name: str):
    """A header cannot make us read a file outside its folder."""
    header = HEADER.format(type="uint8", sizes="2 2 2", encoding="raw") + f"data file: {name}\n"

    with pytest.raises(FormatError, match="same folder"):
        read_nrrd(write_raw(tmp_path / "v.nhdr", header, b""))


@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_a_terabyte_in_the_header_is_refused_before_memory_is_taken(tmp_path: Path, encoding: str):
    """10^12 voxels in a file of 100 bytes: one sentence, and no memory."""
    header = HEADER.format(type="uint8", sizes="10000 10000 10000", encoding=encoding)
    path = write_raw(tmp_path / "v.nrrd", header, gzip.compress(b"\0" * 1000))

    with pytest.raises(FormatError, match=r"1,000,000,000,000 bytes"):
        read_nrrd(path)

    reading = (
        "from sonosweep.io.nrrd import read_nrrd\nfrom sonosweep.errors import FormatError\n"
        "try:\n    read_nrrd(path)\nexcept FormatError:\n    pass\n"
    )
    assert resident_mb_after(reading, path) < SMALL_MB


def test_a_gzip_bomb_is_not_unpacked(tmp_path: Path):
    """What unpacks to more than the header states is refused after the stated size."""
    header = HEADER.format(type="uint8", sizes="4 4 4", encoding="gzip")
    bomb = gzip.compress(b"\0" * 50_000_000)

    with pytest.raises(FormatError, match="more voxels"):
        read_nrrd(write_raw(tmp_path / "v.nrrd", header, bomb))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("type: uint8", "type: block"), "block"),
        (("encoding: raw", "encoding: bzip2"), "gzip or raw"),
        (("sizes: 2 2 2", "sizes: 2 0 2"), "sizes"),
        (("sizes: 2 2 2", "sizes: 2 2"), "dimension"),
        (("encoding: raw", "encoding: raw\nspace: scanner-xyz"), "scanner-xyz"),
        (("encoding: raw", "encoding: raw\nspacings: 1 0 1"), "spacing must be above 0"),
        (("encoding: raw", "encoding: raw\nline skip: 3"), "line skip 3"),
        (("NRRD0004", "NRRD9999"), "cannot read"),
        (("NRRD0004", "PK"), "cannot read"),
    ],
)
def test_what_is_no_volume_is_explained(tmp_path: Path, change: tuple[str, str], message: str):
    """Each kind of nonsense is named in the sentence that refuses it."""
    header = HEADER.format(type="uint8", sizes="2 2 2", encoding="raw").replace(*change)

    with pytest.raises(FormatError, match=message):
        read_nrrd(write_raw(tmp_path / "v.nrrd", header, bytes(8)))


def test_a_sequence_is_no_volume(tmp_path: Path):
    """Four axes of which none is named as channels are refused: which is time?"""
    header = HEADER.format(type="uint8", sizes="2 2 2 2", encoding="raw")
    header = header.replace("dimension: 3", "dimension: 4") + "kinds: domain domain domain list\n"

    with pytest.raises(FormatError, match="no volume"):
        read_nrrd(write_raw(tmp_path / "v.nrrd", header, bytes(16)))

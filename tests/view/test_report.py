"""The report is one safe file that holds every number it was given."""

import base64
import gzip
import json
import re
from dataclasses import fields, replace
from html.parser import HTMLParser
from importlib.resources import files
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image

from sonosweep.errors import FormatError, ScanError
from sonosweep.metrics import TrajectoryMetrics, TusrecErrors, VolumeMetrics
from sonosweep.scan import Trajectory, Volume, VolumeGrid
from sonosweep.view import (
    Report,
    ReportRun,
    report_page,
    write_overview_picture,
    write_report,
)
from sonosweep.view.metric_table import MEANINGS, format_value, metric_table
from sonosweep.view.svg import MINUS

from .conftest import straight

MAIL_BYTES = 10_000_000
HALF_VALUE = 0.51  # of 8-bit voxels that are rounded to whole numbers


class Page(HTMLParser):
    """What a browser sees: elements with attributes, and the words between them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.within: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        """Note an element."""
        self.elements.append((tag, dict(attributes)))
        self.within.append(tag)

    def handle_endtag(self, tag):
        """Leave an element and what it did not close."""
        if tag in self.within:
            while self.within.pop() != tag:
                pass

    def handle_data(self, data):
        """Note words outside of scripts and styles."""
        if "script" not in self.within and "style" not in self.within:
            self.words.append(data)


def data_of(page: str) -> dict:
    """Return what the page's script reads."""
    found = re.search(r'id="viewer-data">(.*?)</script>', page, re.DOTALL)
    assert found
    return json.loads(found[1])


def test_every_number_is_on_the_page(report):
    """What came in is there: facts, metrics with units, verdict, files, command."""
    words = "".join(Page(report_page(report)).words)

    for expected in (
        "Ball",
        "ball.h5",
        "It drifts by 3.14 mm.",
        "The sweep went forward.",
        "3.142 mm",
        "17.25 %",
        f"{MINUS}0.000123 mm",
        "our own",
        "trajectory.csv",
        "sonosweep demo",
        "sonosweep 0.1.0",
        "Research software, not a medical device",
    ):
        assert expected in words


def test_all_digits_of_a_metric_can_be_copied(report):
    """A rounded number carries its full value."""
    values = [a.get("value") for tag, a in Page(report_page(report)).elements if tag == "data"]

    assert values == ["3.14159", "17.25", "-0.000123"]


def test_the_page_asks_nobody_for_anything(report):
    """No element, style or script of the page names a server; the policy forbids it too."""
    page = report_page(report)

    for tag, attributes in Page(page).elements:
        for name in ("src", "href", "xlink:href", "srcset", "action", "data"):
            value = attributes.get(name) or ""
            assert not re.match(r"\s*(https?:|//|ftp:)", value), (tag, name)
    assert not re.search(r"url\(\s*['\"]?(?!data:)", page)
    assert "@import" not in page
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|importScripts)\s*\(", page)
    assert "default-src 'none'" in page.replace("&#x27;", "'")


HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(1)>\"'&"


def test_hostile_names_are_only_words(report):
    """A scan named like markup is shown by its name and becomes no element."""
    run = replace(
        report.runs[0],
        name=HOSTILE,
        companions={HOSTILE: report.runs[0].volume},
        metrics={HOSTILE: (1.0, HOSTILE)},
        trajectory=replace(
            report.runs[0].trajectory,
            method=HOSTILE,
            assumptions=(HOSTILE,),
            settings={HOSTILE: HOSTILE},
        ),
    )
    hostile = replace(
        report,
        title=HOSTILE,
        facts=((HOSTILE, HOSTILE),),
        verdict=(HOSTILE,),
        outputs=(HOSTILE, "javascript:alert(1)"),
        command=HOSTILE,
        versions={HOSTILE: HOSTILE},
        runs=(run, report.runs[1]),
    )

    page = report_page(hostile)

    seen = Page(page)
    assert page.count("alert(1)</script>") == 0
    assert not any("onerror" in attributes for _, attributes in seen.elements)
    assert not any((a.get("href") or "").startswith("javascript") for _, a in seen.elements)
    assert data_of(page)["runs"][0]["name"] == HOSTILE
    assert sum(HOSTILE in words for words in seen.words) >= 8


def test_pictures_of_the_page_are_well_formed(report):
    """Every drawing is XML on its own."""
    drawings = re.findall(r"<svg.*?</svg>", report_page(report), re.DOTALL)

    assert len(drawings) == 3 + 2 + 2 * 6 + 5 + 3
    for drawing in drawings:
        ElementTree.fromstring(drawing)


def test_the_page_carries_the_volume(report):
    """The voxels behind the interactive view are those of the volume, in its place."""
    page = report_page(report)

    text = re.search(r'id="volume-0">(.*?)</script>', page)
    assert text
    voxels = np.frombuffer(gzip.decompress(base64.b64decode(text[1])), np.uint8)
    volume, described = report.runs[0].volume, data_of(page)["volumes"][0]
    assert (voxels.reshape(volume.voxels.shape) == volume.voxels).all()
    assert described["origin"] == list(volume.grid.origin_mm)
    assert described["size"] == list(volume.grid.size)
    assert described["names"] == ["lateral", "axial", "elevational"]


@pytest.mark.parametrize(
    "voxels",
    [
        np.linspace(-5, 900, 1000).reshape(10, 10, 10),
        np.linspace(0, 1, 1000, dtype=np.float32).reshape(10, 10, 10),
        np.linspace(0, 60_000, 1000).astype(np.uint16).reshape(10, 10, 10),
    ],
)
def test_a_byte_says_what_value_it_stands_for(voxels):
    """Volumes that are no bytes are stretched, and the page can say the true values."""
    volume = Volume(voxels, VolumeGrid((10, 10, 10), (1.0, 1.0, 1.0)))

    page = report_page(Report("a", (), (ReportRun("a", straight(0.5), volume),)))

    text = re.search(r'id="volume-0">(.*?)</script>', page)
    assert text
    described = data_of(page)["volumes"][0]
    shown = np.frombuffer(gzip.decompress(base64.b64decode(text[1])), np.uint8)
    values = described["offset"] + described["scale"] * shown
    assert np.abs(values - voxels.ravel()).max() <= HALF_VALUE * described["scale"]


def test_a_report_can_be_mailed():
    """Even volumes and frames of pure noise, which nothing compresses, stay below 10 MB."""
    noise = np.random.default_rng(0)
    grid = VolumeGrid((160, 160, 160), (0.3, 0.3, 0.3))
    runs = tuple(
        ReportRun(
            name,
            straight(0.5),
            Volume(noise.integers(0, 256, (160, 160, 160), dtype=np.uint8), grid),
        )
        for name in ("tracked", "sensorless")
    )
    frames = noise.integers(0, 256, (20, 300, 400), dtype=np.uint8)

    page = report_page(Report("noise", (), runs, frames=frames, spacing_mm=(0.2, 0.2)))

    assert len(page.encode()) < MAIL_BYTES


def test_missing_parts_are_left_out():
    """A trajectory alone is a report: no table, no volume, no empty heading."""
    alone = Report("alone", (), (ReportRun("estimated", straight(0.5)),))

    words = "".join(Page(report_page(alone)).words)

    for heading in ("Accuracy", "What was assumed", "Files", "In short", "Drift"):
        assert heading not in words
    assert "Trajectory in space" in words
    assert data_of(report_page(alone))["cine"] is None


def test_one_frame_makes_a_report():
    """A scan of a single frame has a page too."""
    still = Trajectory(torch.eye(4, dtype=torch.float64)[None])
    frames = np.zeros((1, 8, 8), np.uint8)

    page = report_page(Report("one", (), (ReportRun("one", still),), frames=frames))

    assert data_of(page)["shown"] == [0]


def test_the_trajectory_states_its_assumptions(report):
    """What an estimator assumed is on the page, once, even if the report forgets it."""
    careful = replace(report.runs[1].trajectory, assumptions=("The scale is a guess.",))
    run = replace(report.runs[1], trajectory=careful)
    both = replace(report, runs=(run, run), assumptions=("The scale is a guess.",))

    words = "".join(Page(report_page(both)).words)

    assert words.count("The scale is a guess.") == 1


def test_no_run_is_no_report():
    """A report about nothing is refused."""
    with pytest.raises(ScanError, match="at least one"):
        Report("none", (), ())


def test_a_report_that_cannot_be_written_leaves_nothing(tmp_path, report):
    """Where there is a folder, no report is written over it."""
    (tmp_path / "report.html").mkdir()

    with pytest.raises(FormatError, match=r"report\.html"):
        write_report(tmp_path / "report.html", report)

    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_the_same_report_is_the_same_file(tmp_path, report):
    """Writing twice gives the same bytes: reports can be compared."""
    write_report(tmp_path / "a.html", report)
    write_report(tmp_path / "b.html", report)

    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_the_overview_is_a_picture_for_a_readme(tmp_path, report):
    """It is 1600 x 700, and neither side is empty."""
    path = tmp_path / "overview.png"

    run = report.runs[0]
    write_overview_picture(path, report.frames, report.spacing_mm, run.trajectory, run.volume)

    pixels = np.asarray(Image.open(path))
    assert pixels.shape == (700, 1600, 3)
    assert pixels[100:600, 50:600].max() > 200
    assert pixels[100:600, 750:1250].max() > 60


def test_every_metric_of_ours_is_explained():
    """A reader of the table is told what each number that we compute says."""
    computed = (
        field.name
        for kind in (TrajectoryMetrics, TusrecErrors, VolumeMetrics)
        for field in fields(kind)
    )

    assert sorted(computed) == sorted(MEANINGS)


def test_the_most_telling_numbers_come_first(report):
    """The table starts with the final drift, whatever the order of the metrics."""
    metrics = {"psnr_db": (20.0, "dB"), "frames": (20, ""), "final_drift_mm": (1.0, "mm")}

    table = metric_table((replace(report.runs[1], metrics=metrics),))

    assert re.findall(r'title="(\w+)"', table) == ["final_drift_mm", "psnr_db", "frames"]


def test_the_script_stays_small():
    """The interactive part is 25 kB at most: it must not outweigh what it shows."""
    assert len((files("sonosweep.view") / "viewer.js").read_bytes()) < 25_000


@pytest.mark.parametrize(
    ("value", "shown"),
    [(12.93456, "12.93"), (1234567, "1\u202f234\u202f567"), (-0.5, f"{MINUS}0.5"), (0.0, "0")],
)
def test_values_have_four_digits(value, shown):
    """More digits than can be meant are not shown; counts are shown in full."""
    assert format_value(value) == shown

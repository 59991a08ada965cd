"""``evaluate``: one trajectory against its scan, or many methods on a data set."""

import csv
import json
import shutil
from pathlib import Path

import pytest

from sonosweep.evaluate import benchmark
from sonosweep.simulate import make_dataset
from tests.simulate.tiny_dataset import tiny_recipe


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A simulated data set: two scans to train on, two for tests."""
    return make_dataset(tiny_recipe(), tmp_path_factory.mktemp("made") / "tiny").folder


@pytest.fixture
def dataset(made, tmp_path, monkeypatch) -> Path:
    """A copy of it, evaluated in this process: another takes seconds to start."""

    def run_jobs(work, jobs, workers, report):
        for job in jobs:
            work(job, report)

    monkeypatch.setattr(benchmark, "run_jobs", run_jobs)
    return Path(shutil.copytree(made, tmp_path / "tiny"))


def test_a_data_set_becomes_a_page_and_a_table(run, dataset, tmp_path):
    """A row per method and scan, results of single scans beside the data set."""
    ran = run("evaluate", "--dataset", "tiny", "--baselines", "quick", "-o", "results/table")

    page = (tmp_path / "results/table.md").read_text()
    with (tmp_path / "results/table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert ran.code == 0, ran.error
    assert ran.out.strip() == page.strip()
    assert "2 of 1 subjects, simulated, truth exact; 6 frames" in page
    assert "mean motion of its 2 training scans" in page
    assert [row["method"] for row in rows] == [
        name
        for name in (
            "no motion",
            "mean motion of the training scans",
            "true mean of each sweep (oracle)",
        )
        for _ in range(2)
    ]
    assert {row["subject"] for row in rows} == {"simulated-900007"}
    assert {row["simulated"] for row in rows} == {"True"}
    assert len(list((tmp_path / "tiny.results").glob("*.json"))) == 6


def test_a_second_run_adds_and_nothing_is_overwritten_unasked(run, dataset, tmp_path):
    """One scan first, then both: the first is not done again."""
    words = ("evaluate", "--dataset", "tiny", "--baselines", "quick", "--cache", "kept", "--json")
    first = json.loads(run(*words, "--scans", "1", "-o", "t").out)
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "kept").iterdir()}

    refused = run(*words, "-o", "t")
    second = json.loads(run(*words, "-o", "t", "--force").out)

    assert refused.code == 1
    assert "add --force" in refused.sentence
    assert (first["scans"], second["scans"]) == (1, 2)
    assert [row for row in second["rows"] if row["scan"] == first["rows"][0]["scan"]] == first[
        "rows"
    ]
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps


def test_options_that_would_do_nothing_are_refused(run, dataset):
    """Nobody shall think that they did."""
    cases = {
        ("--part", "test"): "give --dataset too",
        ("--workers", "2"): "give --dataset too",
        ("a.csv", "b.h5", "--again"): "give --dataset too",
        ("a.csv", "--dataset", "tiny"): "leave out 'a.csv'",
        ("--dataset", "tiny", "--frame-rate-hz", "20"): "leave out such options",
        ("--dataset", "tiny", "--baselines", "none"): "needs a scan and a method",
        ("--dataset", "tiny", "--baselines", "quick", "-o", "t.md"): "a name without suffix",
        ("--dataset", "nowhere"): "cannot be read",
        ("a.csv",): "give an estimated trajectory and the tracked scan",
        (): "give an estimated trajectory and the tracked scan",
    }
    for words, sentence in cases.items():
        ran = run("evaluate", *words)
        assert ran.code == 1, words
        assert sentence in ran.sentence, words

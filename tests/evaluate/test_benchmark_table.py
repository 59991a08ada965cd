"""What the tables of a benchmark say, computed by hand beside them."""

import pytest

from sonosweep.errors import FormatError, ScanError
from sonosweep.evaluate.benchmark_table import benchmark_page, write_page
from sonosweep.evaluate.method_summary import best_plain, difference, method_results
from sonosweep.evaluate.paper_values import PAPER_TABLES
from sonosweep.evaluate.trained import recipe_digest, trained_networks

from ..estimators.tiny_weights import tiny_info, tiny_weights

FACTS = {"command": "`sonosweep evaluate`", "data": "made up"}


def rows_of(method, values, kind="plain", run="", simulated=True, metric="final_drift_mm"):
    """One row per scan of a method, with one metric and what tables say of sweeps."""
    return [
        {
            "method": method,
            "kind": kind,
            "run": run,
            "simulated": simulated,
            "scan": f"s{k}",
            "subject": f"p{k // 2}",
            "frames": 10,
            "path_length_mm": 20.0,
            "date": "2026-01-02",
            "program": "sonosweep 0",
            metric: value,
        }
        for k, value in enumerate(values)
    ]


def test_trainings_are_averaged_scan_by_scan():
    """Two trainings with drifts of 1, 3 and 3, 7 mm: 2 and 5 mm, means of 2 and 5 mm."""
    rows = rows_of("net", (1.0, 3.0), "network", "seed 0")
    rows += rows_of("net", (3.0, 7.0), "network", "seed 1")

    (result,) = method_results(rows)

    assert result.runs == 2
    assert result.values["final_drift_mm"] == (2.0, 5.0)
    assert result.run_means["final_drift_mm"] == (2.0, 5.0)
    interval = result.interval("final_drift_mm")
    assert (interval.mean, interval.low, interval.high) == (3.5, 2.0, 5.0)  # of two scans


def test_differences_are_paired():
    """1 mm better in three scans of four and 1 mm worse in one: -0.5 mm, won 3."""
    first, second = method_results(
        rows_of("a", (1.0, 11.0, 21.0, 33.0)) + rows_of("b", (2.0, 12.0, 22.0, 32.0))
    )

    found = difference(first, second, "final_drift_mm")

    assert found.interval.mean == pytest.approx(-0.5)
    assert found.won == 3
    assert -1 <= found.interval.low < found.interval.high <= 1


def test_a_higher_correlation_wins():
    """Of all metrics, correlations alone are better when they are larger."""
    first, second = method_results(
        rows_of("a", (0.9, 0.8), metric="correlation_cosine")
        + rows_of("b", (0.5, 0.6), metric="correlation_cosine")
    )

    assert difference(first, second, "correlation_cosine").won == 2
    assert difference(second, first, "correlation_cosine").won == 0


def test_a_metric_that_is_missing_for_one_scan_has_no_mean():
    """A mean over fewer scans would look like one over all."""
    rows = rows_of("a", (1.0, None)) + rows_of("b", (1.0, 2.0))

    first, second = method_results(rows)

    assert first.interval("final_drift_mm") is None
    assert difference(first, second, "final_drift_mm") is None


def test_the_best_method_without_a_network_is_no_oracle():
    """An oracle and a network have lower errors here, and neither is taken."""
    results = method_results(
        rows_of("oracle", (1.0, 1.0), "oracle")
        + rows_of("net", (2.0, 2.0), "network")
        + rows_of("good", (3.0, 3.0))
        + rows_of("bad", (4.0, 4.0))
    )

    assert best_plain(results, "final_drift_mm").name == "good"


def test_simulated_and_recorded_scans_are_never_mixed():
    """Nor are methods on different scans, nor a result given twice."""
    with pytest.raises(ScanError, match="do not belong in one table"):
        method_results(rows_of("a", (1.0,)) + rows_of("a", (1.0,), simulated=False))
    with pytest.raises(ScanError, match="'b' has no result for scan 's1'"):
        method_results(rows_of("a", (1.0, 2.0)) + rows_of("b", (1.0,)))
    with pytest.raises(ScanError, match="two results for scan 's0'"):
        method_results(rows_of("a", (1.0,)) * 2)
    with pytest.raises(ScanError, match="no result"):
        method_results([])


def test_the_page_says_what_was_measured(tmp_path):
    """Numbers with intervals, differences to the best and to moglo, spread, and the facts."""
    metric = "accumulated_frame_error_mm"
    rows = rows_of("no motion", (8.0, 8.0, 8.0), metric=metric)
    rows += rows_of("mean", (4.0, 4.0, 4.0), metric=metric)
    rows += rows_of("moglo", (1.0, 1.0, 1.0), "network", "seed 0", metric=metric)
    rows += rows_of("moglo", (3.0, 3.0, 3.0), "network", "seed 1", metric=metric)

    page = benchmark_page(rows, "Table", FACTS, paper="dataset1")
    write_page(page, rows, tmp_path / "t.md", tmp_path / "t.csv")

    assert page.startswith("# Table\n\n- command: `sonosweep evaluate`\n- data: made up\n")
    assert "3 of 2 subjects, simulated, truth exact; 30 frames, mean path 20.0 mm" in page
    assert "2 [2, 2]" in page  # moglo, over trainings and scans
    assert "| 1 to 3" in page  # its trainings
    assert "## Against mean\n" in page
    assert "-2 [-2, -2] (3)" in page  # moglo minus mean, better in all 3
    assert "## Against moglo\n" in page
    assert "not comparable" in page
    assert "12.06" in page
    assert (tmp_path / "t.md").read_text() == page
    assert len((tmp_path / "t.csv").read_text().splitlines()) == 1 + len(rows)


def test_another_method_can_be_the_reference():
    """By name; one that is not there is refused with those that are."""
    rows = rows_of("a", (1.0, 2.0)) + rows_of("b", (3.0, 4.0))

    assert "## Against b\n" in benchmark_page(rows, "Table", FACTS, against="b")
    with pytest.raises(ScanError, match="no method is called 'c'; methods are a, b"):
        benchmark_page(rows, "Table", FACTS, against="c")


def test_the_papers_numbers_never_stand_below_recorded_scans():
    """Nobody shall compare them."""
    rows = rows_of("a", (1.0, 2.0), simulated=False)

    assert "recorded, truth from a tracker" in benchmark_page(rows, "Table", FACTS)
    with pytest.raises(ScanError, match="below those of simulated scans only"):
        benchmark_page(rows, "Table", FACTS, paper="dataset1")


def test_the_papers_full_network_is_the_same_in_three_tables():
    """Both ablations repeat the row of table 1."""
    full = PAPER_TABLES["dataset1"].rows["MoGLo"]

    assert PAPER_TABLES["ablation1"].rows["G, C, M"] == full
    assert PAPER_TABLES["ablation2"].rows["MoGLo (B-mode)"] == full
    assert len(PAPER_TABLES["ablation1"].rows) == 8


def test_weights_that_differ_in_the_seed_share_a_row(tmp_path):
    """Another loss is another row, named by what differs."""
    recipes = (
        "seed = 0\n[loss]\nl1 = 1.0",
        "seed = 1\n[loss]\nl1 = 1.0",
        "seed = 0\n[loss]\nl1 = 0.5",
    )
    files = []
    for k, recipe in enumerate(recipes):
        (tmp_path / str(k)).mkdir()
        files.append(str(tiny_weights(tmp_path / str(k), recipe=recipe)))

    methods = [network.method for network in trained_networks(files)]

    assert [(m.name, m.run) for m in methods] == [
        ("cnn, l1 1.0", "seed 0"),
        ("cnn, l1 1.0", "seed 1"),
        ("cnn, l1 0.5", "seed 0"),
    ]
    assert [n.method.name for n in trained_networks(files[:2])] == ["cnn", "cnn"]
    same, other = (tiny_info(recipe=recipes[k]) for k in (1, 2))
    assert recipe_digest(tiny_info(recipe=recipes[0])) == recipe_digest(same)
    assert recipe_digest(same) != recipe_digest(other)
    page = benchmark_page(rows_of("a", (1.0, 2.0)), "Table", FACTS, trained_networks(files))
    assert "| seed 0, seed 1 |" in page


def test_networks_are_named_by_the_fields_in_which_they_differ(tmp_path):
    """Whether in a table or in a list of tables, and by no other field."""
    files = []
    for k, (pairs, attention) in enumerate(((10, "true"), (20, "false"))):
        (tmp_path / str(k)).mkdir()
        recipe = f"""
        stages = [{{ pairs = {pairs}, window = 2 }}]
        checkpoint_minutes = {k}
        [network]
        name = "cnn"
        options = {{ attention = {attention} }}"""
        files.append(str(tiny_weights(tmp_path / str(k), recipe=recipe)))

    names = [network.method.name for network in trained_networks(files)]

    assert names == ["cnn, pairs 10, attention True", "cnn, pairs 20, attention False"]


def test_rows_can_be_named(tmp_path):
    """One name for the trainings of one recipe, which the page still tells."""
    files = []
    for k, recipe in enumerate(("seed = 0\nl1 = 1", "seed = 1\nl1 = 1", "seed = 0\nl1 = 2")):
        (tmp_path / str(k)).mkdir()
        files.append(str(tiny_weights(tmp_path / str(k), recipe=recipe)))

    found = trained_networks([f"L, M={files[0]}", f"L, M={files[1]}", files[2]])

    assert [network.method.name for network in found] == ["L, M", "L, M", "cnn, l1 2"]
    assert [network.differs for network in found] == ["l1 1", "l1 1", "l1 2"]
    with pytest.raises(ScanError, match="different recipes are called 'L'"):
        trained_networks([f"L={files[0]}", f"L={files[2]}"])
    (tmp_path / "a=b").mkdir()
    inside = str(tiny_weights(tmp_path / "a=b", recipe="seed = 0"))
    assert trained_networks([inside])[0].method.name == "cnn"


def test_weights_given_twice_or_not_there_are_refused(tmp_path):
    """One sentence each."""
    file = str(tiny_weights(tmp_path))
    broken = tmp_path / "other"
    broken.mkdir()

    with pytest.raises(ScanError, match="are of one recipe and seed"):
        trained_networks([file, file])
    with pytest.raises(FormatError, match="the recipe in '"):
        trained_networks([str(tiny_weights(broken, recipe="= ="))])
    with pytest.raises(FormatError, match="nothing"):
        trained_networks(["nothing"])

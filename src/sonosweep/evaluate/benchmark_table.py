"""A benchmark as a page: what was measured, on what, by which command."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from sonosweep.errors import ScanError
from sonosweep.evaluate.benchmark import Row
from sonosweep.evaluate.intervals import Interval
from sonosweep.evaluate.method_summary import (
    MethodResult,
    best_plain,
    difference,
    method_results,
)
from sonosweep.evaluate.paper_values import PaperTable, paper_numbers_table
from sonosweep.evaluate.summary import PAPER_COLUMNS, interval_text
from sonosweep.evaluate.tables import Cell, cell_text, markdown_table, write_csv
from sonosweep.evaluate.trained import TrainedNetwork, recipe_digest
from sonosweep.geometry import MOTION_NAMES
from sonosweep.io.atomic import write_beside

UNMIXED_COLUMNS = {
    "rAE (mm)": "relative_error_mm",
    "rAE (deg)": "relative_error_deg",
    "aAE (mm)": "accumulated_error_mm",
    "aAE (deg)": "accumulated_error_deg",
    "correlation of the movement": "correlation_pearson",
    "path, estimated (mm)": "estimated_path_length_mm",
}
STEP_COLUMNS = {name: f"correlation_{name}" for name in MOTION_NAMES}
RANKED_BY = "accumulated_frame_error_mm"
BEST_PLAIN = ", the method with the lowest aFE of those without a network and without the truth"
USUAL_REFERENCE = "moglo"
READ = (
    "Each cell is the mean over the sweeps and its 95 % bootstrap interval over sweeps, drawn one"
    " by one; sweeps of one subject are not independent, so the intervals are somewhat narrow."
    " `-` means not defined for every sweep."
)


def write_page(page: str, rows: Sequence[Row], text: Path, table: Path) -> None:
    """Write a page to read, and its rows, one per method, training and sweep, as csv.

    Raises:
        FormatError: If a file cannot be written.
    """
    with write_beside(text) as temporary:
        temporary.write_text(page, encoding="utf-8")
    write_csv(rows, table)


def benchmark_page(
    rows: Sequence[Row],
    title: str,
    facts: Mapping[str, str],
    networks: Sequence[TrainedNetwork] = (),
    against: str | None = None,
    paper: PaperTable | None = None,
) -> str:
    """Return a benchmark as Markdown: what was measured, on what, by which command.

    Args:
        rows: Of :func:`sonosweep.evaluate.benchmark.run_benchmark`.
        title: Of the page.
        facts: What stands above the tables, by name: the command, the data set ...
        networks: Those among the methods, for what is known about them.
        against: A method to compare the others with, beside the best one without a network;
            ``"moglo"`` if it is there, when ``None``.
        paper: Which table of the paper stands below, by itself; for simulated scans.

    Raises:
        ScanError: As :func:`sonosweep.evaluate.method_summary.method_results`, or there is no
            method to compare with, or the paper's numbers do not belong below.
    """
    results = method_results(rows)
    parts = [f"# {title}", _facts(rows, facts)]
    if networks:
        parts += ["## Networks", _networks_table(networks)]
    parts += [READ, *_tables(results)]
    plain = best_plain(results, RANKED_BY)
    if plain is not None:
        parts += _differences(results, plain, BEST_PLAIN)
    reference = _named(results, against)
    if reference is not None and reference is not plain:
        parts += _differences(results, reference, "")
    if paper is not None:
        parts += ["## What the paper prints", _paper(rows, paper)]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def results_table(results: Sequence[MethodResult], columns: Mapping[str, str]) -> str:
    """Return a row per method: mean and interval of the metrics of these columns."""
    rows: list[dict[str, Cell]] = []
    for result in results:
        row: dict[str, Cell] = {"method": result.name}
        if any(other.kind == "network" for other in results):
            row["trainings"] = result.runs if result.kind == "network" else None
        for header, metric in columns.items():
            row[header] = interval_text(result.interval(metric))
        rows.append(row)
    return markdown_table(rows)


def _tables(results: Sequence[MethodResult]) -> list[str]:
    parts = [
        "## The paper's metrics",
        "rAE and aAE mix mm and degrees as the paper does; lower is better but for Corr. A"
        " network's numbers are, of each sweep, the mean over its trainings.",
        results_table(results, PAPER_COLUMNS),
        "## Millimetres and degrees apart",
        results_table(results, UNMIXED_COLUMNS),
        "## Correlation of the steps",
        "Pearson's, of each sweep's steps about the centre of the frame, each degree of freedom"
        " by itself; a method that gives every step the same motion has none.",
        results_table(results, STEP_COLUMNS),
    ]
    trained = [result for result in results if result.runs > 1]
    if trained:
        parts += ["## Spread over trainings", "Lowest and highest mean of the trainings."]
        parts.append(_spread(trained))
    return parts


def _facts(rows: Sequence[Row], facts: Mapping[str, str]) -> str:
    """Return what is known about the numbers, one line each."""
    sweeps = {str(row["scan"]): row for row in rows}.values()
    subjects = {row["subject"] for row in sweeps if row["subject"]}
    frames = sum(int(row["frames"] or 0) for row in sweeps)
    length = sum(float(row["path_length_mm"] or 0) for row in sweeps) / len(sweeps)
    kind = "simulated, truth exact" if rows[0]["simulated"] else "recorded, truth from a tracker"
    dates = sorted({str(row["date"]) for row in rows})
    programs = sorted({str(row["program"]) for row in rows})
    known = {
        **facts,
        "sweeps": f"{len(sweeps)} of {len(subjects)} subjects, {kind}; {frames} frames, mean path"
        f" {length:.1f} mm",
        "measured": " to ".join(dict.fromkeys((dates[0], dates[-1]))),
        "program": ", ".join(programs),
    }
    arithmetic = sorted({str(row["arithmetic"]) for row in rows if row.get("arithmetic")})
    if arithmetic:
        known["networks worked in"] = ", ".join(arithmetic)
    return "\n".join(f"- {name}: {text}" for name, text in known.items())


def _networks_table(networks: Sequence[TrainedNetwork]) -> str:
    """Return a row per network: how large it is and how it was trained."""
    rows: dict[str, dict[str, Cell]] = {}
    for network in networks:
        info, name = network.info, network.method.name
        row = rows.setdefault(
            name,
            {
                "network": name,
                "preset": info.preset,
                "parameters": info.parameters,
                "reads": f"{info.input.columns} x {info.input.rows}, {info.input.channels}",
                "window": info.window,
                "recipe": recipe_digest(info),
                **({"differs in": network.differs} if network.differs else {}),
                "data": info.data[:12],
                "trained": info.made,
                "trainings": "",
            },
        )
        run = network.method.run
        row["trainings"] = f"{row['trainings']}, {run}" if row["trainings"] else run
    return markdown_table(list(rows.values()))


def _named(results: Sequence[MethodResult], against: str | None) -> MethodResult | None:
    """Return the method to compare with; ``None`` if none is asked for and none is usual."""
    found = next((r for r in results if r.name == (against or USUAL_REFERENCE)), None)
    if found is None and against is not None:
        known = ", ".join(result.name for result in results)
        raise ScanError(f"no method is called '{against}'; methods are {known}")
    return found


def _paper(rows: Sequence[Row], paper: PaperTable) -> str:
    if not rows[0]["simulated"]:
        raise ScanError("the paper's numbers stand below those of simulated scans only")
    return paper_numbers_table(paper)


def _spread(results: Sequence[MethodResult]) -> str:
    rows: list[dict[str, Cell]] = []
    for result in results:
        row: dict[str, Cell] = {"method": result.name, "trainings": result.runs}
        for header, metric in PAPER_COLUMNS.items():
            means = result.run_means.get(metric)
            ends = None if means is None else f"{cell_text(min(means))} to {cell_text(max(means))}"
            row[header] = ends
        rows.append(row)
    return markdown_table(rows)


def _differences(results: Sequence[MethodResult], reference: MethodResult, what: str) -> list[str]:
    """Return the table of paired differences to one method."""
    rows: list[dict[str, Cell]] = []
    for result in results:
        if result is reference:
            continue
        row: dict[str, Cell] = {"method": result.name}
        for header, metric in PAPER_COLUMNS.items():
            found = difference(result, reference, metric)
            row[header] = None if found is None else _difference_text(found.interval, found.won)
        rows.append(row)
    if not rows:
        return []
    scans = len(reference.scans)
    return [
        f"## Against {reference.name}",
        f"Mean over the sweeps of each method minus {reference.name}{what}, with the 95 %"
        f" interval of the paired bootstrap; in brackets in how many of {scans} sweeps the method"
        " is better.",
        markdown_table(rows),
    ]


def _difference_text(interval: Interval, won: int) -> str:
    return f"{interval_text(interval)} ({won})"

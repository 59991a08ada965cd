"""Rows of a benchmark, by method: the mean over trainings of each scan, and what it says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sonosweep.errors import ScanError
from sonosweep.evaluate.benchmark import Row
from sonosweep.evaluate.intervals import Interval, bootstrap_interval, paired_interval

HIGHER_IS_BETTER = ("correlation",)  # how such a metric's name begins


@dataclass(frozen=True)
class MethodResult:
    """All numbers of one method.

    Attributes:
        name: Of the method.
        kind: ``"plain"``, ``"oracle"`` or ``"network"``.
        runs: How often it was trained; 1 for what is not trained.
        scans: Names, in the order of the values.
        values: Of each metric, one per scan: the mean over the runs. A metric that is not
            defined for every scan is left out.
        run_means: Of each metric, the mean over the scans of each run.
    """

    name: str
    kind: str
    runs: int
    scans: tuple[str, ...]
    values: Mapping[str, tuple[float, ...]]
    run_means: Mapping[str, tuple[float, ...]]

    def interval(self, metric: str) -> Interval | None:
        """Return the mean over the scans and its 95 % bootstrap interval."""
        values = self.values.get(metric)
        return None if values is None else bootstrap_interval(values)


@dataclass(frozen=True)
class Difference:
    """How two methods differ over the same scans.

    Attributes:
        interval: Mean of the first minus the second, with its 95 % bootstrap interval.
        won: In how many scans the first is better.
    """

    interval: Interval
    won: int


def method_results(rows: Sequence[Row]) -> list[MethodResult]:
    """Return the numbers of each method, in the order in which they first appear.

    Raises:
        ScanError: If there is no row, simulated and recorded scans are mixed, or a run lacks
            a scan that another has.
    """
    if not rows:
        raise ScanError("there is no result to put into a table")
    if len({row["simulated"] for row in rows}) > 1:
        raise ScanError("simulated and recorded scans do not belong in one table")
    scans = tuple(dict.fromkeys(str(row["scan"]) for row in rows))
    names = dict.fromkeys(str(row["method"]) for row in rows)
    return [_result(name, scans, [row for row in rows if row["method"] == name]) for name in names]


def difference(first: MethodResult, second: MethodResult, metric: str) -> Difference | None:
    """Return how the first differs from the second; ``None`` if the metric is not defined."""
    a, b = first.values.get(metric), second.values.get(metric)
    if a is None or b is None:
        return None
    sign = 1 if metric.startswith(HIGHER_IS_BETTER) else -1
    won = sum(sign * (x - y) > 0 for x, y in zip(a, b, strict=True))
    return Difference(paired_interval(a, b), won)


def best_plain(results: Sequence[MethodResult], metric: str) -> MethodResult | None:
    """Return the untrained method, no oracle, with the lowest mean of an error."""
    known = [(r.interval(metric), r) for r in results if r.kind == "plain"]
    ranked = [(interval.mean, r) for interval, r in known if interval is not None]
    return min(ranked, key=lambda pair: pair[0])[1] if ranked else None


def _result(name: str, scans: tuple[str, ...], rows: list[Row]) -> MethodResult:
    by_run: dict[str, dict[str, Row]] = {}
    for row in rows:
        run, scan = str(row["run"]), str(row["scan"])
        if scan in by_run.setdefault(run, {}):
            raise ScanError(f"'{name}' has two results for scan '{scan}'")
        by_run[run][scan] = row
    for run, of_scan in by_run.items():
        missing = next((scan for scan in scans if scan not in of_scan), None)
        if missing is not None:
            who = f"{name} {run}".strip()
            raise ScanError(f"'{who}' has no result for scan '{missing}'")
    values, run_means = {}, {}
    for metric in _metrics(rows):
        table = [[of_scan[scan][metric] for scan in scans] for of_scan in by_run.values()]
        numbers = [[float(v) for v in line if v is not None] for line in table]
        if all(len(line) == len(scans) for line in numbers):
            values[metric] = tuple(
                sum(line[k] for line in numbers) / len(numbers) for k in range(len(scans))
            )
            run_means[metric] = tuple(sum(line) / len(line) for line in numbers)
    return MethodResult(name, str(rows[0]["kind"]), len(by_run), scans, values, run_means)


def _metrics(rows: list[Row]) -> list[str]:
    """Return the names of the columns that hold numbers in some row."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [
        name
        for name in names
        if all(_is_number(row.get(name)) for row in rows)
        and any(row.get(name) is not None for row in rows)
    ]


def _is_number(value: object) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))

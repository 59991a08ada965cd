"""The log of a run, as a table and as a page, written as it goes on."""

import csv
import io
import time
from pathlib import Path

from sonosweep.io.atomic import write_beside
from sonosweep.training.page import training_page
from sonosweep.training.recipe import Recipe, recipe_text

LOG, PAGE = "log.csv", "training.html"
Row = dict[str, float]


class RunLog:
    """Rows of numbers against steps, with the CPU time of this process that they took.

    Args:
        folder: Of the run.
        recipe: Of the run.
        first_step: Rows up to this step are kept; later ones are of a run that was stopped
            after its last checkpoint.
    """

    def __init__(self, folder: Path, recipe: Recipe, first_step: int) -> None:
        self._folder, self._recipe = folder, recipe
        rows = read_log(folder / LOG) if first_step else []
        self._rows = [row for row in rows if row["step"] <= first_step]
        before = self._rows[-1].get("cpu_s", 0.0) if self._rows else 0.0
        self._started_s = time.process_time() - before

    def write(self, step: int, pairs: int, numbers: Row) -> None:
        """Add a row, and write table and page."""
        spent = round(time.process_time() - self._started_s, 1)
        self._rows.append({"step": float(step), "pairs": float(pairs), "cpu_s": spent, **numbers})
        names = list(dict.fromkeys(name for row in self._rows for name in row))
        text = io.StringIO()
        table = csv.DictWriter(text, names, lineterminator="\n")
        table.writeheader()
        table.writerows({name: _plain(value) for name, value in row.items()} for row in self._rows)
        page = training_page(self._recipe.network.name, self._rows, recipe_text(self._recipe))
        for name, content in ((LOG, text.getvalue()), (PAGE, page)):
            with write_beside(self._folder / name) as temporary:
                temporary.write_text(content, encoding="utf-8")


def _plain(value: float) -> str:
    return str(int(value)) if value.is_integer() else f"{value:.6g}"


def read_log(path: Path) -> list[Row]:
    """Return the rows of a table that :class:`RunLog` wrote; none if there is no such file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [
            {name: float(value) for name, value in row.items() if value}
            for row in csv.DictReader(file)
        ]

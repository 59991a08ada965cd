"""Progress on standard error: a bar where a person looks, plain lines otherwise."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LINES_PER_TASK = 5
LONGEST_SILENCE_S = 30.0


@contextmanager
def progress(task: str) -> Iterator[Callable[[int, int], None]]:
    """Give a function to call with (done, total) while ``task`` goes on."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            shown = bar.add_task(task, total=None)
            yield lambda done, total: bar.update(shown, completed=done, total=total)
    else:
        yield _lines(task)


def _lines(task: str) -> Callable[[int, int], None]:
    said, when = -1, time.monotonic()

    def show(done: int, total: int) -> None:
        nonlocal said, when
        part = LINES_PER_TASK * done // max(total, 1)
        if part > said or time.monotonic() - when > LONGEST_SILENCE_S:
            said, when = part, time.monotonic()
            print(f"{task}: {done} of {total}", file=sys.stderr, flush=True)

    return show

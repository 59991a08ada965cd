"""Jobs in processes of their own, which end with their parent and leave nothing behind.

A worker has one thread, so that its results do not depend on how many workers there are.
"""

import multiprocessing
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from sonosweep.errors import ScanError, SonosweepError

Report = Callable[[int], None]
Work = Callable[[Any, Report], None]  # Any: whatever can be pickled

ONE_THREAD = {
    name: "1"
    for name in (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMBA_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    )
}
PATIENCE_S = 10.0  # for a worker to clean up


def run_jobs(work: Work, jobs: Sequence[Any], workers: int, report: Report) -> None:
    """Do all jobs, several at a time, each in one of the worker processes.

    Args:
        work: A function of a module; gets a job and a function to call with the amount of
            work done since the last call.
        jobs: What it is called with; they are begun in this order.
        workers: How many processes; 1 or more.
        report: Called here with the amounts that the workers report.

    Raises:
        SonosweepError: What a job raised; the other workers are stopped.
    """
    context = multiprocessing.get_context("spawn")
    processes: dict[Connection, BaseProcess] = {}
    waiting = deque(jobs)
    try:
        with _one_thread():
            for _ in range(min(workers, len(jobs))):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(work, theirs), daemon=True)
                process.start()
                theirs.close()
                processes[ours] = process
        for connection in processes:
            connection.send(waiting.popleft())
        _attend(processes, waiting, report)
        for connection, worker in processes.items():
            connection.close()  # which tells the worker that there is no more
            worker.join(PATIENCE_S)
    finally:
        _stop(processes)


def _attend(processes: dict[Connection, BaseProcess], waiting: deque[Any], report: Report) -> None:
    """Listen to the workers and hand out jobs until all are done."""
    busy = set(processes)
    while busy:
        for connection in wait(list(busy)):
            assert isinstance(connection, Connection)
            message = _receive(connection, processes[connection])
            if isinstance(message, Exception):
                raise message
            if message is not None:
                report(message)
            elif waiting:
                connection.send(waiting.popleft())
            else:
                busy.remove(connection)


def _receive(connection: Connection, process: BaseProcess) -> Any:
    try:
        return connection.recv()
    except (EOFError, OSError) as error:
        process.join(PATIENCE_S)
        raise ScanError(
            f"a worker process ended with code {process.exitcode} before its work was done: if"
            " memory ran out, take fewer workers; a script that starts workers needs"
            " 'if __name__ == \"__main__\":'"
        ) from error


def _stop(processes: dict[Connection, BaseProcess]) -> None:
    """End all workers that have not ended."""
    for connection, process in processes.items():
        connection.close()
        process.terminate()
    for process in processes.values():
        process.join(PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let processes that are started meanwhile use one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(work: Work, connection: Connection) -> None:
    """Do jobs until the parent has no more or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    signal.signal(signal.SIGTERM, _leave)
    try:
        while True:
            job = connection.recv()
            _do(work, job, connection)
    except (EOFError, OSError):
        return  # the parent has closed its end
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _do(work: Work, job: Any, connection: Connection) -> None:
    try:
        work(job, connection.send)
    except SonosweepError as error:
        connection.send(error)
    else:
        connection.send(None)


def _leave(number: int, _: object) -> None:
    """End by an exception, so that temporary files are removed."""
    sys.exit(128 + number)

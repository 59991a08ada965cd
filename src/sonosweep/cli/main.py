"""The command line's way in, and what Ctrl-C does from the first moment on."""

import _thread
import signal
import sys
import threading
from collections.abc import Sequence
from types import FrameType

INTERRUPTED = 130  # 128 + SIGINT, what a shell expects after Ctrl-C
RETRY_S = 0.02
IMPORT_MACHINERY = "<frozen importlib"

VERBS = {
    "demo": "Reconstruct the real sweep that comes with the package, and write a report.",
    "reconstruct": "Turn sweeps into trajectories, volumes and a report.",
    "estimate": "Turn a sweep into a trajectory only.",
    "calibrate": "Measure how fast a probe's speckle decorrelates, once per probe and preset.",
    "evaluate": "Say how far an estimated trajectory is from the tracked one.",
    "info": "Say what a file holds, and what is missing.",
    "beamform": "Turn channel data into B-mode, power Doppler and photoacoustic frames.",
    "train": "Train a motion network from a recipe.",
    "simulate": "Make a sweep with exact truth, or a whole data set.",
    "convert": "Make a sequence from images, video, DICOM, .mat or HDF5 and poses, or back.",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code: 0, 1, or 130 after Ctrl-C."""
    try:
        if arguments is None and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)
            sys.unraisablehook = _not_raised
        from sonosweep.cli.app import run

        run(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        if sys.unraisablehook is _not_raised:  # the program ends here
            sys.unraisablehook = _ignored
        leave("interrupted; no output was left half-written", INTERRUPTED)


def leave(message: str, code: int = 1) -> None:
    """Say one sentence on standard error and end the program."""
    one_line = " ".join(message.split())
    print(f"sonosweep: {one_line}", file=sys.stderr)
    sys.exit(code)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but not while a module is being imported.

    NumPy turns an interrupted import into endless recursion and PyTorch aborts, so what
    comes in the meantime is asked again a little later.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith(IMPORT_MACHINERY):
            _ask_again()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _not_raised(lost: "sys.UnraisableHookArgs") -> None:
    """Ask again if Ctrl-C came in a destructor or weak reference's callback, which drop it."""
    if lost.exc_type is KeyboardInterrupt:
        _ask_again()
    else:
        sys.__unraisablehook__(lost)


def _ignored(lost: "sys.UnraisableHookArgs") -> None:
    """Say nothing: objects that Ctrl-C left half-made fail in their destructors."""


def _ask_again() -> None:
    retry = threading.Timer(RETRY_S, _interrupt_main_thread)
    retry.daemon = True  # does not hold up an end that comes first
    retry.start()


def _interrupt_main_thread() -> None:
    if hasattr(signal, "pthread_kill"):  # which also ends a wait, unlike the other
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()

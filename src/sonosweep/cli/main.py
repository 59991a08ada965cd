"""The command line: names of the verbs, and how anything that goes wrong is said.

Nothing heavy is imported here: a verb's module is loaded when the verb is used.
"""

import sys
from collections.abc import Sequence

from cyclopts import App, CycloptsError

from sonosweep import __version__
from sonosweep.errors import SonosweepError

INTERRUPTED = 130  # 128 + SIGINT, what a shell expects after Ctrl-C

VERBS = {
    "demo": "Reconstruct the real sweep that comes with the package, and write a report.",
    "reconstruct": "Turn sweeps into trajectories, volumes and a report.",
    "estimate": "Turn a sweep into a trajectory only.",
    "calibrate": "Measure how fast a probe's speckle decorrelates, once per probe and preset.",
    "evaluate": "Say how far an estimated trajectory is from the tracked one.",
    "info": "Say what a file holds, and what is missing.",
    "convert": "Make a sequence from images, video, DICOM, .mat or HDF5 and poses, or back.",
}

app = App(
    name="sonosweep",
    help="3D ultrasound from a freehand sweep without a position sensor."
    " Research software, not a medical device.",
    version=__version__,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
)
for verb, summary in VERBS.items():
    app.command(f"sonosweep.cli.{verb}:{verb}", name=verb, help=summary)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit code: 0, 1, or 130 after Ctrl-C."""
    try:
        app(
            list(sys.argv[1:] if arguments is None else arguments),
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except (SonosweepError, CycloptsError) as error:
        _leave(str(error))
    except MemoryError:
        _leave("out of memory: use larger voxels (--voxel-mm) or fewer frames")
    except OSError as error:
        where = f" '{error.filename}'" if error.filename else ""
        _leave(f"{error.strerror or error}{where}")
    except KeyboardInterrupt:
        _leave("interrupted; no output was left half-written", INTERRUPTED)


def _leave(message: str, code: int = 1) -> None:
    one_line = " ".join(message.split())
    print(f"sonosweep: {one_line}", file=sys.stderr)
    sys.exit(code)

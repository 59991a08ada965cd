"""The verbs, and how anything that goes wrong in them is said.

Nothing heavy is imported here: a verb's module is loaded when the verb is used.
"""

import io
import sys
from collections.abc import Sequence

from cyclopts import App, CycloptsError

from sonosweep import __version__
from sonosweep.cli.main import VERBS, leave
from sonosweep.errors import SonosweepError

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


def run(arguments: Sequence[str]) -> None:
    """Run the command line; leave with exit code 1 and one sentence if something is wrong."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A name that the terminal cannot show is no reason to fail after the work is done.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        app(
            list(arguments),
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except (SonosweepError, CycloptsError) as error:
        leave(str(error))
    except MemoryError:
        leave("out of memory: use larger voxels (--voxel-mm) or fewer frames")
    except OSError as error:
        where = f" '{error.filename}'" if error.filename else ""
        leave(f"{error.strerror or error}{where}")

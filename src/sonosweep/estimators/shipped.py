"""Weights that come with the package, by name."""

from importlib.resources import files
from pathlib import Path

from sonosweep.errors import FormatError

SUFFIX = ".safetensors"
RUN_FILE = f"weights{SUFFIX}"  # of a folder that a training run wrote


def shipped_weights() -> dict[str, Path]:
    """Return the files of the weights that come with the package, by name."""
    folder = Path(str(files("sonosweep") / "weights"))
    return {path.stem: path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def find_weights(name: str) -> Path:
    """Return the file of weights that a name or a path stands for.

    Args:
        name: Of shipped weights; or a ``.safetensors`` file, or the folder of a training run.

    Raises:
        FormatError: If it stands for none.
    """
    shipped = shipped_weights()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.is_dir():
        found = path / RUN_FILE
        if not found.is_file():
            raise FormatError(f"folder '{name}' holds no '{RUN_FILE}': has the run ended?")
        return found
    if path.suffix == SUFFIX:
        if not path.is_file():
            raise FormatError(f"there is no '{name}'")
        return path
    known = ", ".join(("decorrelation", *shipped))
    raise FormatError(
        f"no estimator is called '{name}'; give {known}, a {SUFFIX} file or the folder of a"
        " training run"
    )

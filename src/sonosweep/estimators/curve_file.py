"""A decorrelation curve as a small TOML file, one per probe and preset."""

import json
import os
import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from sonosweep.errors import RecipeError, ScanError
from sonosweep.estimators.decorrelation_curve import CurveSource, DecorrelationCurve
from sonosweep.io.atomic import write_beside

LARGEST_BYTES = 1_000_000
"""A curve file is a page long; what is larger is something else."""

HEADER = """\
# Decorrelation curve for sonosweep: correlation = peak * exp(-(distance / width) ^ exponent).
# Made by "sonosweep calibrate"; holds for one probe, one preset and similar sweep speeds.
"""


class _CurveFile(BaseModel):
    """What a curve file holds, and nothing else."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    format: Literal["sonosweep decorrelation curve"]
    version: Literal[1]
    preset: str
    source: CurveSource
    depth_mm: tuple[float, ...]
    width_mm: tuple[float, ...]
    exponent: float
    peak: float
    fineness_per_mm2: tuple[float, ...] = ()
    coherence: float
    dynamic_range_db: float
    quality: dict[str, float] = {}


def write_curve(curve: DecorrelationCurve, path: str | os.PathLike) -> None:
    """Write a curve for :func:`read_curve`, and for people.

    Raises:
        FormatError: If the file cannot be written.
    """
    fields = {"format": "sonosweep decorrelation curve", "version": 1, **asdict(curve)}
    quality = fields.pop("quality")
    lines = [f"{name} = {_toml(value)}" for name, value in fields.items()]
    lines += ["", "[quality]", *(f"{_toml(k)} = {_toml(v)}" for k, v in quality.items())]
    with write_beside(path) as temporary:
        temporary.write_text(HEADER + "\n".join(lines) + "\n", encoding="utf-8")


def read_curve(path: str | os.PathLike) -> DecorrelationCurve:
    """Return the curve of a file.

    Raises:
        RecipeError: If there is no such file, or it holds something it must not; the message
            names the field.
    """
    try:
        if Path(path).stat().st_size > LARGEST_BYTES:
            raise RecipeError(f"'{path}' is too large to be a decorrelation curve")
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        file = _CurveFile.model_validate(content)
        return DecorrelationCurve(**file.model_dump(exclude={"format", "version"}))
    except OSError as error:
        raise RecipeError(f"cannot read '{path}': {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RecipeError(
            f"'{path}' is no decorrelation curve (TOML): {error}; make one with"
            " 'sonosweep calibrate'"
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RecipeError(f"{field} in '{path}': {first['msg'].lower()}") from error
    except ScanError as error:
        raise RecipeError(f"{error}, in '{path}'") from error


def _toml(value: str | int | float | tuple[float, ...]) -> str:
    """Return a value as TOML writes it."""
    if isinstance(value, str):
        # JSON strings are TOML strings but for DEL, which TOML wants escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(number) for number in value) + "]"
    return repr(value)

"""All that defines a training run, as a TOML file that people can read.

The same recipe gives the same weights on the same machine. Every field has a default but
the network's name and the data.
"""

import json
import os
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sonosweep.errors import RecipeError
from sonosweep.estimators.network_input import InputSettings
from sonosweep.estimators.weights import Options
from sonosweep.training.augment import AugmentSettings
from sonosweep.training.losses import LossSettings

LARGEST_BYTES = 1_000_000


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Stride = Annotated[int, Field(ge=1)]
Decay = Annotated[float, Field(ge=0, lt=1)]


class NetworkRecipe(_Part):
    """Which network.

    Attributes:
        name: Such as ``"moglo"``.
        preset: Of its options.
        options: Those that differ from the preset's.
    """

    name: str
    preset: str = "compact"
    options: Options = {}


class SimulatedData(_Part):
    """Scans of a data set of the simulator, made while training goes on.

    Attributes:
        dataset: Whose plans are carried out, with frames of the size that the network reads;
            each seed of the data set has other subjects.
        size: As there.
        first_seed: Of the data set; the next ones follow when its scans are used up.
        scans: How many are in memory at a time.
        epochs_per_scan: Rounds over them after which the oldest gives way to a new one; 0
            keeps the first ones.
        validation_scans: Kept for validation, of subjects that are not trained on.
    """

    dataset: Literal["dataset1", "dataset2", "dataset3"] = "dataset1"
    size: Literal["small", "full", "varied"] = "small"
    first_seed: int = Field(default=1, ge=0, le=99)
    scans: int = Field(default=24, ge=1, le=1000)
    epochs_per_scan: int = Field(default=1, ge=0)
    validation_scans: int = Field(default=3, ge=1)


class DataRecipe(_Part):
    """What to learn from: one of a folder, lists of files, or the simulator.

    Attributes:
        folder: A data set that ``sonosweep simulate --dataset`` made, with its split.
        train: Scans to learn from, in any format that we read.
        validation: Scans to measure progress on, of other subjects.
        simulated: Sweeps made on the way.
        cache_gb: Frames up to this size are read once and kept in memory.
    """

    folder: str | None = None
    train: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    simulated: SimulatedData | None = None
    cache_gb: float = Field(default=4.0, ge=0)

    @model_validator(mode="after")
    def _one_source(self) -> "DataRecipe":
        given = (self.folder is not None, bool(self.train), self.simulated is not None)
        if sum(given) != 1:
            raise ValueError("give one of folder, train and simulated")
        if bool(self.train) != bool(self.validation):
            raise ValueError("train and validation go together")
        return self


class Stage(_Part):
    """A part of the training, with its own windows and learning rate.

    Attributes:
        pairs: How many pairs of neighboring frames to learn from, over all windows; the
            same number is the same budget for every network.
        window: Frames in a window.
        batch: Windows in a step, on all devices together.
        learning_rate: At its highest.
        strides: Distances between the frames of a window, drawn for each.
        warm_up: Share of the stage in which the learning rate rises from 0.
        last: Share of the learning rate that is left at the end; it falls as a cosine.
    """

    pairs: int = Field(ge=1)
    window: int = Field(default=2, ge=2)
    batch: int = Field(default=32, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)
    strides: tuple[Stride, ...] = Field(default=(1,), min_length=1)
    warm_up: float = Field(default=0.06, ge=0, lt=1)
    last: float = Field(default=0.0, ge=0, le=1)

    @property
    def steps(self) -> int:
        """How many times the weights are changed."""
        return -(-self.pairs // (self.batch * (self.window - 1)))


class OptimizerRecipe(_Part):
    """AdamW.

    Attributes:
        weight_decay: Per step and learning rate.
        clip: Largest norm of the gradient.
        betas: Decay of the means of the gradient and its square.
    """

    weight_decay: float = Field(default=1e-2, ge=0)
    clip: float = Field(default=1.0, gt=0)
    betas: tuple[Decay, Decay] = (0.9, 0.999)


class Recipe(_Part):
    """A training run.

    Attributes:
        network: Which network.
        input: What it reads of a scan.
        data: What to learn from.
        stages: One after the other.
        loss: What is made small.
        augment: How windows are changed.
        optimizer: How weights are changed.
        scale: How the scale of each of the six numbers is found: as the 98th percentile of
            their size, as the released code, or their standard deviation.
        precision: ``"bf16"`` multiplies in 16 bits.
        seed: Of all that is random.
        checkpoint_minutes: Between two checkpoints.
        validations: How many times progress is measured, evenly spread.
    """

    network: NetworkRecipe
    input: InputSettings = InputSettings()
    data: DataRecipe
    stages: tuple[Stage, ...] = Field(default=(Stage(pairs=100_000),), min_length=1)
    loss: LossSettings = LossSettings(l1=1.0)
    augment: AugmentSettings = AugmentSettings()
    optimizer: OptimizerRecipe = OptimizerRecipe()
    scale: Literal["percentile", "deviation"] = "percentile"
    precision: Literal["bf16", "fp32"] = "bf16"
    seed: int = Field(default=0, ge=0)
    checkpoint_minutes: float = Field(default=3.0, gt=0)
    validations: int = Field(default=10, ge=1)

    @property
    def steps(self) -> int:
        """How many times the weights are changed in all."""
        return sum(stage.steps for stage in self.stages)


def read_recipe(path: str | os.PathLike, changes: Sequence[str] = ()) -> Recipe:
    """Return the recipe of a file.

    Args:
        path: A TOML file.
        changes: Fields to set instead, such as ``"network.name=cnn"``; numbers in brackets
            choose of a list: ``"stages[0].batch=16"``.

    Raises:
        RecipeError: If there is no such file, or it holds something it must not; the message
            names the field.
    """
    try:
        if Path(path).stat().st_size > LARGEST_BYTES:
            raise RecipeError(f"'{path}' is too large to be a recipe")
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise RecipeError(f"cannot read '{path}': {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RecipeError(f"'{path}' is no recipe (TOML): {error}") from error
    for change in changes:
        _change(content, change)
    return _validated(content, str(path))


def recipe_from_text(text: str) -> Recipe:
    """Return the recipe that :func:`recipe_text` wrote.

    Raises:
        RecipeError: If the text is none.
    """
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"no recipe (TOML): {error}") from error
    return _validated(content, "the recipe")


def recipe_text(recipe: Recipe) -> str:
    """Return a recipe as TOML, with every field."""
    content = recipe.model_dump(mode="json", exclude_none=True)
    lines = [f"{name} = {_toml(v)}" for name, v in content.items() if not isinstance(v, dict)]
    for name, value in content.items():
        if isinstance(value, dict):
            lines += ["", f"[{name}]", *(f"{key} = {_toml(v)}" for key, v in value.items())]
    return "\n".join(lines) + "\n"


def _validated(content: dict[str, Any], where: str) -> Recipe:
    try:
        return Recipe.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"]) or "the recipe"
        if first["type"] == "extra_forbidden":
            raise RecipeError(f"unknown field '{field}' in '{where}'") from error
        raise RecipeError(f"{field} in '{where}': {first['msg']}") from error


def _change(content: dict[str, Any], change: str) -> None:
    """Set one field of a recipe that is not yet checked."""
    path, equals, text = change.partition("=")
    keys = path.strip().replace("[", ".").replace("]", "").split(".")
    if not equals or not all(keys):
        raise RecipeError(f"'{change}' sets nothing: write FIELD=VALUE, such as seed=1")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    place: Any = content
    try:
        for key in keys[:-1]:
            place = place[int(key)] if isinstance(place, list) else place.setdefault(key, {})
        if isinstance(place, list):
            place[int(keys[-1])] = value
        else:
            place[keys[-1]] = value
    except (ValueError, IndexError, TypeError, AttributeError) as error:
        raise RecipeError(f"'{change}': there is no field '{path.strip()}' to set") from error


def _toml(value: Any) -> str:
    """Return a value as TOML writes it in one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, str):
        # JSON strings are TOML strings but for DEL, which TOML wants escaped.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value)


def _key(name: str) -> str:
    return name if name.isidentifier() and name.isascii() else _toml(name)

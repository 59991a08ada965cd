"""Which motion network a name stands for, and how one is made of a name and options.

Recipes and weights name networks; everything else passes them.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any

from pydantic import TypeAdapter, ValidationError

from sonosweep.errors import RecipeError
from sonosweep.estimators.cnn import CNN, CNNOptions
from sonosweep.estimators.cnn import COMPACT as CNN_COMPACT
from sonosweep.estimators.cnn import PAPER as CNN_PAPER
from sonosweep.estimators.dc2 import COMPACT as DC2_COMPACT
from sonosweep.estimators.dc2 import DC2, DC2Options
from sonosweep.estimators.dc2 import PAPER as DC2_PAPER
from sonosweep.estimators.dcl import COMPACT as DCL_COMPACT
from sonosweep.estimators.dcl import DCL, DCLOptions
from sonosweep.estimators.dcl import PAPER as DCL_PAPER
from sonosweep.estimators.efficient import COMPACT as EFFICIENT_COMPACT
from sonosweep.estimators.efficient import PAPER as EFFICIENT_PAPER
from sonosweep.estimators.efficient import Efficient, EfficientOptions
from sonosweep.estimators.lstm import COMPACT as LSTM_COMPACT
from sonosweep.estimators.lstm import LSTM, LSTMOptions
from sonosweep.estimators.lstm import PAPER as LSTM_PAPER
from sonosweep.estimators.moglo import COMPACT as MOGLO_COMPACT
from sonosweep.estimators.moglo import PAPER as MOGLO_PAPER
from sonosweep.estimators.moglo import RELEASED_CODE as MOGLO_RELEASED_CODE
from sonosweep.estimators.moglo import MoGLo, MoGLoOptions
from sonosweep.estimators.network import FrameShape, MotionNetwork


@dataclass(frozen=True)
class NetworkKind:
    """One of the networks.

    Attributes:
        network: Makes one, of the shape of the frames and options.
        options: The dataclass of its options.
        presets: Options by name: ``"paper"`` is the size of the article, ``"compact"`` one
            that trains on a CPU.
        source: The article, in short.
    """

    network: Callable[[FrameShape, Any], MotionNetwork]  # each has options of its own
    options: type
    presets: Mapping[str, Any]
    source: str


NETWORKS: dict[str, NetworkKind] = {
    "cnn": NetworkKind(
        CNN, CNNOptions, {"paper": CNN_PAPER, "compact": CNN_COMPACT}, "Prevost et al. 2018"
    ),
    "dcl": NetworkKind(
        DCL, DCLOptions, {"paper": DCL_PAPER, "compact": DCL_COMPACT}, "Guo et al. 2020"
    ),
    "dc2": NetworkKind(
        DC2, DC2Options, {"paper": DC2_PAPER, "compact": DC2_COMPACT}, "Guo et al. 2022"
    ),
    "efficient": NetworkKind(
        Efficient,
        EfficientOptions,
        {"paper": EFFICIENT_PAPER, "compact": EFFICIENT_COMPACT},
        "Li et al. 2023",
    ),
    "lstm": NetworkKind(
        LSTM, LSTMOptions, {"paper": LSTM_PAPER, "compact": LSTM_COMPACT}, "Luo et al. 2023"
    ),
    "moglo": NetworkKind(
        MoGLo,
        MoGLoOptions,
        {
            "paper": MOGLO_PAPER,
            "released-code": MOGLO_RELEASED_CODE,
            "full": MoGLoOptions(),
            "compact": MOGLO_COMPACT,
        },
        "Lee et al. 2025",
    ),
}


def build_network(
    name: str,
    options: Mapping[str, Any] | None = None,  # whatever a recipe holds
    shape: FrameShape | None = None,
    preset: str = "compact",
) -> MotionNetwork:
    """Return a network with new weights, drawn from torch's generator.

    Args:
        name: A key of :data:`NETWORKS`.
        options: What differs from the preset, by name; tables for options in groups.
        shape: Of the frames it will read.
        preset: Size to begin with.

    Raises:
        RecipeError: If there is no network, preset or option of that name, or an option has
            a value it cannot have.
        ScanError: If the network cannot read frames of that shape.
    """
    kind = network_kind(name)
    if preset not in kind.presets:
        known = ", ".join(kind.presets)
        raise RecipeError(f"network '{name}' has no preset '{preset}'; presets are {known}")
    return kind.network(
        shape or FrameShape(), network_options(name, options or {}, kind.presets[preset])
    )


def network_kind(name: str) -> NetworkKind:
    """Return what a name stands for.

    Raises:
        RecipeError: If it stands for nothing.
    """
    if name not in NETWORKS:
        raise RecipeError(f"no network is called '{name}'; networks are {', '.join(NETWORKS)}")
    return NETWORKS[name]


def network_options(name: str, changes: Mapping[str, Any], preset: Any) -> Any:
    """Return a preset's options with some changed.

    Args:
        name: Of the network, for the message.
        changes: New values by name.
        preset: Options of that network.

    Raises:
        RecipeError: If an option is unknown or its value impossible.
    """
    values = _changed(f"network '{name}'", preset, changes)
    try:
        return TypeAdapter(type(preset)).validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise RecipeError(
            f"option {where} of network '{name}' cannot be {first['input']!r}: {first['msg']}"
        ) from error


def _changed(what: str, options: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as a dictionary with some changed, in groups as deep as they go."""
    values = asdict(options)
    known = {field.name for field in fields(options)}
    for key, value in changes.items():
        if key not in known:
            raise RecipeError(f"{what} has no option '{key}'; options are {', '.join(values)}")
        group = getattr(options, key)
        nested = is_dataclass(group) and isinstance(value, Mapping)
        values[key] = _changed(f"{key} of {what}", group, value) if nested else value
    return values

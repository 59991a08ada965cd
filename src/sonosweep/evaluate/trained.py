"""Trained networks as methods: what they are called, and which are trainings of the same."""

import hashlib
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sonosweep.errors import FormatError, ScanError
from sonosweep.estimators.shipped import find_weights
from sonosweep.estimators.weights import WeightsInfo, read_weights_info
from sonosweep.evaluate.methods import Network

NOT_THE_RESULT = ("seed", "checkpoint_minutes", "validations", "data.cache_gb")
"""Fields of a recipe in which two trainings of the same may differ."""


@dataclass(frozen=True)
class TrainedNetwork:
    """A network of a table and where it comes from.

    Attributes:
        method: Of the benchmark.
        info: What its file says about it.
        differs: Fields of its recipe, with values, that others of this network have otherwise.
    """

    method: Network
    info: WeightsInfo
    differs: str = ""


def trained_networks(weights: Sequence[str], direction: int = 1) -> list[TrainedNetwork]:
    """Return the networks of these weights, with names that tell them apart.

    Weights whose recipes differ in nothing but the seed are trainings of one network and
    share a name: the given one, or that of the network, followed by the fields of the recipe
    in which it differs from the others of that network.

    Args:
        weights: Names of shipped weights, files, or folders of training runs; each with a
            name for the table before it if one is wanted, as in ``G, C=runs/ablation1/GC``.
        direction: -1 if the probe sweeps the other way than it did in training.

    Raises:
        FormatError: If there are no such weights, or they are damaged.
        ScanError: If two are of the same recipe and seed, or of one name and two recipes.
    """
    given = [_given_name(text) for text in weights]
    files = [find_weights(text) for _, text in given]
    infos = [read_weights_info(file) for file in files]
    recipes = [_recipe(file, info) for file, info in zip(files, infos, strict=True)]
    found: dict[tuple[str, str], TrainedNetwork] = {}
    meant: dict[str, str] = {}
    for (own, _), file, info, recipe in zip(given, files, infos, recipes, strict=True):
        rivals = [r for i, r in zip(infos, recipes, strict=True) if i.network == info.network]
        differs = _differing(recipe, rivals)
        name = own or ", ".join((info.network, *differs))
        if meant.setdefault(name, recipe_digest(info)) != recipe_digest(info):
            raise ScanError(f"weights of different recipes are called '{name}': name them apart")
        key = (name, f"seed {recipe.get('seed', '?')}")
        if key in found:
            other = found[key].method.weights
            raise ScanError(f"'{file}' and '{other}' are of one recipe and seed: give one of them")
        method = Network(name, file, key[1], direction)
        found[key] = TrainedNetwork(method, info, ", ".join(differs))
    return list(found.values())


def _given_name(text: str) -> tuple[str, str]:
    """Return the name before weights, or none, and the weights."""
    name, sign, weights = text.partition("=")
    return (name.strip(), weights) if sign and not Path(text).exists() else ("", text)


def recipe_digest(info: WeightsInfo) -> str:
    """Return a short text that is the same for trainings that differ in the seed alone."""
    fields = _flat(tomllib.loads(info.recipe))
    facts = sorted((key, value) for key, value in fields.items() if key not in NOT_THE_RESULT)
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:12]


def _recipe(file: Path, info: WeightsInfo) -> dict[str, str]:
    try:
        return _flat(tomllib.loads(info.recipe))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(f"the recipe in '{file}' cannot be read") from error


def _differing(recipe: dict[str, str], rivals: list[dict[str, str]]) -> list[str]:
    """Return the fields, with values, in which a recipe differs from some of the others."""
    keys = dict.fromkeys(key for other in rivals for key in other)
    return [
        f"{key.rpartition('.')[2]} {recipe.get(key, 'as usual')}"
        for key in keys
        if key not in NOT_THE_RESULT and len({other.get(key) for other in rivals}) > 1
    ]


def _flat(fields: dict[str, Any], before: str = "") -> dict[str, str]:
    """Return the fields of tables in tables, and in lists of them, by their dotted names."""
    found: dict[str, str] = {}
    for key, value in fields.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{before}{key}.")
        elif isinstance(value, list) and value and all(isinstance(part, dict) for part in value):
            for place, part in enumerate(value):
                found |= _flat(part, f"{before}{key}[{place}].")
        else:
            found[before + key] = str(value)
    return found

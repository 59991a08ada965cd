"""Recipes: what is refused, and that they come back as they were written."""

from pathlib import Path

import pytest

from sonosweep.errors import RecipeError
from sonosweep.training.recipe import Recipe, Stage, read_recipe, recipe_from_text, recipe_text

RECIPES = sorted((Path(__file__).parents[2] / "recipes").glob("*.toml"))
SMALLEST = '[network]\nname = "moglo"\n[data]\nfolder = "scans"\n'


def recipe_file(folder: Path, text: str = SMALLEST) -> Path:
    """Write a recipe."""
    path = folder / "recipe.toml"
    path.write_text(text)
    return path


def test_a_network_and_data_are_enough(tmp_path):
    """All other fields have a default."""
    recipe = read_recipe(recipe_file(tmp_path))

    assert recipe.network.name == "moglo"
    assert recipe.loss.l1 == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SMALLEST + "[input]\nrow = 3\n", "unknown field 'input.row'"),
        ("chanels = 3\n" + SMALLEST, "unknown field 'chanels'"),
        ("seed = -1\n" + SMALLEST, "seed in .*greater than or equal to 0"),
        ("seed = \n" + SMALLEST, "is no recipe"),
        ('[network]\nname = "moglo"\n', "data in .*required"),
        ('[network]\nname = "moglo"\n[data]\n', "give one of folder, train and simulated"),
        ('[network]\nname = "moglo"\n[data]\ntrain = ["a"]\n', "train and validation go together"),
        ("stages = []\n" + SMALLEST, "stages in "),
        ("stages = [{pairs = 5, window = 1}]\n" + SMALLEST, "stages.0.window in "),
        ("stages = [{pairs = 5, strides = [0]}]\n" + SMALLEST, "stages.0.strides.0 in "),
        ("optimizer = {betas = [1.5, 0.9]}\n" + SMALLEST, "optimizer.betas.0 in "),
    ],
)
def test_what_a_recipe_must_not_hold_is_named(tmp_path, text, message):
    """One sentence names the field."""
    with pytest.raises(RecipeError, match=message):
        read_recipe(recipe_file(tmp_path, text))


def test_a_missing_recipe_is_said(tmp_path):
    """There is no such file."""
    with pytest.raises(RecipeError, match=r"cannot read .*nowhere\.toml"):
        read_recipe(tmp_path / "nowhere.toml")


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_a_recipe_comes_back_as_it_was_written(path):
    """Every recipe of the project is read, and its text gives the same recipe again."""
    recipe = read_recipe(path)

    assert recipe_from_text(recipe_text(recipe)) == recipe


def test_options_of_any_kind_come_back(tmp_path):
    """Options may be nested, and text may hold quotes."""
    text = SMALLEST + '[network.options]\na = [1, 2]\n"b c" = {d = 0.5, e = true}\nf = "\\"x"\n'

    recipe = read_recipe(recipe_file(tmp_path, text))

    assert recipe.network.options == {"a": [1, 2], "b c": {"d": 0.5, "e": True}, "f": '"x'}
    assert recipe_from_text(recipe_text(recipe)) == recipe


def test_fields_are_changed_by_path(tmp_path):
    """Numbers, text, fields of lists and tables that are not there yet."""
    text = "stages = [{pairs = 5}]\n" + SMALLEST
    changes = ("seed=3", "network.name=cnn", "stages[0].batch=7", "network.options.width=8")

    recipe = read_recipe(recipe_file(tmp_path, text), changes)

    assert recipe.seed == 3
    assert recipe.network.name == "cnn"
    assert recipe.stages == (Stage(pairs=5, batch=7),)
    assert recipe.network.options == {"width": 8}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("seed", "write FIELD=VALUE"),
        ("stages[4].batch=3", "there is no field"),
        ("seed.x=3", "there is no field"),
        ("network.nam=cnn", "unknown field 'network.nam'"),
    ],
)
def test_a_change_of_nothing_is_refused(tmp_path, change, message):
    """A misspelt change does not pass in silence."""
    text = "seed = 1\nstages = [{pairs = 5}]\n" + SMALLEST

    with pytest.raises(RecipeError, match=message):
        read_recipe(recipe_file(tmp_path, text), (change,))


def test_a_budget_of_pairs_is_the_same_for_every_window():
    """1000 pairs are 63 steps of 16 pairs, or 32 of 8 windows with 4 pairs."""
    assert Stage(pairs=1000, window=2, batch=16).steps == 63
    assert Stage(pairs=1000, window=5, batch=8).steps == 32


def test_defaults_do_not_depend_on_the_file(tmp_path):
    """A recipe of defaults is that of its own text."""
    recipe = Recipe.model_validate({"network": {"name": "x"}, "data": {"folder": "y"}})

    assert read_recipe(recipe_file(tmp_path, recipe_text(recipe))) == recipe

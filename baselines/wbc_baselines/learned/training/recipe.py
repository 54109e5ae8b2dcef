"""Recipes: the settings of all runs of a campaign in one TOML file."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec

from wbc_baselines.learned.packaged import RECIPES
from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_bench.errors import UnknownNameError
from wbc_bench.readers import read_toml

GIVEN = frozenset({"method", "seed", "init_checkpoint", "teacher"})  # by the campaign, not by a recipe


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of `TrainConfig` by name, for all runs and for two kinds of them."""

    name: str
    common: dict[str, Any]
    # without a teacher: the oracle, or every method where nothing is distilled
    from_scratch: dict[str, Any]
    ancestor: str = ""  # checkpoint of any robot that initializes the oracle; "" for random weights
    distilled: dict[str, Any] | None = None  # the other methods, beginning with and taught by the oracle


def find_recipe(name: str) -> Recipe:
    """Read a recipe.

    Args:
        name: Name of a recipe of this package, or FILE.toml.

    Returns:
        The recipe; its settings have names that exist.

    Raises:
        UnknownNameError: There is no such recipe.
        TrainingError: The file cannot be read, or names a setting that does not exist or is not a recipe's.
    """
    path = Path(name) if name.endswith(".toml") else RECIPES / f"{name}.toml"
    if path.parent == RECIPES and not path.exists():
        raise UnknownNameError("recipe", name, recipe_names(), "--recipe")
    recipe = read_toml(path, Recipe, "recipe", TrainingError)
    valid = {field.name for field in fields(TrainConfig)} - GIVEN
    for table in ("common", "from_scratch", "distilled"):
        for setting in getattr(recipe, table) or {}:
            if setting not in valid:
                raise UnknownNameError("setting", setting, valid, f"`{table}` of recipe '{path}'")
    return recipe


def recipe_names() -> list[str]:
    """List the recipes of this package."""
    return sorted(path.stem for path in RECIPES.glob("*.toml"))

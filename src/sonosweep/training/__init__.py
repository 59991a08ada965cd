"""How motion networks learn: recipes, windows of frames, losses, runs.

Names that need no Lightning; :mod:`sonosweep.training.run` does.
"""

from sonosweep.training.augment import (
    AugmentSettings,
    mirror_lateral,
    reverse_in_elevational_mirror,
)
from sonosweep.training.losses import (
    LossSettings,
    correlation_loss,
    gaussian_loss,
    huber_loss,
    l1_loss,
    mmae_loss,
    total_loss,
    triplet_loss,
)
from sonosweep.training.recipe import Recipe, Stage, read_recipe, recipe_text
from sonosweep.training.scans import TrainingScan, open_data, training_scan
from sonosweep.training.sequences import TrainingBatches, motion_statistics

__all__ = [
    "AugmentSettings",
    "LossSettings",
    "Recipe",
    "Stage",
    "TrainingBatches",
    "TrainingScan",
    "correlation_loss",
    "gaussian_loss",
    "huber_loss",
    "l1_loss",
    "mirror_lateral",
    "mmae_loss",
    "motion_statistics",
    "open_data",
    "read_recipe",
    "recipe_text",
    "reverse_in_elevational_mirror",
    "total_loss",
    "training_scan",
    "triplet_loss",
]

"""The table of metrics: every number with its unit and one line on what it says."""

import math
from collections.abc import Sequence
from html import escape

from sonosweep.view.content import Metric, ReportRun
from sonosweep.view.svg import MINUS

MEANINGS: dict[str, tuple[str, str]] = {
    "frames": ("Frames compared", "How many frames have a pose in both."),
    "relative_error_mm": ("rAE, translation", "Mean error of one step's translation, per axis."),
    "relative_error_deg": ("rAE, rotation", "Mean error of one step's turn, per axis."),
    "relative_error_mixed": (
        "rAE, mixed",
        "Mean of the two above, as MoGLo-Net's tables print it.",
    ),
    "relative_angle_deg": ("Turn error of a step", "Mean angle between estimated and true turn."),
    "accumulated_error_mm": (
        "aAE, translation",
        "Mean error of the position since frame 0, per axis.",
    ),
    "accumulated_error_deg": ("aAE, rotation", "Mean error of the turn since frame 0, per axis."),
    "accumulated_error_mixed": (
        "aAE, mixed",
        "Mean of the two above, as MoGLo-Net's tables print it.",
    ),
    "accumulated_angle_deg": ("Turn error since frame 0", "Mean angle between estimated and true."),
    "relative_frame_error_mm": ("rFE", "Mean distance of a frame's points after one step."),
    "accumulated_frame_error_mm": ("aFE", "Mean distance of all frames' points from the truth."),
    "correlation_cosine": ("Corr, cosine", "Likeness of point coordinates over time; 1 is best."),
    "correlation_pearson": ("Corr, Pearson", "Likeness of how points move; 1 is best."),
    "final_drift_mm": ("Final drift (FD)", "How far the last frame ends from its true place."),
    "final_drift_rate_path_percent": (
        "FDR per path",
        "Final drift per length of the true path: MoGLo-Net's text.",
    ),
    "final_drift_rate_chord_percent": (
        "FDR per chord",
        "Final drift per straight line from first to last frame: MoGLo-Net's code.",
    ),
    "median_drift_mm": ("Median drift", "Half of the frames are closer to their true place."),
    "maximum_drift_mm": ("Largest drift", "The frame that is farthest from its true place."),
    "path_length_mm": ("Length of the true path", "Of the middle of the compared points."),
    "chord_length_mm": ("First to last frame", "Straight line between the ends of the true path."),
    "estimated_path_length_mm": (
        "Length of the estimated path",
        "Of the middle of the compared points.",
    ),
    "global_pixel_error_mm": ("GPE", "TUS-REC: mean error of all pixels since frame 0."),
    "global_landmark_error_mm": ("GLE", "TUS-REC: mean error of landmarks since frame 0."),
    "local_pixel_error_mm": ("LPE", "TUS-REC: mean error of all pixels after one step."),
    "local_landmark_error_mm": ("LLE", "TUS-REC: mean error of landmarks after one step."),
    "overlap": ("Overlap (Dice)", "Space that both volumes cover; 1 is all."),
    "correlation": ("Voxel correlation", "Likeness of the common voxels; 1 is best."),
    "psnr_db": ("PSNR", "Likeness of the common voxels; higher is better."),
    "mean_difference": ("Mean difference", "Of the common voxels' values."),
    "common_voxels": ("Common voxels", "Voxels that both volumes cover."),
}
"""Label and explanation by the name that :mod:`sonosweep.metrics` gives a number."""

FIRST = (
    "final_drift_mm",
    "final_drift_rate_path_percent",
    "final_drift_rate_chord_percent",
    "path_length_mm",
    "estimated_path_length_mm",
    "accumulated_frame_error_mm",
    "relative_frame_error_mm",
)
"""What most readers look for; the others follow in the order in which they were given."""

SHORT = {
    "rAE": "Mean error of one step, per axis.",
    "aAE": "Mean error since frame 0, per axis.",
    "rFE": MEANINGS["relative_frame_error_mm"][1],
    "aFE": MEANINGS["accumulated_frame_error_mm"][1],
    "Corr": "Likeness of point coordinates over time; 1 is best.",
    "FD": MEANINGS["final_drift_mm"][1],
    "FDR": "Final drift per length of the true sweep.",
    "GPE": MEANINGS["global_pixel_error_mm"][1],
    "GLE": MEANINGS["global_landmark_error_mm"][1],
    "LPE": MEANINGS["local_pixel_error_mm"][1],
    "LLE": MEANINGS["local_landmark_error_mm"][1],
}
"""Explanations of the paper's abbreviations, for metrics that are named by one."""


def metric_table(runs: Sequence[ReportRun]) -> str:
    """Return an HTML table with a column for each run that has metrics; empty if none has."""
    measured = [run for run in runs if run.metrics]
    if not measured:
        return ""
    given = dict.fromkeys(name for run in measured for name in run.metrics or {})
    names = sorted(given, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))
    head = "".join(f'<th class="number" scope="col">{escape(run.name)}</th>' for run in measured)
    body = "".join(
        _row(name, [(run.metrics or {}).get(name) for run in measured]) for name in names
    )
    return (
        '<div class="scroll"><table class="metrics"><thead><tr><th scope="col">Metric</th>'
        f'{head}<th scope="col">What it says</th></tr></thead><tbody>{body}</tbody></table></div>'
    )


def format_value(value: float | int) -> str:
    """Return a number with four significant digits, whole numbers in full."""
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{int(value):,}".replace(",", "\u202f").replace("-", MINUS)
    return f"{value:.4g}".replace("-", MINUS)


def _row(name: str, values: Sequence[Metric | None]) -> str:
    label, meaning = MEANINGS.get(
        name, (name, SHORT.get(name.split()[0] if name.strip() else "", ""))
    )
    cells = "".join(f'<td class="number">{_cell(value)}</td>' for value in values)
    return (
        f'<tr><th scope="row" title="{escape(name)}">{escape(label)}</th>{cells}'
        f'<td class="what">{escape(meaning)}</td></tr>'
    )


def _cell(metric: Metric | None) -> str:
    """Return a value with its unit; all its digits are in the markup for who copies it."""
    value, unit = metric or (None, "")
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    shown = f'<data value="{value}">{format_value(value)}</data>'
    return f'{shown} <span class="unit">{escape(unit)}</span>' if unit else shown

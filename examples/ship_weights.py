"""Put trained networks into the package, each with a model card.

    python examples/ship_weights.py docs/results/table1.csv src/sonosweep/weights RUN ...

Each run becomes ``NETWORK.safetensors`` and ``NETWORK.md``. Matrices are stored in 16 bits,
which makes a file half as large and motions differ by about a thousandth. The table says how
the network did in the test, which goes into both files.
"""

import csv
import sys
from pathlib import Path

import torch

from sonosweep.estimators.network_names import NETWORKS
from sonosweep.estimators.shipped import find_weights
from sonosweep.estimators.weights import WeightsInfo, load_weights, save_weights
from sonosweep.evaluate.methods import Network
from sonosweep.io.atomic import write_beside

TOLD = {
    "rae": ("relative_error_mixed", "rAE (mm and degrees)"),
    "rfe": ("relative_frame_error_mm", "rFE (mm)"),
    "afe": ("accumulated_frame_error_mm", "aFE (mm)"),
    "fdr": ("final_drift_rate_path_percent", "final drift (% of path)"),
    "r_lateral": ("correlation_lateral", "correlation, lateral"),
    "r_axial": ("correlation_axial", "correlation, axial"),
    "r_elevational": ("correlation_elevational", "correlation, elevational"),
    "r_pitch": ("correlation_pitch", "correlation, pitch"),
    "r_yaw": ("correlation_yaw", "correlation, yaw"),
    "r_roll": ("correlation_roll", "correlation, roll"),
}
"""What is told of a test: its name in the metadata, in the table, and on the card."""


def main(table: Path, folder: Path, runs: list[str]) -> None:
    """Write weights and card of each run."""
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    folder.mkdir(parents=True, exist_ok=True)
    for run in runs:
        network, info = load_weights(find_weights(run))
        tested = test_metrics(rows, run)
        metrics = {**info.metrics, **{f"test_{name}": value for name, value in tested.items()}}
        for parameter in network.parameters():
            if parameter.ndim > 1:
                parameter.data = parameter.data.to(torch.float16)
        shipped = info.model_copy(update={"metrics": metrics})
        save_weights(folder / f"{info.network}.safetensors", network, shipped)
        with write_beside(folder / f"{info.network}.md") as temporary:
            temporary.write_text(model_card(info, tested, rows, table), encoding="utf-8")


def test_metrics(rows: list[dict[str, str]], run: str) -> dict[str, float]:
    """Return the mean over the test sweeps of what is told of the weights of a run."""
    weights = Network(run, find_weights(run)).origin["weights"]
    own = [row for row in rows if row.get("weights") == weights]
    if not own:
        raise SystemExit(f"the table has no rows of the weights of '{run}'")
    return {
        name: sum(float(row[column]) for row in own) / len(own)
        for name, (column, _) in TOLD.items()
    }


def model_card(
    info: WeightsInfo, tested: dict[str, float], rows: list[dict[str, str]], table: Path
) -> str:
    """Return what a user must know about weights, as Markdown."""
    sweeps = len({row["scan"] for row in rows})
    people = len({row["subject"] for row in rows})
    columns, lines = info.input.columns, info.input.rows
    width, depth = columns * info.spacing_mm[0], lines * info.spacing_mm[1]
    numbers = "\n".join(f"| {TOLD[name][1]} | {value:.3g} |" for name, value in tested.items())
    return f"""# {info.network}, {info.preset}

{NETWORKS[info.network].source}; {info.parameters / 1e6:.2f} M parameters; made {info.made} with \
sonosweep {info.version}.

- **Reads** {info.input.channels} frames of {columns} x {lines} pixels, {width:.1f} x \
{depth:.1f} mm ({info.spacing_mm[0]:.4f} x {info.spacing_mm[1]:.4f} mm a pixel). Other frames are \
resampled, or refused if they show much less.
- **Learned from** simulated sweeps over forearms alone, all in one direction \
(digest {info.data}), and from no recording. It takes every sweep for one that goes forward.
- **For** research on trajectories of freehand sweeps; not for diagnosis. On other tissue, other \
probes or clinical presets expect far larger errors than these.

Mean over {sweeps} simulated test sweeps of {people} subjects that it never saw, from \
`{table.name}`, which says by which command and how sure the numbers are:

| metric | |
| --- | ---: |
{numbers}

The recipe:

```toml
{info.recipe.strip()}
```
"""


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])

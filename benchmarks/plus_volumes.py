"""How near our forward modes come to the volumes that PLUS made, as a Markdown table.

    python benchmarks/plus_volumes.py FOLDER_OF_RECORDINGS

One sweep of a spine phantom, 21 frames. Compared are the voxels that a pixel hit in both:
ours have coverage (a filled hole has none), PLUS's are above 0.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from sonosweep.cli.main import main as command_line
from sonosweep.evaluate import markdown_table
from sonosweep.io import read_volume

CONFIG = "PlusDeviceSet_VolumeReconstructionOnly_"
JOBS = {
    "linear, mean, holes filled": (
        "PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml",
        "SpinePhantomFreehandReconstructed.mha",
    ),
    "nearest, latest, fan clipped": (
        f"{CONFIG}SonixRP_TRUS_D70mm_NN_LATE.xml",
        "vtkVolumeReconstructorTestNNLATEvolumeRef.mha",
    ),
    "linear, maximum": (
        f"{CONFIG}SpinePhantom_LN_MAXI.xml",
        "vtkVolumeReconstructorTestLNMAXIvolumeRef.mha",
    ),
    "nearest, mean, holes filled": (
        f"{CONFIG}SpinePhantom_NN_MEAN.xml",
        "vtkVolumeReconstructorTestNNMEANvolumeRef.mha",
    ),
}


def main(recordings: Path) -> None:
    """Run PLUS's four jobs through the command line and print a row for each."""
    folder = recordings / "plus_spine_freehand"
    rows: list[dict[str, str | int | float | bool | None]] = []
    for mode, (config, reference) in JOBS.items():
        with tempfile.TemporaryDirectory() as out:
            words = ["reconstruct", folder / "SpinePhantomFreehand.igs.mha", "--poses", "tracked"]
            words += ["--plus-config", folder / config, "--volume-format", "mha", "-o", out]
            command_line([str(word) for word in words])
            ours = read_volume(Path(out) / "volume.mha").voxels
            seen = read_volume(Path(out) / "coverage.mha").voxels
        theirs = read_volume(folder / reference, world="lps").voxels
        common = tuple(slice(n) for n in np.minimum(ours.shape, theirs.shape))
        a, b, hit = ours[common].astype(float), theirs[common].astype(float), seen[common] > 0
        both = hit & (a > 0) & (b > 0)
        a, b = a[both], b[both]
        rows.append(
            {
                "PLUS's mode": mode,
                "voxels": int(both.sum()),
                "correlation": float(np.corrcoef(a, b)[0, 1]),
                "PSNR (dB)": float(20 * np.log10(255 / np.sqrt(np.mean((a - b) ** 2)))),
                "ours - PLUS (gray levels)": float((a - b).mean()),
            }
        )
    print(markdown_table(rows, digits=4))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

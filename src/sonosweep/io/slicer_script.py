"""A script for 3D Slicer that opens everything a reconstruction wrote.

Slicer's own scene files are said by its makers to be subject to change; its Python
functions are stable, and a script can be read and edited.
"""

import os
from pathlib import Path

from sonosweep.io.atomic import write_beside

SCRIPT_NAME = "open_in_slicer.py"
# Presets that Slicer brings: a projection of bright vessels, and the one for ultrasound.
PRESETS = {"power_doppler": "MR-Angio", "photoacoustic": "MR-Angio"}
DEFAULT_PRESET = "US-Fetal"

SCRIPT = '''\
"""Open this reconstruction in 3D Slicer.

Run:  Slicer --python-script {script}
or paste it into Slicer's Python console after setting FOLDER.
"""

import pathlib

import slicer

try:
    FOLDER = pathlib.Path(__file__).resolve().parent
except NameError:
    FOLDER = pathlib.Path({folder!r})

VOLUMES = {volumes}
CURVES = {curves}
SEQUENCES = {sequences}


def show_volume(file, preset):
    """Load a volume and render it in the 3-D view."""
    node = slicer.util.loadVolume(str(FOLDER / file))
    logic = slicer.modules.volumerendering.logic()
    display = logic.CreateDefaultVolumeRenderingNodes(node)
    found = logic.GetPresetByName(preset)
    if found is not None:
        display.GetVolumePropertyNode().Copy(found)
    return node, display


def load_sequence(file):
    """Load the sweep itself, if the extension SlicerIGSIO is installed."""
    try:
        slicer.util.loadNodeFromFile(str(FOLDER / file), "Sequence Metafile")
    except RuntimeError:
        print(f"{{file}} was not loaded: install the extension SlicerIGSIO to see the sweep")


shown = [show_volume(file, preset) for file, preset in VOLUMES]
for file in CURVES:
    slicer.util.loadMarkups(str(FOLDER / file))
for file in SEQUENCES:
    load_sequence(file)
for index, (node, display) in enumerate(shown):
    display.SetVisibility(index == 0)
if shown:
    slicer.util.setSliceViewerLayers(background=shown[0][0], fit=True)
    slicer.app.layoutManager().setLayout(slicer.vtkMRMLLayoutNode.SlicerLayoutFourUpView)
    for number in range(slicer.app.layoutManager().threeDViewCount):
        view = slicer.app.layoutManager().threeDWidget(number).threeDView()
        view.resetFocalPoint()
        view.resetCamera()
'''


def write_slicer_script(
    folder: str | os.PathLike,
    volumes: tuple[str, ...] | None = None,
    curves: tuple[str, ...] | None = None,
    sequences: tuple[str, ...] | None = None,
) -> Path:
    """Write ``open_in_slicer.py`` into a folder of results and return its path.

    It loads volumes with a rendering preset for their modality, the trajectory as a curve
    and the sweep. Only the first volume is rendered at first. Nothing but the folder's own
    files is named, so the folder can be moved.

    Args:
        folder: Where the results are.
        volumes: Names of volume files in it; ``None`` finds ``volume*`` and leaves out
            coverage.
        curves: Names of ``.mrk.json`` files; ``None`` finds them.
        sequences: Names of ``.igs.mha`` files; ``None`` finds them.

    Raises:
        FormatError: If the script cannot be written.
    """
    place = Path(folder)
    if volumes is None:
        volumes = tuple(name for name in _names(place, "volume*") if _is_volume(name))
    chosen = [(name, _preset(name)) for name in volumes]
    text = SCRIPT.format(
        script=SCRIPT_NAME,
        folder=".",
        volumes=repr(chosen),
        curves=repr(list(_names(place, "*.mrk.json") if curves is None else curves)),
        sequences=repr(list(_names(place, "*.igs.mha") if sequences is None else sequences)),
    )
    target = place / SCRIPT_NAME
    with write_beside(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return target


def _names(folder: Path, pattern: str) -> tuple[str, ...]:
    # By length first: "volume.nrrd" is the B-mode and comes before its companions.
    names = (path.name for path in folder.glob(pattern) if path.is_file())
    return tuple(sorted(names, key=lambda name: (len(name), name)))


def _is_volume(name: str) -> bool:
    return name.endswith((".nrrd", ".mha", ".nii", ".nii.gz")) and "coverage" not in name


def _preset(name: str) -> str:
    return next((preset for part, preset in PRESETS.items() if part in name), DEFAULT_PRESET)

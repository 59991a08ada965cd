"""Weights of a trained network as one safetensors file that says all about them."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.estimators.network import FrameShape, MotionNetwork
from sonosweep.estimators.network_input import InputSettings
from sonosweep.io.atomic import write_beside

FORMAT = "sonosweep weights 1"
KEY = "sonosweep"
DIGEST = "sha256"  # of the numbers: safetensors itself does not notice a flipped bit
INFO_DIGEST = "sonosweep_sha256"  # of what is said about them
LARGEST_BYTES = 2**30

Positive = Annotated[float, Field(gt=0)]
Options = dict[str, JsonValue]
Builder = Callable[[str, Mapping[str, Any], FrameShape, str], MotionNetwork]
"""Makes a network of a name, options, the frames that it reads, and a preset."""


class WeightsInfo(BaseModel):
    """Where weights come from and what they need.

    Attributes:
        network: Name, such as ``"moglo"``.
        preset: Of its options.
        options: Those that differ from the preset's.
        input: What the network reads of a scan.
        spacing_mm: Of the pixels that it reads, lateral and axial.
        center_mm: Place of the frame's centre in image coordinates; the network's motions
            are those of coordinates with their origin there.
        window: Frames in the longest windows it was trained on.
        motion_scale: Of each of the six numbers (mm, rad): what the network gives is
            multiplied by it.
        mean_motion: Of the steps that it was trained on (mm, rad).
        parameters: How many it has.
        recipe: That made it, as TOML.
        data: Digest of the scans it was trained on.
        metrics: On the scans for validation.
        made: Date.
        version: Of the program that made it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    network: str
    preset: str
    options: Options = {}
    input: InputSettings
    spacing_mm: tuple[Positive, Positive]
    center_mm: tuple[float, float]
    window: int = Field(ge=2)
    motion_scale: tuple[Positive, Positive, Positive, Positive, Positive, Positive]
    mean_motion: tuple[float, float, float, float, float, float]
    parameters: int
    recipe: str
    data: str
    metrics: dict[str, float | None] = {}
    made: str
    version: str

    @property
    def frame_shape(self) -> FrameShape:
        """What the network reads."""
        return FrameShape(self.input.count, self.input.rows, self.input.columns)


def save_weights(path: str | os.PathLike, network: MotionNetwork, info: WeightsInfo) -> None:
    """Write the weights of a network and all that is needed to use them.

    Raises:
        FormatError: If the file cannot be written.
    """
    state = network.state_dict()
    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    said = info.model_dump_json()
    metadata = {
        "format": FORMAT,
        KEY: said,
        INFO_DIGEST: hashlib.sha256(said.encode()).hexdigest(),
        DIGEST: _digest(tensors),
    }
    with write_beside(path) as temporary:
        save_file(tensors, temporary, metadata)


def load_weights(
    path: str | os.PathLike, build: Builder | None = None
) -> tuple[MotionNetwork, WeightsInfo]:
    """Return a trained network, in evaluation mode, and what is known about it.

    Args:
        path: A file of :func:`save_weights`.
        build: What makes networks by name; ``None`` knows all of ours.

    Raises:
        FormatError: If it is no such file, is damaged, or is of a network of other shape.
    """
    info, tensors = _read(Path(path))
    if build is None:
        from sonosweep.estimators.network_names import build_network

        build = build_network
    try:
        network = build(info.network, info.options, info.frame_shape, info.preset)
        network.load_state_dict(tensors)
    except SonosweepError as error:
        raise FormatError(f"the weights in '{path}' cannot be used: {error}") from error
    except RuntimeError as error:
        raise FormatError(
            f"the weights in '{path}' do not fit network '{info.network}' of preset"
            f" '{info.preset}': they are of another version"
        ) from error
    return network.eval(), info


def read_weights_info(path: str | os.PathLike) -> WeightsInfo:
    """Return what is known about weights, without the weights.

    Raises:
        FormatError: If it is no such file, or is damaged.
    """
    return _read(Path(path), only_info=True)[0]


def _read(path: Path, only_info: bool = False) -> tuple[WeightsInfo, dict[str, torch.Tensor]]:
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise FormatError(f"'{path}' is too large to be weights of ours")
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT or KEY not in metadata:
                raise FormatError(f"'{path}' holds no weights of ours ({FORMAT})")
            said = metadata[KEY]
            written = hashlib.sha256(said.encode()).hexdigest()
            if metadata.get(INFO_DIGEST, written) != written:
                raise FormatError(f"'{path}' is damaged: what it says is not what was written")
            info = WeightsInfo.model_validate(json.loads(said))
            names = () if only_info else file.keys()
            tensors = {name: file.get_tensor(name) for name in names}
    except OSError as error:
        raise FormatError(f"cannot read weights '{path}': {error.strerror or error}") from error
    except SafetensorError as error:
        raise FormatError(f"'{path}' is damaged, or no safetensors file") from error
    except (ValidationError, ValueError, RecursionError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"what '{path}' says about its weights cannot be read") from error
    if not only_info and DIGEST in metadata and metadata[DIGEST] != _digest(tensors):
        raise FormatError(f"'{path}' is damaged: its numbers are not those that were written")
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise FormatError(f"weights in '{path}' are not finite")
    return info, tensors


def _digest(tensors: Mapping[str, torch.Tensor]) -> str:
    found = hashlib.sha256()
    for name in sorted(tensors):
        found.update(name.encode())
        found.update(tensors[name].reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()

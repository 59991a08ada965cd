"""What a sequence file says of each frame: ``Seq_Frame0007_ProbeToTrackerTransform`` and so on.

A transform ``<From>To<To>`` maps From to To, column vectors from the left; its status is
``OK`` if the tracker saw it. Old and foreign files leave out the suffix ``Transform`` or the
status.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import FormatError
from sonosweep.io.metaimage_header import numbers_text

TransformName = tuple[str, str]
FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,15})_(.+)", re.ASCII | re.IGNORECASE)
# The first "To" that can end a name ends it: frame names must not contain "To".
TRANSFORM_NAME = re.compile(r"(.+?)To([A-Z].*?)(Transform)?", re.ASCII)
# A header that describes few frames must not make us reserve room for billions.
FREE_ENTRIES = 1_000_000


@dataclass(frozen=True, eq=False)
class FrameTransforms:
    """One transform, frame by frame.

    Attributes:
        matrices: From-to-To matrices as stored, float64; NaN where a frame has none. Those of
            images hold the pixel size and are not rigid.
        statuses: ``"OK"`` where the tracker saw it, PLUS's other words where not.
    """

    matrices: Float[Tensor, "frames 4 4"]
    statuses: tuple[str, ...]

    @property
    def valid(self) -> Bool[Tensor, " frames"]:
        """Whether the tracker saw it."""
        return torch.tensor([status == "OK" for status in self.statuses], dtype=torch.bool)


@dataclass(frozen=True, eq=False)
class FrameFields:
    """What a header says of each frame.

    Attributes:
        transforms: Transforms by the systems they map from and to.
        timestamps_s: Time of each frame, NaN where a frame has none; ``None`` if none has.
        image_valid: Whether a frame holds an image.
        others: Every other field by name; ``""`` where a frame has none.
    """

    transforms: Mapping[TransformName, FrameTransforms]
    timestamps_s: Float[Tensor, " frames"] | None
    image_valid: Bool[Tensor, " frames"]
    others: Mapping[str, tuple[str, ...]]


def transform_name(field: str) -> TransformName | None:
    """Return the systems that a field's name maps from and to, or ``None``.

    A name like ``CustomTransform``, which old versions of PLUS wrote, maps from ``Custom`` to
    a system without a name, so that nothing can be chained to it by mistake.
    """
    match = TRANSFORM_NAME.fullmatch(field)
    if match:
        return match[1], match[2]
    if field.endswith("Transform") and field != "Transform":
        return field.removesuffix("Transform"), ""
    return None


def split_frame_fields(
    values: Mapping[str, str],
) -> tuple[dict[str, dict[int, str]], dict[str, str]]:
    """Return the fields of frames, by name and frame, and the fields of the whole file."""
    of_frames: dict[str, dict[int, str]] = {}
    of_file: dict[str, str] = {}
    for name, value in values.items():
        match = FRAME_FIELD.fullmatch(name)
        if match:
            of_frames.setdefault(match[2], {})[int(match[1])] = value
        else:
            of_file[name] = value
    return of_frames, of_file


def parse_frame_fields(
    fields: Mapping[str, Mapping[int, str]], count: int, path: Path, image_status: str
) -> FrameFields:
    """Return what the fields of ``count`` frames say.

    Args:
        fields: Text by field and frame.
        count: How many frames the file has.
        path: For messages.
        image_status: Which field tells whether a frame holds an image: ``"ImageStatus"``,
            but ``"Status"`` in NRRD files.

    Raises:
        FormatError: If a frame is described that is not there, or a number is none.
    """
    _check_frame_numbers(fields, count, path)
    transforms: dict[TransformName, FrameTransforms] = {}
    of_transforms: set[str] = {"Timestamp", "ImageStatus", image_status}
    for name, texts in fields.items():
        key = transform_name(name)
        if key is None or not _holds_matrices(name, texts):
            continue
        transforms[key] = _parse_transforms(name, texts, fields.get(name + "Status", {}), count)
        of_transforms |= {name, name + "Status"}
        _check_matrices(transforms[key], name, texts, path)
    shown = fields.get("ImageStatus", fields.get(image_status, {}))
    hidden = [frame for frame, text in shown.items() if text.strip().upper() != "OK"]
    image_valid = torch.ones(count, dtype=torch.bool)
    image_valid[hidden] = False
    return FrameFields(
        transforms=transforms,
        timestamps_s=_parse_times(fields.get("Timestamp", {}), count, path),
        image_valid=image_valid,
        others={
            name: tuple(texts.get(frame, "") for frame in range(count))
            for name, texts in fields.items()
            if name not in of_transforms
        },
    )


def _check_frame_numbers(fields: Mapping[str, Mapping[int, str]], count: int, path: Path) -> None:
    described = sum(map(len, fields.values()))
    if count * (len(fields) + 1) > 20 * described + FREE_ENTRIES:
        raise FormatError(
            f"'{path}' states {count} frames but describes far fewer: its header is wrong; export"
            " the recording again"
        )
    last = max((max(texts) for texts in fields.values() if texts), default=-1)
    if last >= count:
        raise FormatError(
            f"'{path}' describes frame {last} but states {count} frames, counted from 0: it was"
            " cut off or its header is wrong"
        )


def _holds_matrices(name: str, texts: Mapping[int, str]) -> bool:
    """Say whether a field is a transform: by its suffix, or else by holding 16 words."""
    return name.endswith("Transform") or all(len(text.split()) == 16 for text in texts.values())


def _parse_transforms(
    name: str, texts: Mapping[int, str], status_texts: Mapping[int, str], count: int
) -> FrameTransforms:
    matrices = np.full((count, 16), np.nan)
    statuses = ["MISSING"] * count
    for frame, text in texts.items():
        words = text.split()
        statuses[frame] = status_texts.get(frame, "OK").strip().upper()
        try:
            matrices[frame] = [_number(word) for word in words] if len(words) == 16 else np.inf
        except ValueError:
            matrices[frame] = np.inf
    return FrameTransforms(torch.from_numpy(matrices.reshape(count, 4, 4)), tuple(statuses))


def _check_matrices(
    transforms: FrameTransforms, name: str, texts: Mapping[int, str], path: Path
) -> None:
    bad = torch.isinf(transforms.matrices).flatten(1).any(1) & transforms.valid
    if bool(bad.any()):
        frame = int(bad.nonzero()[0])
        raise FormatError(
            f"{name} of frame {frame} in '{path}' is not 16 numbers: '{texts[frame][:80]}'"
        )


def _number(word: str) -> float:
    """Return a number, also one that Microsoft's library wrote for not-a-number."""
    return float("nan") if "#" in word else float(word)


def _parse_times(
    texts: Mapping[int, str], count: int, path: Path
) -> Float[Tensor, " frames"] | None:
    if not texts:
        return None
    times = torch.full((count,), float("nan"), dtype=torch.float64)
    for frame, text in texts.items():
        try:
            times[frame] = _number(text)
        except ValueError:
            raise FormatError(
                f"the Timestamp of frame {frame} in '{path}' is no number: '{text[:40]}'"
            ) from None
    return times


def format_frame_fields(fields: FrameFields, image_status: str) -> dict[str, str]:
    """Return the fields of all frames as header fields; undoes :func:`parse_frame_fields`.

    A transform that a frame has not is written as the identity with its status, since PLUS
    reads no NaN.
    """
    lines: dict[str, str] = {}
    names = {key: _field_name(key) for key in fields.transforms}
    matrices = {
        key: torch.where(
            torch.isfinite(transforms.matrices).flatten(1).all(1)[:, None, None],
            transforms.matrices,
            torch.eye(4, dtype=torch.float64),
        )
        .flatten(1)
        .tolist()
        for key, transforms in fields.transforms.items()
    }
    for frame, valid in enumerate(fields.image_valid.tolist()):
        start = f"Seq_Frame{frame:04d}_"
        for name, texts in fields.others.items():
            if texts[frame]:
                lines[start + name] = texts[frame]
        for key, transforms in fields.transforms.items():
            lines[start + names[key]] = numbers_text(matrices[key][frame])
            lines[start + names[key] + "Status"] = transforms.statuses[frame]
        if fields.timestamps_s is not None and bool(torch.isfinite(fields.timestamps_s[frame])):
            lines[start + "Timestamp"] = numbers_text([float(fields.timestamps_s[frame])])
        lines[start + image_status] = "OK" if valid else "INVALID"
    return lines


def _field_name(key: TransformName) -> str:
    return f"{key[0]}To{key[1]}Transform" if key[1] else f"{key[0]}Transform"

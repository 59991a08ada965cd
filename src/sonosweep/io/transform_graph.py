"""Which transforms a recording and a configuration offer, and the way from one to another."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.io.plus_config import PlusConfig
from sonosweep.io.sequence import Sequence

LinkOrigin = Literal["frames", "configuration", "file"]


@dataclass(frozen=True)
class TransformLink:
    """One transform that is known, ``<source>To<target>``.

    Attributes:
        source: Whose coordinates it takes.
        target: Whose coordinates it gives.
        origin: ``"frames"`` if it changes from frame to frame; else where it is fixed.
        valid: For how many frames it holds.
        inverted: Whether a chain goes through it backwards.
    """

    source: str
    target: str
    origin: LinkOrigin
    valid: int
    inverted: bool = False

    @property
    def name(self) -> str:
        """PLUS's name for it."""
        return f"{self.source}To{self.target}"


def transform_graph(sequence: Sequence, config: PlusConfig | None = None) -> list[TransformLink]:
    """Return every known transform: those of the frames, the configuration and the file.

    Where the same transform is known twice, the first in this order is used.
    """
    links = [
        TransformLink(*systems, "frames", int(transforms.valid.sum()))
        for systems, transforms in sequence.transforms.items()
    ]
    if config is not None:
        links += [TransformLink(*key, "configuration", sequence.count) for key in config.transforms]
    links += [TransformLink(*key, "file", sequence.count) for key in sequence.static_transforms]
    return links


def find_chain(links: Iterable[TransformLink], start: str, goal: str) -> list[TransformLink] | None:
    """Return the fewest links that lead from one system to another, in walking order.

    Links that hold for no frame are not walked.

    Returns:
        Links, marked where they are walked backwards; ``None`` if nothing leads there.
    """
    usable = [link for link in links if link.valid]
    came_by: dict[str, tuple[str, TransformLink] | None] = {start: None}
    waiting = deque([start])
    while waiting and goal not in came_by:
        here = waiting.popleft()
        for link in usable:
            for a, b, inverted in (
                (link.source, link.target, False),
                (link.target, link.source, True),
            ):
                if a == here and b not in came_by:
                    came_by[b] = (here, replace(link, inverted=inverted))
                    waiting.append(b)
    if goal not in came_by:
        return None
    chain = []
    step = came_by[goal]
    while step is not None:
        chain.append(step[1])
        step = came_by[step[0]]
    return chain[::-1]


def reachable(links: Iterable[TransformLink], start: str) -> list[str]:
    """Return the systems that links lead to from one, itself first."""
    links = list(links)
    names = dict.fromkeys(name for link in links for name in (link.source, link.target))
    others = [n for n in names if n != start and find_chain(links, start, n) is not None]
    return [start, *others]


def missing_link(links: Iterable[TransformLink], start: str, goal: str) -> str:
    """Return one sentence that names the link that no transform makes, and the known ones."""
    links = list(links)
    here, there = reachable(links, start), reachable(links, goal)
    known = [
        f"{link.name} ({'fixed' if link.origin != 'frames' else f'valid in {link.valid} frames'})"
        for link in links
    ]
    sentence = (
        f"no transform leads from {' or '.join(here)} to {' or '.join(there)}; known are"
        f" {', '.join(known) or 'none'}"
    )
    if here == [start] and start == "Image" and "Probe" in there:
        sentence += "; ImageToProbe is in the PLUS configuration: pass it with --plus-config"
    return sentence


def link_matrices(
    link: TransformLink, sequence: Sequence, config: PlusConfig | None
) -> Float[Tensor, "*frames 4 4"]:
    """Return the matrices of a link in walking direction: one per frame, or one if fixed.

    Frames for which it does not hold have the identity.

    Raises:
        ScanError: If a matrix holds NaN, or cannot be inverted where it must be.
    """
    key = (link.source, link.target)
    if link.origin == "frames":
        transforms = sequence.transforms[key]
        identity = torch.eye(4, dtype=torch.float64)
        matrices = torch.where(transforms.valid[:, None, None], transforms.matrices, identity)
    elif link.origin == "configuration" and config is not None:
        matrices = config.transforms[key]
    else:
        matrices = sequence.static_transforms[key]
    bad = ~torch.isfinite(matrices).flatten(-2).all(-1)
    if not bool(bad.any()) and link.inverted:
        matrices, info = torch.linalg.inv_ex(matrices)
        bad = info != 0
    if bool(bad.any()):
        where = "" if matrices.ndim == 2 else f" of frame {int(bad.nonzero()[0])}"
        raise ScanError(
            f"{link.name}{where} in '{sequence.name}' is no transform: it holds NaN or cannot be"
            " inverted; mark it as INVALID or record again"
        )
    return matrices

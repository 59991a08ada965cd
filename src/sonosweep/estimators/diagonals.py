"""Sums along the diagonals of matrix products, which make a correlation of one."""

from contextlib import AbstractContextManager, nullcontext

import torch
from jaxtyping import Float
from torch import Tensor


def sum_diagonals(
    products: Float[Tensor, "batch count_and_spare length"], step: int
) -> Float[Tensor, "batch length"]:
    """Return ``sum_u products[:, u, t + u * step]`` for every ``t``, all ``u`` but the last.

    Rows laid end to end and cut again at ``length + step`` are rows shifted by ``step``
    each, so that one sum over rows does it, without an index. Where ``t + u * step`` is
    beyond a row's end the sum has no meaning and the caller cuts it off.

    Args:
        products: Rows to shift and add, then one spare row, which only has to be there.
        step: By which each row is shifted against the row before.
    """
    count, length = products.shape[1] - 1, products.shape[2]
    shifted = products.flatten(1)[:, : count * (length + step)]
    return shifted.unflatten(1, (count, length + step)).sum(1)[:, :length]


def box_matrix(length: int, box: int, device: torch.device) -> Float[Tensor, "places length"]:
    """Return the matrix that sums ``box`` neighbors at each of ``length - box + 1`` places."""
    offset = (
        torch.arange(length, device=device) - torch.arange(length - box + 1, device=device)[:, None]
    )
    return ((offset >= 0) & (offset < box)).float()


def full_precision(device: torch.device) -> AbstractContextManager:
    """Return a context in which nothing is rounded to half precision."""
    kind = device.type
    if not torch.amp.is_autocast_available(kind) or not torch.is_autocast_enabled(kind):
        return nullcontext()
    return torch.autocast(kind, enabled=False)

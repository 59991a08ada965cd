"""Clutter filter: an ensemble without the tissue, so that blood is left.

Tissue moves slowly and all together, so a few slow-time vectors carry nearly all its energy:
the first eigenvectors of the Gram matrix of the pulses. That matrix holds the square of the
clutter-to-blood ratio. In single precision the result would be wrong by some per cent at
60 dB, so everything is summed in double precision.
"""

from typing import Literal

import numpy as np
from jaxtyping import Complex, Complex128, Float64
from scipy.linalg import blas

from sonosweep.errors import ScanError

Rank = int | Literal["auto"]

BLOCK = 1024
"""Pixels at a time: in double precision they stay in the processor's cache."""


def svd_filter(
    ensemble: Complex[np.ndarray, "pulses rows columns"],
    rank: Rank = "auto",
    *,
    overwrite: bool = False,
) -> Complex[np.ndarray, "pulses rows columns"]:
    """Return an ensemble without its strongest slow-time components.

    Args:
        ensemble: IQ of the pulses of one frame.
        rank: How many components are tissue; ``"auto"`` as :func:`clutter_rank` says.
        overwrite: Whether to put the result where the ensemble is, if that is contiguous;
            saves memory.

    Raises:
        ScanError: If there are fewer than two pulses, a sample is not a number, or the rank
            is not between 0 and the number of pulses less one.

    References:
        Demené et al., "Spatiotemporal clutter filtering of ultrafast ultrasound data highly
        increases Doppler and fUltrasound sensitivity", IEEE TMI 2015, section II.B.
    """
    check_rank(len(ensemble), rank)
    samples = np.ascontiguousarray(ensemble).reshape(len(ensemble), -1)
    energies, vectors = slow_time_vectors(_gram_matrix(samples))
    count = clutter_rank(energies) if rank == "auto" else rank
    clutter = np.ascontiguousarray(vectors[:, :count])
    filtered = samples if overwrite else np.empty_like(samples)
    for first in range(0, samples.shape[1], BLOCK):
        block = samples[:, first : first + BLOCK].astype(np.complex128)
        filtered[:, first : first + BLOCK] = block - clutter @ (clutter.conj().T @ block)
    return filtered.reshape(ensemble.shape)


def slow_time_vectors(
    gram: Complex128[np.ndarray, "pulses pulses"],
) -> tuple[Float64[np.ndarray, " pulses"], Complex128[np.ndarray, "pulses pulses"]]:
    """Return the energies of the slow-time components, largest first, and their vectors.

    Args:
        gram: Products of all pairs of pulses, summed over the pixels; only the part above
            the diagonal is read.

    Raises:
        ScanError: If a number is not finite.
    """
    if not np.isfinite(gram).all():
        raise ScanError("the ensemble holds samples that are not numbers (NaN or infinite)")
    energies, vectors = np.linalg.eigh(gram, UPLO="U")
    return np.maximum(energies[::-1], 0.0), vectors[:, ::-1]


def clutter_rank(energies: Float64[np.ndarray, " pulses"]) -> int:
    """Return how many of the slow-time components are tissue: at least 1, at most half.

    They lie before the turning point of the curve of singular values in decibels, which is
    steep for tissue and flat for blood and noise: the point farthest below the straight line
    from the first value to the last.

    Args:
        energies: From :func:`slow_time_vectors`.

    References:
        Baranger et al., "Adaptive spatiotemporal SVD clutter filtering for ultrafast Doppler
        imaging using similarity of spatial singular vectors", IEEE TMI 2018, section II.C,
        among the rules that it compares.
    """
    floor = energies[0] * np.finfo(np.float64).eps + np.finfo(np.float64).tiny
    level_db = 10 * np.log10(np.maximum(energies, floor))
    line_db = np.linspace(level_db[0], level_db[-1], len(energies))
    return int(np.clip(np.argmax(line_db - level_db), 1, len(energies) // 2))


def check_rank(pulses: int, rank: Rank) -> None:
    """Check that an ensemble can be filtered.

    Raises:
        ScanError: If there are fewer than two pulses, or the rank leaves no component.
    """
    if pulses < 2:
        raise ScanError(f"an ensemble needs at least 2 pulses, got {pulses}")
    if rank != "auto" and not 0 <= rank < pulses:
        raise ScanError(
            f"the rank of the clutter must be from 0 to {pulses - 1} for {pulses} pulses, got"
            f" {rank}"
        )


def _gram_matrix(
    samples: Complex[np.ndarray, "pulses pixels"],
) -> Complex128[np.ndarray, "pulses pulses"]:
    """Return the part of samples @ samples^H that is on and above the diagonal."""
    gram = np.zeros((len(samples), len(samples)), np.complex128, order="F")
    for first in range(0, samples.shape[1], BLOCK):
        block = samples[:, first : first + BLOCK].astype(np.complex128)
        gram = blas.zherk(1.0, block.T, beta=1.0, c=gram, trans=2, overwrite_c=1)
    return gram.conj()  # BLAS sees the transposed pulses, whose products are conjugate

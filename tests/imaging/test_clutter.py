"""The clutter filter takes out what moves slowly and together, and nothing else."""

import time

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.imaging.clutter import clutter_rank, svd_filter
from sonosweep.imaging.doppler import power_doppler

DOUBLE = 1e-9  # of the blood's amplitude: what sums of squares 60 dB above it leave
NEIGHBORS = 1e-6  # components of blood differ little, so a cut among them is less certain


def tissue_and_blood(clutter_db=60.0, size=48, pulses=20, noise_db=-20.0, seed=3):
    """Return an ensemble of drifting tissue with a round vessel, and where the vessel is.

    The tissue turns by up to a radian in the ensemble, not everywhere as fast; the blood
    renews itself by a third from pulse to pulse, and is as strong as 1.
    """
    random = np.random.default_rng(seed)

    def noise(*shape):
        return (random.standard_normal(shape) + 1j * random.standard_normal(shape)) / np.sqrt(2)

    row, column = np.mgrid[:size, :size] / size
    vessel = np.hypot(row - 0.5, column - 0.5) < 0.2
    turned = np.exp(1j * np.linspace(0, 1, pulses)[:, None, None] * (0.5 + 0.5 * column))
    blood = [noise(size, size)]
    for _ in range(pulses - 1):
        blood.append(0.67 * blood[-1] + np.sqrt(1 - 0.67**2) * noise(size, size))
    tissue = 10 ** (clutter_db / 20) * noise(size, size) * turned
    ensemble = tissue + vessel * np.array(blood)
    return ensemble + 10 ** (noise_db / 20) * noise(pulses, size, size), vessel


def full_svd_filter(ensemble, rank):
    """The same by the singular value decomposition of the whole Casorati matrix."""
    casorati = ensemble.reshape(len(ensemble), -1).astype(np.complex128)
    left, values, right = np.linalg.svd(casorati, full_matrices=False)
    values[:rank] = 0
    return (left * values @ right).reshape(ensemble.shape)


@pytest.mark.parametrize(
    ("rank", "tolerance"), [(1, DOUBLE), (2, DOUBLE), (3, DOUBLE), (10, NEIGHBORS), (19, NEIGHBORS)]
)
def test_filter_is_a_full_singular_value_decomposition(rank, tolerance):
    """At 60 dB of clutter the small Gram matrix gives what the large decomposition does."""
    ensemble, _ = tissue_and_blood()
    expected = full_svd_filter(ensemble, rank)

    error = np.abs(svd_filter(ensemble, rank) - expected).max() / np.abs(expected).max()

    assert error < tolerance


def test_single_precision_samples_are_filtered_in_double_precision():
    """Samples of a scanner, 32 bits each, lose no more than their own rounding at 60 dB."""
    ensemble, _ = tissue_and_blood()
    expected = full_svd_filter(ensemble.astype(np.complex64), 3)

    filtered = svd_filter(ensemble.astype(np.complex64), 3)

    assert filtered.dtype == np.complex64
    assert np.abs(filtered - expected).max() < 1e-6 * np.abs(expected).max()


def test_single_precision_sums_would_be_wrong():
    """The reason for double precision: the same in complex64 is off by far more at 60 dB."""
    ensemble = tissue_and_blood()[0].astype(np.complex64)
    samples = ensemble.reshape(len(ensemble), -1)
    vectors = np.linalg.eigh(samples @ samples.conj().T)[1][:, ::-1][:, :3]
    careless = samples - vectors @ (vectors.conj().T @ samples)
    expected = full_svd_filter(ensemble, 3).reshape(samples.shape)

    assert np.abs(careless - expected).max() > 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("clutter_db", [20.0, 40.0, 60.0])
def test_automatic_rank_shows_the_vessel(clutter_db):
    """Whatever the clutter, blood stands 10 dB above what is left of the tissue."""
    ensemble, vessel = tissue_and_blood(clutter_db)

    power = power_doppler(svd_filter(ensemble))

    assert power_doppler(ensemble)[vessel].mean() < 1.2 * power_doppler(ensemble)[~vessel].mean()
    assert power[vessel].mean() > 10 * power[~vessel].mean()


def test_rank_of_still_tissue_is_one():
    """Tissue that does not move at all is one component; the rest of the curve is flat."""
    assert clutter_rank(np.array([1e6, *np.linspace(2.0, 1.0, 19)])) == 1


def test_rank_zero_keeps_everything():
    """No component is taken out."""
    ensemble, _ = tissue_and_blood(size=8)

    assert np.allclose(svd_filter(ensemble, 0), ensemble, rtol=1e-14)


def test_still_tissue_alone_leaves_nothing():
    """What is the same in all pulses is clutter of rank 1."""
    still = np.ones((10, 6, 5), np.complex128) * np.arange(1, 31).reshape(6, 5)

    assert np.abs(svd_filter(still)).max() < 1e-12 * np.abs(still).max()


@pytest.mark.slow
def test_filter_is_several_times_faster_than_a_full_decomposition():
    """For 20 pulses of 256 x 256: the small matrix instead of the tall one."""
    ensemble = tissue_and_blood(size=256)[0].astype(np.complex64)

    def cpu_s(work):
        times = []
        for _ in range(5):
            begin = time.process_time()
            work()
            times.append(time.process_time() - begin)
        return min(times)

    full = cpu_s(lambda: np.linalg.svd(ensemble.reshape(20, -1), full_matrices=False))

    assert cpu_s(lambda: svd_filter(ensemble)) < full / 3


def test_an_empty_image_stays_empty():
    """Zeros have no components, which is no reason to fail."""
    assert not svd_filter(np.zeros((4, 3, 3), np.complex64)).any()


def test_views_that_are_not_contiguous():
    """A part of a larger ensemble is filtered as its copy is, and is not changed."""
    ensemble, _ = tissue_and_blood(size=16)
    part = ensemble[::2, 3:13, ::-1]
    before = part.copy()

    assert np.array_equal(svd_filter(part, 2), svd_filter(before, 2))
    assert np.array_equal(part, before)


@pytest.mark.parametrize(
    ("pulses", "rank", "sentence"),
    [
        (1, "auto", "at least 2 pulses, got 1"),
        (4, 4, "from 0 to 3 for 4 pulses, got 4"),
        (4, -1, "from 0 to 3 for 4 pulses, got -1"),
    ],
)
def test_ensembles_that_cannot_be_filtered(pulses, rank, sentence):
    """One pulse has no tissue to tell from blood, and some component must be left."""
    with pytest.raises(ScanError, match=sentence):
        svd_filter(np.ones((pulses, 3, 3), np.complex64), rank)


def test_samples_that_are_not_numbers():
    """One NaN would spread over the whole frame."""
    ensemble = np.ones((4, 3, 3), np.complex64)
    ensemble[2, 1, 1] = np.nan

    with pytest.raises(ScanError, match="not numbers"):
        svd_filter(ensemble)

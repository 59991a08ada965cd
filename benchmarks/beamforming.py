"""Speed of the imaging chain, beside the beamformers that can be installed and plain NumPy.

Timed: CPU time of one thread, the smallest of several runs, on the paper's grid: 31 plane
waves, 128 elements, 2048 samples, 256 x 256 pixels, f-number 1.5; one-way (photoacoustic) at
f-number 1; the clutter filter of 20 pulses; Lee's filter of 7 x 7. Left out: compiling, making
the recording. Beamformers start from IQ samples, ours from RF too. PyMUST's matrices are made
and applied for one plane wave and counted 31 times.

    pip install -e '.[bench]'
    OMP_NUM_THREADS=1 python benchmarks/beamforming.py

``pip install ustb`` adds its row.
"""

import contextlib
import dataclasses
import importlib
import io
import os
import time
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numba
import numpy as np
import torch
from scipy.ndimage import uniform_filter

from sonosweep.imaging import (
    PAPER_GRID,
    BeamformSettings,
    beamform,
    demodulate,
    prepare_beamformer,
)
from sonosweep.imaging.clutter import svd_filter
from sonosweep.imaging.das_torch import TorchBeamformer
from sonosweep.imaging.despeckle import RAYLEIGH_VARIATION, lee_filter
from sonosweep.scan import ChannelData, Probe

TRANSMITS, ELEMENTS, SAMPLES = 31, 128, 2048
PITCH_MM = 0.3
FREQUENCY_HZ, SPEED_M_PER_S = 7.6e6, 1540.0
ANGLES_RAD = np.deg2rad(np.linspace(-15, 15, TRANSMITS))
ALIKE = 0.999
"""Complex correlation that tells that a peer made the same image."""
RUNS = 3


def main() -> None:
    """Print the times and their ratios."""
    if os.environ.get("OMP_NUM_THREADS") != "1":
        raise SystemExit("run as OMP_NUM_THREADS=1 python benchmarks/beamforming.py")
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    compare_plane_waves()
    compare_photoacoustics()
    compare_filters()


def compare_plane_waves() -> None:
    """Time compounded plane waves."""
    rf = recording()
    prepared = prepare_beamformer(rf, PAPER_GRID)
    iq = in_baseband(rf)
    samples = iq.samples[0]
    from_iq = prepare_beamformer(iq, PAPER_GRID)
    image = from_iq.apply(samples)
    print(f"{TRANSMITS} plane waves, {ELEMENTS} elements, {SAMPLES} samples to 256 x 256:")
    ours = row("prepared, from IQ", lambda: from_iq.apply(samples))
    row("prepared, from RF", lambda: prepared.apply(rf.samples[0]), ours)
    row("direct, from IQ", lambda: beamform(iq, 0, PAPER_GRID), ours)
    row("direct, from RF", lambda: beamform(rf, 0, PAPER_GRID), ours)
    row("preparing", lambda: prepare_beamformer(rf, PAPER_GRID), ours)
    in_torch, tensor = TorchBeamformer(prepared), torch.from_numpy(samples)
    row("torch on the CPU, prepared, from IQ", lambda: in_torch(tensor), ours, runs=1)
    print(f"  memory of the prepared delays: {prepared.memory_bytes / 1e6:.0f} MB")
    pymust = peer("pymust", "pip install -e '.[bench]'")
    if pymust is not None:
        must_rows(pymust, iq, ours)
    ustb = peer("ustb", "pip install ustb")
    if ustb is not None:
        ustb_row(iq, image, ours)


def compare_photoacoustics() -> None:
    """Time one laser shot."""
    samples = np.asarray(recording().samples[0])[:1]
    rf = dataclasses.replace(recording(), samples=samples[None], transmit_delays_s=None)
    settings = BeamformSettings(f_number=1.0)
    prepared = prepare_beamformer(rf, PAPER_GRID, settings)
    print(f"photoacoustic, {ELEMENTS} elements, {SAMPLES} samples to 256 x 256:")
    ours = row("prepared, from RF", lambda: prepared.apply(samples), runs=10)
    row("direct, from RF", lambda: beamform(rf, 0, PAPER_GRID, settings), ours)
    pymust = peer("pymust", "pip install -e '.[bench]'")
    if pymust is None:
        return
    iq = in_baseband(rf)
    probe = must_probe(pymust, 1.0)
    probe.passive = True
    column = iq.samples[0][0].T.astype(np.complex128).ravel(order="F")
    silent = np.zeros((1, ELEMENTS))
    row("PyMUST dasmtx, building", lambda: must_matrix(pymust, probe, silent), ours, runs=1)
    matrix = must_matrix(pymust, probe, silent)
    row("PyMUST, prepared, from IQ", lambda: matrix @ column, ours)


def compare_filters() -> None:
    """Time the clutter filter and Lee's filter."""
    rng = np.random.default_rng(1)
    shape = (20, 256, 256)
    ensemble = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    print("clutter filter, 20 pulses of 256 x 256:")
    ours = row("Gram matrix, double precision", lambda: svd_filter(ensemble, 4), runs=10)
    row("NumPy's full SVD, single precision", lambda: numpy_svd_filter(ensemble, 4), ours)
    amplitude = np.abs(ensemble[0])
    print("Lee's filter, 7 x 7, of 256 x 256:")
    ours = row("ours", lambda: lee_filter(amplitude, 7), runs=10)
    row("SciPy's uniform_filter", lambda: scipy_lee(amplitude, 7), ours, runs=10)


def recording() -> ChannelData:
    """Return noise received after plane waves: speed does not depend on what was received."""
    rng = np.random.default_rng(0)
    lateral = (np.arange(ELEMENTS) - (ELEMENTS - 1) / 2) * PITCH_MM
    positions = torch.zeros(ELEMENTS, 3, dtype=torch.float64)
    positions[:, 0] = torch.from_numpy(lateral)
    delays = np.sin(ANGLES_RAD)[:, None] * lateral * 1e-3 / SPEED_M_PER_S
    return ChannelData(
        "noise",
        rng.standard_normal((1, TRANSMITS, ELEMENTS, SAMPLES), np.float32),
        Probe("L11-5v", positions, 0.27, FREQUENCY_HZ),
        4 * FREQUENCY_HZ,
        transmit_delays_s=torch.from_numpy(delays),
    )


def in_baseband(rf: ChannelData) -> ChannelData:
    """Return a recording as IQ."""
    iq = demodulate(rf.samples[0], 4 * FREQUENCY_HZ, FREQUENCY_HZ)
    return dataclasses.replace(rf, samples=iq[None], demodulation_frequency_hz=FREQUENCY_HZ)


def must_probe(pymust: ModuleType, f_number: float) -> Any:  # PyMUST has no types
    """Return the probe as PyMUST knows it."""
    probe = pymust.getparam("L11-5v")
    probe.fs, probe.c, probe.fnumber = 4 * FREQUENCY_HZ, SPEED_M_PER_S, f_number
    return probe


def must_matrix(pymust: ModuleType, probe: Any, delays_s: np.ndarray) -> Any:
    """Return PyMUST's delay-and-sum matrix of one transmit."""
    x, z = np.meshgrid(PAPER_GRID.lateral_mm * 1e-3, PAPER_GRID.axial_mm * 1e-3)
    size = 1j * np.array([SAMPLES, ELEMENTS])
    return pymust.dasmtx(size, x, z, delays_s, probe).tocsr()


def must_rows(pymust: ModuleType, iq: ChannelData, ours: float) -> None:
    """Time PyMUST and check that its image of one transmit is like ours."""
    assert iq.transmit_delays_s is not None
    probe = must_probe(pymust, 1.5)
    delays = iq.transmit_delays_s.numpy()[TRANSMITS // 2][None]
    received = iq.samples[0][TRANSMITS // 2]
    column = received.T.astype(np.complex128).ravel(order="F")
    row(
        "PyMUST dasmtx, building",
        lambda: must_matrix(pymust, probe, delays),
        ours,
        runs=1,
        times=TRANSMITS,
    )
    matrix = must_matrix(pymust, probe, delays)
    row("PyMUST, prepared, from IQ", lambda: matrix @ column, ours, times=TRANSMITS)
    alone = dataclasses.replace(
        iq,
        samples=received[None, None],
        transmit_delays_s=torch.from_numpy(delays),
    )
    theirs = (matrix @ column).reshape(256, 256, order="F")
    check_alike("PyMUST", beamform(alone, 0, PAPER_GRID), theirs)


def ustb_row(iq: ChannelData, image: np.ndarray, ours: float) -> None:
    """Time USTB's beamformer and check that its image is like ours."""
    uff, ustb = importlib.import_module("pyuff_ustb"), importlib.import_module("ustb")
    das = ustb.midprocess.DAS()
    das.scan = uff.LinearScan(
        x_axis=PAPER_GRID.lateral_mm * 1e-3, z_axis=PAPER_GRID.axial_mm * 1e-3
    )
    das.channel_data = uff.ChannelData(
        sampling_frequency=4 * FREQUENCY_HZ,
        initial_time=0.0,
        sound_speed=SPEED_M_PER_S,
        modulation_frequency=FREQUENCY_HZ,
        probe=uff.LinearArray(N=ELEMENTS, pitch=PITCH_MM * 1e-3),
        sequence=[
            uff.Wave(
                wavefront=uff.Wavefront.plane,
                source=uff.Point(azimuth=angle, elevation=0.0, distance=np.inf),
                sound_speed=SPEED_M_PER_S,
            )
            for angle in ANGLES_RAD
        ],
        data=np.ascontiguousarray(iq.samples[0].transpose(2, 1, 0)),
    )
    das.receive_apodization = ustb.apodization.Apodization()
    das.receive_apodization.window = ustb.Window.boxcar
    das.receive_apodization.f_number = 1.5

    def run() -> np.ndarray:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it computes positions of sources at infinity
            return das.go().data

    row("ustb DAS, direct, from IQ", run, ours, runs=1)
    theirs = run().reshape(256, 256, order="F")
    depth_m = PAPER_GRID.axial_mm[:, None] * 1e-3
    carrier = np.exp(4j * np.pi * FREQUENCY_HZ * depth_m / SPEED_M_PER_S)
    check_alike("ustb", image, theirs * carrier)


def check_alike(name: str, ours: np.ndarray, theirs: np.ndarray) -> None:
    """Say how alike two images are.

    Raises:
        SystemExit: If they are not: then their times cannot be compared.
    """
    likeness = abs(np.vdot(ours, theirs)) / (np.linalg.norm(ours) * np.linalg.norm(theirs))
    print(f"  complex correlation with {name}'s image: {likeness:.5f}")
    if likeness < ALIKE:
        raise SystemExit(f"{name} made another image")


def numpy_svd_filter(ensemble: np.ndarray, rank: int) -> np.ndarray:
    """Return the ensemble without its strongest components, by the textbook."""
    casorati = ensemble.reshape(len(ensemble), -1).T
    u, s, vh = np.linalg.svd(casorati, full_matrices=False)
    s[:rank] = 0
    return ((u * s) @ vh).T.reshape(ensemble.shape)


def scipy_lee(amplitude: np.ndarray, window: int) -> np.ndarray:
    """Return Lee's filter from SciPy's box means."""
    mean = uniform_filter(amplitude, window)
    variance = uniform_filter(amplitude * amplitude, window) - mean * mean
    speckle = (RAYLEIGH_VARIATION * mean) ** 2
    gain = np.clip((variance - speckle) / ((1 + RAYLEIGH_VARIATION**2) * variance), 0, 1)
    return mean + gain * (amplitude - mean)


def peer(name: str, install: str) -> ModuleType | None:
    """Return a module, or say how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f"  {name} is not installed: {install}")
        return None


def row(
    name: str,
    work: Callable[[], object],
    reference_s: float | None = None,
    runs: int = RUNS,
    times: int = 1,
) -> float:
    """Print a row and return its CPU seconds: the smallest of several runs, after a first."""
    work()
    seconds = []
    for _ in range(runs):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    smallest = min(seconds) * times
    ratio = "" if reference_s is None else f"  {smallest / reference_s:6.1f} x"
    print(f"  {name:36s} {smallest * 1e3:9.1f} ms{ratio}")
    return smallest


if __name__ == "__main__":
    main()

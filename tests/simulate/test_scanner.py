"""What a scanner makes of echoes."""

from dataclasses import replace

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.imaging import PAPER_GRID
from sonosweep.simulate import Beam, Tissue
from sonosweep.simulate.attenuation import ATTENUATION_DB_PER_CM_MHZ
from sonosweep.simulate.scanner import (
    Scanner,
    detect,
    fill_with_gel,
    gray_levels,
    gray_map,
    prepare_scanner,
    receive_echoes,
    remaining_amplitude,
)

SILENT = -300.0
CLEAN = Scanner(
    attenuation_scale=1.0,
    tgc_db_per_mm=0.0,
    noise_db=SILENT,
    side_lobe_db=SILENT,
    haze_db=SILENT,
    bone_db=SILENT,
)
SHAPE = (PAPER_GRID.rows, PAPER_GRID.columns)
MEGAHERTZ = Beam().center_frequency_hz * 1e-6


def random(seed: int = 1) -> np.random.Generator:
    """Return random numbers."""
    return np.random.default_rng(seed)


def speckle(seed: int = 2) -> np.ndarray:
    """Return fully developed speckle of power 1, independent in every pixel."""
    parts = random(seed).standard_normal((*SHAPE, 2)).astype(np.float32) / np.sqrt(2)
    return np.ascontiguousarray(parts, np.float32).view(np.complex64)[..., 0]


def tissue(label: Tissue = Tissue.MUSCLE) -> np.ndarray:
    """Return one tissue everywhere."""
    return np.full(SHAPE, int(label), np.uint8)


def receive(scanner: Scanner, iq: np.ndarray, labels: np.ndarray, seed: int = 3) -> np.ndarray:
    """Return what one frame becomes."""
    prepared = prepare_scanner(scanner, Beam(), PAPER_GRID, random(seed))
    return receive_echoes(iq, labels, prepared, random(seed + 1))


def level_db(iq: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Return the mean power."""
    return 10 * np.log10((np.abs(iq) ** 2).mean(axis=axis))


@pytest.mark.parametrize(
    ("label", "scale"), [(Tissue.MUSCLE, 1.0), (Tissue.MUSCLE, 0.6), (Tissue.FAT, 1.0)]
)
def test_echoes_fade_at_the_attenuation_of_the_tissue(label: Tissue, scale: float) -> None:
    """Two ways through a uniform phantom cost twice its attenuation at the frequency."""
    received = receive(replace(CLEAN, attenuation_scale=scale), speckle(), tissue(label))
    slope = np.polyfit(PAPER_GRID.axial_mm, level_db(received, axis=1), 1)[0]
    expected = -2 * ATTENUATION_DB_PER_CM_MHZ[label] * scale * MEGAHERTZ / 10
    assert slope == pytest.approx(expected, abs=0.01)  # 5.6 dB / sqrt(256) per row, 256 rows


def test_loss_counts_from_the_face() -> None:
    """The first row has lost what lies between it and the face, and so has each pixel."""
    prepared = prepare_scanner(CLEAN, Beam(), PAPER_GRID, random())
    left = 20 * np.log10(remaining_amplitude(tissue(), prepared))
    per_mm = 2 * ATTENUATION_DB_PER_CM_MHZ[Tissue.MUSCLE] * MEGAHERTZ / 10
    assert np.allclose(left, -per_mm * PAPER_GRID.axial_mm[:, np.newaxis], atol=2e-3)
    echoes = np.ones(SHAPE, np.complex64)
    received = receive_echoes(echoes, tissue(), prepared, random())
    assert np.allclose(20 * np.log10(np.abs(received)), left, atol=2e-3)  # single precision


def test_time_gain_compensation_undoes_attenuation() -> None:
    """The right slope makes a uniform phantom uniform; sliders bend it where they are."""
    per_mm = 2 * ATTENUATION_DB_PER_CM_MHZ[Tissue.MUSCLE] * MEGAHERTZ / 10
    flat = receive(replace(CLEAN, tgc_db_per_mm=per_mm), speckle(), tissue())
    assert np.polyfit(PAPER_GRID.axial_mm, level_db(flat, axis=1), 1)[0] == pytest.approx(
        0, abs=0.01
    )
    bent = receive(
        replace(CLEAN, tgc_db_per_mm=per_mm, sliders_db=(0.0, 6.0, 0.0)), speckle(), tissue()
    )
    gain = level_db(bent, axis=1) - level_db(flat, axis=1)
    assert gain[[0, 64, 128, 255]] == pytest.approx([0, 3.0, 6.0, 0], abs=0.05)


def test_bone_throws_a_shadow() -> None:
    """Behind 6 mm of bone nothing but noise is left, beside it nothing changes."""
    labels = tissue()
    labels[60:, 100:150] = int(Tissue.BONE)
    scanner = replace(CLEAN, noise_db=-90.0)
    clear, shadowed = (receive(scanner, speckle(), plane) for plane in (tissue(), labels))
    assert np.array_equal(clear[:, :100], shadowed[:, :100])
    assert level_db(shadowed[110:, 100:150]) == pytest.approx(-90, abs=0.3)
    assert level_db(shadowed[:60, 100:150]) == pytest.approx(level_db(clear[:60, 100:150]))


def test_bone_facing_the_probe_is_bright() -> None:
    """A flat surface echoes at its level, a steep one far less; the brightest row is its own."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    flat, steep = tissue(Tissue.GEL), tissue(Tissue.GEL)
    flat[rows >= 100] = int(Tissue.BONE)
    steep[rows >= 40 + columns] = int(Tissue.BONE)
    scanner = replace(CLEAN, bone_db=20.0)
    bright, faint = (
        np.abs(receive(scanner, np.zeros(SHAPE, np.complex64), plane)) for plane in (flat, steep)
    )
    assert np.all(bright.argmax(axis=0) == 100)
    gel = ATTENUATION_DB_PER_CM_MHZ[Tissue.GEL] * (PAPER_GRID.axial_mm[100] - 0.0742)
    bone = ATTENUATION_DB_PER_CM_MHZ[Tissue.BONE] * 0.0742  # half a row
    loss = 2 * (gel + bone) * MEGAHERTZ / 10
    assert 20 * np.log10(bright[100, 128]) == pytest.approx(20 - loss, abs=0.01)
    assert 20 * np.log10(bright[100, 128] / faint[:, 128].max()) > 15


def test_noise_has_its_level_and_grows_with_gain() -> None:
    """Without echoes, the first rows show the noise and deeper ones the gain on top."""
    silence = np.zeros(SHAPE, np.complex64)
    noise = receive(replace(CLEAN, noise_db=-70.0, tgc_db_per_mm=0.5), silence, tissue())
    slope, start = np.polyfit(PAPER_GRID.axial_mm, level_db(noise, axis=1), 1)
    assert slope == pytest.approx(0.5, abs=0.01)
    assert start == pytest.approx(-70, abs=0.2)  # 65536 samples, about a third independent


def test_side_lobes_fill_what_is_silent() -> None:
    """A cyst shows clutter of its surroundings, of the level that the side lobes add up to."""
    prepared = prepare_scanner(replace(CLEAN, side_lobe_db=-30.0), Beam(), PAPER_GRID, random())
    echoes = speckle()
    echoes[:, 120:136] = 0
    received = receive_echoes(echoes, tissue(Tissue.GEL), prepared, random())
    lobes = prepared.side_lobes
    reaching = [
        np.abs(lobes.amplitudes[(c - lobes.lags < 120) | (c - lobes.lags >= 136)]) ** 2
        for c in range(120, 136)
    ]
    expected = 10 * np.log10(np.mean([power.sum() for power in reaching]))
    contrast = level_db(received[40:, 120:136]) - level_db(received[40:, :120])
    assert contrast == pytest.approx(expected, abs=0.4)  # 3456 samples and the cyst's own part
    assert -30 < expected < -15


def test_haze_belongs_to_the_probe() -> None:
    """Reverberation has its level at the face, fades with depth and is the same every time."""
    scanner = replace(CLEAN, haze_db=-25.0, haze_mm=1.5)
    silence = np.zeros(SHAPE, np.complex64)
    prepared = prepare_scanner(scanner, Beam(), PAPER_GRID, random())
    first, second = (receive_echoes(silence, tissue(), prepared, random(k)) for k in (1, 2))
    assert np.allclose(first, second, atol=1e-12)
    shallow, deep = level_db(first[:7]), level_db(first[40:47])
    fading = 10 * np.log10(np.exp(-2 * PAPER_GRID.axial_mm[:7] / 1.5).mean())
    assert shallow == pytest.approx(-25 + fading, abs=3)  # 7 rows of about 6 speckles
    assert shallow - deep > 25


def test_gray_levels_follow_decibels() -> None:
    """White is at -gain, black a dynamic range below; gray levels are linear in dB between."""
    scanner = Scanner(gain_db=-10.0, dynamic_range_db=50.0)
    decibels = np.array([[20.0, 10.0, -2.5, -15.0, -27.5, -40.0, -60.0]])
    levels = gray_levels((10 ** (decibels / 20)).astype(np.float32), scanner)
    assert levels[0].tolist() == pytest.approx([255, 255, 191, 128, 64, 0, 0], abs=1)


def test_gray_maps_keep_black_white_and_order() -> None:
    """Gamma below 1 brightens, contrast darkens what is dark; neither swaps two levels."""
    straight = gray_map(Scanner())
    assert np.array_equal(straight, np.arange(256))
    for scanner in (Scanner(gray_gamma=0.8), Scanner(gray_contrast=1.0)):
        bent = gray_map(scanner).astype(int)
        assert (bent[0], bent[255]) == (0, 255)
        assert (np.diff(bent) >= 0).all()
    assert gray_map(Scanner(gray_gamma=0.8))[64] > 64 > gray_map(Scanner(gray_contrast=1.0))[64]


def test_persistence_averages_independent_frames() -> None:
    """The mean of k envelopes varies less by sqrt(k), whichever of them came first."""
    frames = [speckle(seed) for seed in range(5)]
    one, five = detect(frames[:1], Scanner()), detect(frames, Scanner())
    ratio = (one.std() / one.mean()) / (five.std() / five.mean())
    assert ratio == pytest.approx(np.sqrt(5), rel=0.02)  # 65536 samples
    assert np.allclose(five, detect(frames[::-1], Scanner()), rtol=1e-6)


def test_speckle_reduction_smooths_speckle_and_keeps_the_mean() -> None:
    """The stronger it is, the less speckle varies."""
    variation = []
    for strength in (0.0, 0.5, 1.0):
        amplitude = detect([speckle()], Scanner(speckle_reduction=strength))
        variation.append(amplitude.std() / amplitude.mean())
        assert amplitude.mean() == pytest.approx(np.sqrt(np.pi) / 2, rel=0.01)
    assert variation[0] == pytest.approx(0.523, rel=0.02)
    assert variation[0] > variation[1] + 0.1 > variation[2] + 0.2


def test_the_same_seed_gives_the_same_echoes() -> None:
    """What is received depends on the echoes and the noise alone."""
    prepared = prepare_scanner(Scanner(), Beam(), PAPER_GRID, random())
    first, second, other = (
        receive_echoes(speckle(), tissue(), prepared, random(seed)) for seed in (5, 5, 6)
    )
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_gel_couples_what_the_face_does_not_touch() -> None:
    """Air above the skin is filled with gel; air behind the body stays."""
    labels = np.array([[0, 5], [5, 5], [0, 0]], np.uint8)
    fill_with_gel(labels)
    assert labels.tolist() == [[int(Tissue.GEL), 5], [5, 5], [0, 0]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"persistence_frames": 2}, r"odd number of frames .*got 2"),
        ({"dynamic_range_db": 0.0}, r"dynamic_range_db of a scanner must be above 0"),
        ({"noise_db": float("nan")}, r"noise_db of a scanner must be a number"),
        ({"speckle_reduction": 1.5}, r"speckle_reduction must be from 0 to 1, got 1.5"),
        ({"attenuation_scale": -1.0}, r"attenuation of 0 or more"),
    ],
)
def test_impossible_settings_are_refused(change: dict, message: str) -> None:
    """One sentence says which knob is wrong."""
    with pytest.raises(ScanError, match=message):
        Scanner(**change)


def test_echoes_that_are_not_numbers_are_refused() -> None:
    """One NaN among the echoes is found."""
    echoes = speckle()
    echoes[100, 100] = np.nan
    with pytest.raises(ScanError, match="not numbers"):
        receive(Scanner(), echoes, tissue())

"""Delay-and-sum against PyMUST, against brute force, and against what physics demands."""

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sonosweep.errors import ScanError
from sonosweep.imaging import (
    BeamformSettings,
    PixelGrid,
    SectorGrid,
    beamform,
    centered_grid,
    demodulate,
    prepare_beamformer,
)
from sonosweep.scan import ChannelData, Probe
from tests.imaging.arrays import (
    FREQUENCY_HZ,
    SPEED_MM_PER_S,
    correlation,
    golden,
    half_width_mm,
    linear_probe,
    patch,
    peak_mm,
    plane_delays,
    probe_at,
    record,
)

FLOAT32 = 5e-5
"""Sums of a hundred float32 terms, and delays rounded to a thousandth of a sample's rise."""
DEPTH_MM, LATERAL_MM = 5e-3, 10e-3
"""How far a point may be off (issue 3)."""
GRID = PixelGrid(23, 31, (0.41, 0.33), (-4.3, 0.9))


def noise(rf: bool = False, transmits: int = 3, frames: int = 1) -> ChannelData:
    """Return random samples of angled plane waves that start at different times."""
    rng = np.random.default_rng(4)
    probe = linear_probe(48)
    shape = (frames, transmits, 48, 500)
    samples = rng.standard_normal(shape).astype(np.float32)
    if not rf:
        samples = samples + 1j * rng.standard_normal(shape).astype(np.float32)
    return ChannelData(
        "noise",
        samples,
        probe,
        4 * FREQUENCY_HZ,
        demodulation_frequency_hz=0.0 if rf else FREQUENCY_HZ,
        start_time_s=torch.linspace(1e-6, 2e-6, transmits, dtype=torch.float64),
        transmit_delays_s=torch.from_numpy(plane_delays(probe, np.linspace(-8, 11, transmits))),
    )


def delayed(data: ChannelData, transmit: int, later_s: float, times: float = 1.0) -> ChannelData:
    """Return the data with the delays of one transmit multiplied and later."""
    assert data.transmit_delays_s is not None
    delays = data.transmit_delays_s.clone()
    delays[transmit] = times * delays[transmit] + later_s
    return dataclasses.replace(data, transmit_delays_s=delays)


def brute_force(data: ChannelData, grid: PixelGrid, settings: BeamformSettings) -> NDArray:
    """Return the image of plane waves by the textbook, a pixel at a time in double precision."""
    assert data.transmit_delays_s is not None
    assert data.start_time_s is not None
    assert settings.f_number is not None
    lateral = data.probe.element_positions_mm.numpy()[:, 0]
    delays = data.transmit_delays_s.numpy()
    sines = delays[:, -1] / lateral[-1] * SPEED_MM_PER_S
    samples = np.asarray(data.samples[0])
    images = np.zeros((len(delays), grid.rows, grid.columns), complex)
    wavelength_mm = SPEED_MM_PER_S / data.probe.center_frequency_hz
    for row, column in np.ndindex(grid.rows, grid.columns):
        x, y = grid.lateral_mm[column], grid.axial_mm[row]
        path = np.hypot(x - lateral, y)
        sine = np.abs(x - lateral) / path
        offset = np.abs(x - lateral) / (y / (2 * settings.f_number))
        weight = window(settings.window, offset) * (offset <= 1 + 1e-9)
        if settings.directivity:
            weight = weight * y / path * np.sinc(0.27 / wavelength_mm * sine)
        for t, steer in enumerate(sines):
            sent = (x * steer + y * np.sqrt(1 - steer**2)) / SPEED_MM_PER_S
            time = sent + path / SPEED_MM_PER_S
            at = (time - float(data.start_time_s[t])) * data.sampling_frequency_hz
            carrier = np.exp(2j * np.pi * data.demodulation_frequency_hz * time)
            values = interpolate(samples[t], at, settings.interpolation == "cubic")
            images[t, row, column] = (weight * carrier * values).sum()
    return images


def window(name: str, offset: NDArray) -> NDArray:
    """Return a window's value at offsets of 0 (middle) to 1 (edge)."""
    offset = np.minimum(offset, 1)
    if name == "hann":
        return np.cos(np.pi / 2 * offset) ** 2
    if name == "tukey":
        return np.where(offset < 0.5, 1, np.cos(np.pi * (offset - 0.5)) ** 2)
    return np.ones_like(offset)


def interpolate(signals: NDArray, positions: NDArray, cubic: bool) -> NDArray:
    """Return each channel's value at a position, of the polynomial through 2 or 4 samples.

    Beyond the recording samples are 0, and a sample away from it so is the signal.
    """
    values = np.zeros(len(positions), complex)
    nodes = np.arange(-1, 3) if cubic else np.arange(2)
    first = np.floor(positions).astype(int)
    count = signals.shape[1]
    for node in nodes:
        place = first + node
        known = (place >= 0) & (place < count) & (positions > -1) & (positions < count)
        sample = signals[np.arange(len(signals)), np.clip(place, 0, count - 1)]
        others = nodes[nodes != node]
        factor = ((positions - first)[:, None] - others).prod(1) / (node - others).prod()
        values += np.where(known, factor * sample, 0)
    return values


@pytest.fixture(scope="module")
def points() -> tuple[ChannelData, dict[str, NDArray]]:
    """Return PyMUST's recording of three points, 31 plane waves."""
    return golden("pymust_points.npz")


@pytest.mark.parametrize("point", [0, 1, 2])
def test_points_lie_where_pymust_put_them(points, point):
    """The envelope of a point peaks within 5 micrometers in depth and 10 laterally."""
    data, stored = points
    x, y = stored["points_mm"][point]
    grid = patch(x, y, half_mm=0.5)

    lateral, axial = peak_mm(beamform(data, 0, grid), grid)

    assert abs(axial - y) < DEPTH_MM
    assert abs(lateral - x) < LATERAL_MM


def test_the_resolution_is_that_of_the_probe(points):
    """31 angles within 15 degrees, f-number 1.5: 167 by 343 micrometers at 20 mm depth."""
    data, _ = points
    across, down = PixelGrid(81, 1, (0.02, 0.02), (-0.8, 20.0)), patch(0, 20, 0.5)

    lateral = half_width_mm(np.abs(beamform(data, 0, across))[0], 0.02)
    axial = half_width_mm(np.abs(beamform(data, 0, down))[:, 25], 0.02)

    assert axial == pytest.approx(0.167, abs=0.003)
    assert lateral == pytest.approx(0.343, abs=0.005)


def test_speckle_is_that_of_pymust():
    """The complex image of tissue with a cyst is PyMUST's own, in phase and in height."""
    data, stored = golden("pymust_speckle.npz")
    x, y = stored["lateral_mm"], stored["axial_mm"]
    grid = PixelGrid(
        len(x), len(y), (float(x[1] - x[0]), float(y[1] - y[0])), (float(x[0]), float(y[0]))
    )

    image = len(data.samples[0]) * beamform(data, 0, grid)

    theirs = stored["image"]
    assert correlation(image, theirs) > 0.9995
    np.testing.assert_allclose(np.vdot(theirs, image) / np.vdot(theirs, theirs), 1, atol=2e-3)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize(
    ("window_name", "directivity"), [("boxcar", False), ("hann", True), ("tukey", False)]
)
def test_the_sum_is_the_textbook_one(interpolation, window_name, directivity):
    """Every pixel is the weighted sum of the samples at its times of flight."""
    data = noise()
    settings = BeamformSettings(
        1.2, window_name, interpolation, directivity=directivity, compound=False
    )

    image = beamform(data, 0, GRID, settings)

    expected = brute_force(data, GRID, settings)
    np.testing.assert_allclose(image, expected, atol=FLOAT32 * np.abs(expected).max())


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_all_ways_give_the_same_numbers(interpolation):
    """Direct, prepared, in threads, in batches and in torch, the image is the same."""
    from sonosweep.imaging.das_torch import TorchBeamformer

    data = noise(frames=2)
    settings = BeamformSettings(1.2, interpolation=interpolation)
    direct = np.stack([beamform(data, frame, GRID, settings) for frame in range(2)])
    prepared = prepare_beamformer(data, GRID, settings)

    np.testing.assert_array_equal(prepared.apply(data.samples), direct)
    np.testing.assert_array_equal(beamform(data, 1, GRID, settings, threads=3), direct[1])
    in_torch = TorchBeamformer(prepared)(torch.from_numpy(data.samples))
    np.testing.assert_allclose(in_torch, direct, atol=FLOAT32 * np.abs(direct).max())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_gives_the_same_numbers():
    """The image does not depend on the device."""
    from sonosweep.imaging.das_torch import TorchBeamformer

    data = noise()
    prepared = prepare_beamformer(data, GRID)
    on_gpu = TorchBeamformer(prepared).cuda()(torch.from_numpy(data.samples).cuda())

    expected = prepared.apply(data.samples)
    np.testing.assert_allclose(on_gpu.cpu(), expected, atol=FLOAT32 * np.abs(expected).max())


def test_gradients_reach_the_samples():
    """Beamforming is linear: the gradient of <image, z> carries all of <image, z> again."""
    from sonosweep.imaging.das_torch import TorchBeamformer

    data = noise(transmits=2)
    beamformer = TorchBeamformer(prepare_beamformer(data, GRID))
    samples = torch.from_numpy(data.samples[0]).requires_grad_()
    image = beamformer(samples)
    other = torch.from_numpy(np.random.default_rng(1).standard_normal(image.shape))
    product = (image * other).sum().real

    product.backward()

    assert samples.grad is not None
    again = (samples.grad.conj() * samples.detach()).sum().real
    assert float(again) == pytest.approx(float(product.detach()), rel=1e-4)


def test_the_image_is_linear_in_the_samples():
    """The image of a sum is the sum of the images."""
    one, other = noise(), noise(frames=2)
    both = dataclasses.replace(one, samples=2 * one.samples - 3j * other.samples[1:])

    image = beamform(both, 0, GRID)

    expected = 2 * beamform(one, 0, GRID) - 3j * beamform(other, 1, GRID)
    np.testing.assert_allclose(image, expected, atol=FLOAT32 * np.abs(expected).max())


def test_a_moved_scatterer_moves_the_image():
    """A pitch to the side and 0.3 mm down, the image of a point does so too."""
    probe = linear_probe(64)
    delays = plane_delays(probe, np.array([-6.0, 0.0, 6.0]))
    grid = patch(0.2, 10.1, 0.8, 0.05)
    peaks = [
        peak_mm(beamform(record(probe, np.array([place]), delays_s=delays), 0, grid), grid)
        for place in ((0.05, 10.0), (0.35, 10.3))
    ]

    moved = np.subtract(peaks[1], peaks[0])

    assert abs(moved[1] - 0.3) < DEPTH_MM
    assert abs(moved[0] - 0.3) < LATERAL_MM


def test_the_phase_tells_depth():
    """At a point the signal's phase is 0; it turns by 2 pi in half a wavelength of depth."""
    probe = linear_probe(64)
    data = record(probe, np.array([[0.0, 10.0]]), delays_s=plane_delays(probe, np.zeros(1)))
    wavelength_mm = SPEED_MM_PER_S / FREQUENCY_HZ
    grid = PixelGrid(1, 3, (0.1, wavelength_mm / 8), (0.0, 10.0 - wavelength_mm / 8))

    phases = np.angle(beamform(data, 0, grid, BeamformSettings(4.0)))[:, 0]

    np.testing.assert_allclose(phases, [-np.pi / 2, 0, np.pi / 2], atol=0.05)


def focused(probe: Probe, x: float, y: float) -> NDArray:
    """Return delays that focus at a point, or diverge from it if it lies behind the array."""
    lateral = probe.element_positions_mm.numpy()[:, 0]
    path = np.hypot(lateral - x, y) / SPEED_MM_PER_S
    return path[None] - path.min() if y < 0 else path.max() - path[None]


@pytest.mark.parametrize(
    ("source", "sign"), [((1.0, -12.0), 1), ((0.6, 25.0), -1), ((-0.5, 6.0), 1)]
)
def test_spherical_waves_arrive_as_from_their_center(source, sign):
    """In its cone a wave arrives its distance from the source later, or to the focus earlier."""
    from sonosweep.imaging.aperture import array_shape
    from sonosweep.imaging.transmit import arrival_times, transmitted_waves

    probe = linear_probe(96)
    shape = array_shape(probe)
    assert shape is not None
    delays = focused(probe, *source)
    waves = transmitted_waves(shape.elements_mm, delays, 1540.0, shape)
    points = np.array([[[0.3, 12.0], [-0.9, 15.0], [0.0, 18.0]]])
    apart = np.hypot(points[..., 0] - source[0], points[..., 1] - source[1])
    lateral = shape.elements_mm[:, 0]
    to_source = np.hypot(lateral - source[0], source[1])
    behind = source[1] < 0
    start = delays[0, 0] + (-1 if behind else 1) * to_source[0] / SPEED_MM_PER_S

    times = arrival_times(waves, points)

    micrometers = (times[0] - (start + sign * apart / SPEED_MM_PER_S)) * SPEED_MM_PER_S * 1e3
    assert np.abs(micrometers).max() < 0.1


@pytest.mark.parametrize("source", [(0.4, -15.0), (0.0, 1e6)])
def test_points_are_found_with_other_waves(source):
    """Diverging waves, and focused ones far before their focus, show a point where it is."""
    probe = linear_probe(96)
    data = record(probe, np.array([[1.0, 11.0]]), delays_s=focused(probe, *source))
    grid = patch(1.0, 11.0, 0.6)

    lateral, axial = peak_mm(beamform(data, 0, grid), grid)

    assert abs(axial - 11.0) < DEPTH_MM
    assert abs(lateral - 1.0) < LATERAL_MM


def test_silent_elements_send_nothing():
    """A wave of one element is a circle around it, whatever the others do not do."""
    probe = linear_probe(64)
    delays = np.full((1, 64), np.nan)
    delays[0, 40] = 1e-6
    shifted = np.where(np.isfinite(delays), delays, 1.0)
    data = record(probe, np.array([[0.5, 9.0]]), delays_s=np.zeros((1, 64)))
    x = float(probe.element_positions_mm[40, 0])
    late = (np.hypot(0.5 - x, 9.0) - 9.0) / SPEED_MM_PER_S + shifted[0, 40]
    data = dataclasses.replace(
        data,
        transmit_delays_s=torch.from_numpy(delays),
        start_time_s=torch.tensor([late], dtype=torch.float64),
    )
    grid = patch(0.5, 9.0, 0.6)

    lateral, axial = peak_mm(beamform(data, 0, grid), grid)

    assert abs(axial - 9.0) < DEPTH_MM
    assert abs(lateral - 0.5) < LATERAL_MM


def test_rf_and_iq_of_it_give_the_same_image():
    """It does not matter who demodulates, nor whether the machine rounds to integers."""
    rf = noise(rf=True)
    assert rf.start_time_s is not None
    iq = demodulate(
        rf.samples, 4 * FREQUENCY_HZ, FREQUENCY_HZ, start_time_s=rf.start_time_s.numpy()[:, None]
    )
    data = dataclasses.replace(rf, samples=iq, demodulation_frequency_hz=FREQUENCY_HZ)
    counts = dataclasses.replace(rf, samples=np.rint(rf.samples * 1000).astype(np.int16))

    image = beamform(rf, 0, GRID)

    np.testing.assert_array_equal(beamform(data, 0, GRID), image)
    assert correlation(beamform(counts, 0, GRID), image) > 0.99999


def test_compounding_is_the_mean_of_the_transmits():
    """One image for each transmit, and their mean, come from the same sums."""
    data = noise(frames=2)
    each = BeamformSettings(compound=False)

    images = prepare_beamformer(data, GRID, each).apply(data.samples)

    assert images.shape == (2, 3, 31, 23)
    expected = np.stack([beamform(data, frame, GRID) for frame in range(2)])
    np.testing.assert_allclose(images.mean(1), expected, atol=1e-6)


def test_sector_lines_are_sampled_where_they_run():
    """Samples of a fan are those of a pixel grid at the same places."""
    data = noise()
    fan = SectorGrid(5, 40, 0.1, 0.2, 1.0, 10.0)
    lines = beamform(data, 0, fan)
    distance = 10.0 + fan.depths_mm[30]
    x, y = distance * np.sin(fan.angles_rad[3]), distance * np.cos(fan.angles_rad[3]) - 10

    pixel = beamform(data, 0, PixelGrid(1, 1, (1.0, 1.0), (float(x), float(y))))

    assert lines.shape == (40, 5)
    np.testing.assert_allclose(lines[30, 3], pixel[0, 0], rtol=1e-4)


def test_beyond_the_recording_there_is_nothing():
    """Pixels deeper than the last sample are 0; those above are not."""
    data = noise()
    grid = centered_grid(8, 300, (0.3, 0.1), 5.0)

    image = beamform(data, 0, grid)

    deepest_mm = (2e-6 + 499 / 4 / FREQUENCY_HZ) * SPEED_MM_PER_S / 2
    assert (image[grid.axial_mm > deepest_mm * 1.05] == 0).all()
    assert (image[grid.axial_mm < deepest_mm * 0.9] != 0).all()


def test_slanted_arrays_see_the_same():
    """An array turned by 90 degrees gives the image turned by 90 degrees."""
    data = noise(transmits=1)
    upright = probe_at(np.roll(linear_probe(48).element_positions_mm.numpy()[:, :2], 1, 1))
    turned = dataclasses.replace(data, probe=upright)
    below, beside = (
        PixelGrid(9, 7, (0.3, 0.4), (-1.2, 3.0)),
        PixelGrid(7, 9, (0.4, 0.3), (3.0, -1.2)),
    )

    image = beamform(turned, 0, beside)

    np.testing.assert_allclose(image, beamform(data, 0, below).T, rtol=1e-3, atol=1e-3)


def test_memory_is_told():
    """Twelve bytes for each pixel and element in its aperture, and for each transmit."""
    data = noise()
    settings = BeamformSettings(None)

    prepared = prepare_beamformer(data, GRID, settings)

    assert prepared.memory_bytes == 12 * 23 * 31 * (48 + 3)
    with pytest.raises(ScanError, match=r"23 x 31 pixels take 0\.0 GB, more than the limit"):
        prepare_beamformer(data, GRID, settings, memory_limit_bytes=100_000)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"f_number": 0.0}, "f-number must be above 0, got 0"),
        ({"f_number": float("nan")}, "f-number must be above 0"),
        ({"f_number": None, "window": "hann"}, "hann window needs an f-number"),
        ({"sound_speed_m_per_s": -1.0}, "sound speed must be from 100 to 10000 m/s, got -1"),
        ({"sound_speed_m_per_s": 1.54}, "sound speed must be from 100 to 10000 m/s, got 1.54"),
        ({"bandwidth_hz": 40e6}, "mirror image"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, message):
    """One sentence says which value is wrong."""
    data = noise(rf=True)
    with pytest.raises(ScanError, match=message):
        beamform(data, 0, GRID, BeamformSettings(**{"f_number": 1.5, **change}))


def with_nan(data: ChannelData) -> ChannelData:
    """Return data with one sample missing."""
    samples = np.array(data.samples[:])
    samples[0, 1, 7, 100] = np.nan
    return dataclasses.replace(data, samples=samples)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (with_nan(noise()), "transmit 1, element 7 holds NaN"),
        (with_nan(noise(rf=True)), "transmit 1, element 7 holds NaN"),
        (
            dataclasses.replace(noise(), demodulation_frequency_hz=0.0),
            "IQ samples without a demodulation frequency",
        ),
        (
            dataclasses.replace(noise(rf=True), demodulation_frequency_hz=5e6),
            "real samples but a demodulation frequency",
        ),
        (
            dataclasses.replace(noise(), start_time_s=torch.full((3,), 1.0, dtype=torch.float64)),
            r"no pixel of the image, 0\.9 to 10\.8 mm deep",
        ),
        (
            dataclasses.replace(
                noise(), transmit_delays_s=torch.full((3, 48), 1.0, dtype=torch.float64)
            ),
            "no pixel of the image",
        ),
        (delayed(noise(), 1, 1e-3), r"no pixel of the image, .* recording of transmit 1 from"),
        (
            dataclasses.replace(noise(rf=True), sampling_frequency_hz=0.9 * FREQUENCY_HZ),
            "less than one per period",
        ),
        (
            delayed(noise(), 2, 0.0, 1e6),
            r"the delays of transmit 2 differ by .* us across the array: delays must be in seconds",
        ),
        (dataclasses.replace(noise(), sound_speed_m_per_s=1.54), "sound speed must be from 100"),
        (
            dataclasses.replace(
                noise(), transmit_delays_s=torch.full((3, 48), torch.nan, dtype=torch.float64)
            ),
            "no element fires in transmit 0",
        ),
        (
            dataclasses.replace(
                noise(), transmit_delays_s=torch.full((3, 48), torch.inf, dtype=torch.float64)
            ),
            "got infinity",
        ),
        (
            dataclasses.replace(
                noise(), start_time_s=torch.full((3,), torch.nan, dtype=torch.float64)
            ),
            "start times of 'noise' are not all numbers",
        ),
    ],
)
def test_recordings_that_make_no_sense_are_refused(data, message):
    """One sentence says what is wrong with a recording."""
    with pytest.raises(ScanError, match=message):
        beamform(data, 0, GRID)


def test_samples_of_another_geometry_are_refused():
    """A prepared beamformer takes only what it was made for."""
    prepared = prepare_beamformer(noise(), GRID)

    with pytest.raises(ScanError, match=r"3 transmits, 48 elements and 500 samples, got"):
        prepared.apply(noise().samples[..., :400])
    with pytest.raises(ScanError, match="made for IQ"):
        prepared.apply(noise(rf=True).samples)


def test_absurd_images_and_absent_frames_are_refused():
    """A mistaken spacing does not fill the memory; a frame that is not there is told."""
    with pytest.raises(ScanError, match="1000000 x 1000000 pixels is too large"):
        beamform(noise(), 0, centered_grid(1_000_000, 1_000_000, (1e-4, 1e-4)))
    with pytest.raises(ScanError, match="no frame 1 in 'noise', which has 1"):
        beamform(noise(), 1, GRID)

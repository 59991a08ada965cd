"""Trained networks as estimators; the weights here are random, which changes nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef

from sonosweep.errors import FormatError, ScanError
from sonosweep.estimators.fit_scan import fit_scan
from sonosweep.estimators.learned import BATCH_FRAMES, LearnedEstimator
from sonosweep.estimators.network import (
    Frames,
    FrameShape,
    MotionNetwork,
    NetworkOutput,
    RecurrentNetwork,
    Stepper,
    WindowNetwork,
)
from sonosweep.estimators.network_input import (
    InputSettings,
    center_mm,
    image_steps,
    network_frames,
)
from sonosweep.estimators.network_names import NETWORKS
from sonosweep.estimators.shipped import find_weights, shipped_weights
from sonosweep.geometry import motion_from_step, step_from_motion
from sonosweep.scan import Calibration, Companion, LazyFrames, Region, Scan
from tests.estimators.tiny_weights import SCALE, SIDE, SPACING_MM, tiny_info, tiny_weights

SAME = 1e-5  # of the scale of a motion; the order of sums in single precision
BF16 = 0.05  # of a motion: 0.4 % in each of ten layers
NEARLY_SAME = 0.03  # of the spread of the motions: frames are rounded to gray levels twice


def speckle(frames: int, rows: int = SIDE, columns: int = SIDE, seed: int = 0) -> np.ndarray:
    """Frames of noise that changes from one to the next."""
    rng = np.random.default_rng(seed)
    stack = np.cumsum(rng.standard_normal((frames, rows, columns)), axis=0)
    stack /= np.sqrt(np.arange(1, frames + 1))[:, None, None]
    return np.clip(128 + 50 * stack, 0, 255).astype(np.uint8)


def scan_of(frames, spacing_mm: float | tuple[float, float] = SPACING_MM, **changes) -> Scan:
    """A scan of these frames."""
    pair = (spacing_mm, spacing_mm) if isinstance(spacing_mm, float) else spacing_mm
    return Scan(name="noise", frames=frames, calibration=Calibration(spacing_mm=pair), **changes)


def about_center(motion: Tensor, center: tuple[float, float]) -> Tensor:
    """Return motions of the image as those of a point of it."""
    return motion_from_step(image_steps(step_from_motion(motion), (-center[0], -center[1])))


def joined(outputs: list[NetworkOutput | None]) -> Tensor:
    """Return the motions and variances of all steps."""
    given = [output for output in outputs if output is not None]
    parts = [(o.motion[0], o.log_variance[0]) for o in given if o.log_variance is not None]
    return torch.cat([torch.cat(pair, 1) for pair in parts])


class Remembering(RecurrentNetwork):
    """Sees the mean of each frame, and remembers the sum of all differences."""

    frame_shape = FrameShape(1, 32, 32)

    def encode(self, frames: Tensor) -> tuple[Tensor, ...]:
        """Return the mean."""
        return (frames.mean((1, 2, 3)),)

    def compare(self, first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return the difference."""
        return (second[0] - first[0],)

    def regress(
        self, pairs: tuple[Tensor, ...], state: tuple[Tensor, ...] | None
    ) -> tuple[NetworkOutput, tuple[Tensor, ...]]:
        """Return the difference to the first frame of all."""
        total = pairs[0].cumsum(1) + (0 if state is None else state[0])
        motion = total[..., None].expand(-1, -1, 6)
        return NetworkOutput(motion, (motion,), log_variance=motion), (total[:, -1:],)


class Windowed(WindowNetwork):
    """Sees the means of three frames."""

    frame_shape = FrameShape(1, 32, 32)
    window = 3

    def forward(self, frames: Frames) -> NetworkOutput:
        """Return the second difference of the means, and the first as log variance."""
        means = frames.mean((2, 3, 4))
        step = means.diff(dim=1)
        second = step - torch.cat((step[:, :1], step[:, :-1]), 1)
        motion = second[..., None].expand(-1, -1, 6)
        maps = {"step": step[:, -1:, None]}
        return NetworkOutput(motion, (motion,), None, step[..., None].expand(-1, -1, 6), maps)


@pytest.mark.parametrize("network", [Remembering(), Windowed()])
@pytest.mark.parametrize("sizes", [(1,) * 9, (9,), (1, 3, 5), (4, 1, 4)])
def test_however_frames_come_the_motions_are_the_same(network: MotionNetwork, sizes):
    """One by one, all at once, or in parts."""
    frames = torch.rand(9, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    one_by_one, in_parts = Stepper(network), Stepper(network)

    single = joined([one_by_one.push(frame) for frame in frames])
    parts = joined([in_parts.push_many(part) for part in frames.split(sizes)])

    assert single.shape == (8, 12)
    torch.testing.assert_close(parts, single, atol=1e-6, rtol=0)


def test_a_window_ends_with_the_frame_that_came_last():
    """The first frame stands for those before the sweep; maps are those of the last step."""
    frames = torch.arange(5.0)[:, None, None, None].square().expand(-1, 1, 32, 32) / 16

    output = Stepper(Windowed()).push_many(frames)

    assert output is not None
    first, second = [1, 3, 5, 7], [1, 2, 2, 2]  # differences of squares
    assert (output.motion[0, :, 0] * 16).tolist() == pytest.approx(second)
    assert (output.maps["step"].flatten() * 16).tolist() == pytest.approx(first)


@pytest.mark.parametrize("name", ["cnn", "lstm", "moglo", "dcl"])
def test_frame_by_frame_is_the_whole_scan(tmp_path, name):
    """A sweep that is streamed in batches gives what one long window gives, or all windows."""
    pixels = speckle(3 * BATCH_FRAMES - 1)
    estimator = LearnedEstimator(tiny_weights(tmp_path, name), "fp32", "cpu")

    found = estimator.estimate(scan_of(pixels)).motion

    whole = torch.from_numpy(pixels)[None, :, None].float() / 255
    with torch.inference_mode():
        if isinstance(estimator.network, WindowNetwork):
            window = estimator.network.window
            padded = torch.cat((*[whole[:, :1]] * (window - 2), whole), 1)[0]
            whole = torch.stack([padded[i : i + window] for i in range(len(pixels) - 1)])
            scaled = estimator.network(whole).motion[:, -1]
        else:
            scaled = estimator.network(whole).motion[0]
    middle = (SIDE - 1) / 2 * SPACING_MM
    given = about_center(found, (middle, middle)) / torch.tensor(SCALE)
    assert float(scaled.std(0).min()) > 500 * SAME
    torch.testing.assert_close(given, scaled.double(), atol=SAME, rtol=0)


class Counted(LazyFrames):
    """Frames that count how often they are read."""

    def __init__(self, count: int) -> None:
        super().__init__((count, SIDE, SIDE), np.dtype(np.uint8))
        self.reads: list[int] = []

    def _read(self, frame: int) -> np.ndarray:
        self.reads.append(frame)
        return np.random.default_rng(frame).integers(0, 255, (SIDE, SIDE), dtype=np.uint8)


def test_memory_does_not_grow_with_the_sweep(tmp_path, monkeypatch):
    """Each frame is read once, in order, and only the last batch's memory is still held."""
    frames = Counted(5 * BATCH_FRAMES + 1)
    estimator = LearnedEstimator(tiny_weights(tmp_path), "fp32", "cpu")
    network = estimator.network
    assert isinstance(network, RecurrentNetwork)
    made: list[StorageWeakRef] = []
    held: list[int] = []
    encode = network.encode

    def watched(batch: Tensor) -> tuple[Tensor, ...]:
        held.append(sum(not one.expired() for one in made))
        features = encode(batch)
        made.extend(StorageWeakRef(one.untyped_storage()) for one in (batch, *features))
        return features

    monkeypatch.setattr(network, "encode", watched)
    calls: list[tuple[int, int]] = []

    estimate = estimator.estimate(scan_of(frames), lambda done, total: calls.append((done, total)))

    assert frames.reads == list(range(len(frames)))
    assert len(held) == 6
    assert max(held) <= 1
    assert len(estimate.motion) == len(frames) - 1
    assert calls[-1] == (len(frames), len(frames))


def test_pixels_of_half_the_size_give_nearly_the_same_motion(tmp_path):
    """Each pixel is split into four with noise in them whose mean is the pixel."""
    coarse = speckle(20)
    noise = np.random.default_rng(1).integers(-9, 10, (20, SIDE, SIDE, 2))
    fine = np.repeat(np.repeat(coarse.astype(int).clip(10, 245), 2, 1), 2, 2)
    fine[:, ::2, ::2] += noise[..., 0]
    fine[:, 1::2, 1::2] -= noise[..., 0]
    fine[:, 1::2, ::2] += noise[..., 1]
    fine[:, ::2, 1::2] -= noise[..., 1]
    estimator = LearnedEstimator(tiny_weights(tmp_path), "fp32", "cpu")

    known = estimator.estimate(scan_of(coarse.clip(10, 245)))
    resampled = estimator.estimate(scan_of(fine.astype(np.uint8), SPACING_MM / 2))

    # The image's origin is the centre of its first pixel, a quarter of a large one further up.
    middle, finer = (SIDE - 1) / 2 * SPACING_MM, (2 * SIDE - 1) / 4 * SPACING_MM
    expected = about_center(known.motion, (middle, middle))
    found = about_center(resampled.motion, (finer, finer))
    assert float(((found - expected) / expected.std(0)).abs().max()) < NEARLY_SAME
    assert len(resampled.assumptions) == 1


def test_a_larger_field_of_view_is_cut_to_what_the_network_knows(tmp_path):
    """The middle laterally, the part at the probe axially; the motion is still the image's."""
    inside = speckle(6)
    frames = np.random.default_rng(1).integers(0, 255, (6, SIDE + 10, SIDE + 20), dtype=np.uint8)
    frames[:, :SIDE, 10 : SIDE + 10] = inside
    estimator = LearnedEstimator(tiny_weights(tmp_path), "fp32", "cpu")

    alone, within = estimator.estimate(scan_of(inside)), estimator.estimate(scan_of(frames))

    middle = (SIDE - 1) / 2 * SPACING_MM
    moved = (middle + 10 * SPACING_MM, middle)
    torch.testing.assert_close(
        about_center(within.motion, moved),
        about_center(alone.motion, (middle, middle)),
        atol=1e-9,
        rtol=0,
    )
    assert "from column 10 and row 0 on" in within.assumptions[1]


def test_a_smaller_field_of_view_is_stretched_and_motions_are_corrected(tmp_path):
    """Shifts in plane are as much smaller as pixels are, tilts as much larger."""
    pixels = speckle(6)
    share = (0.9, 0.95)
    estimator = LearnedEstimator(tiny_weights(tmp_path), "fp32", "cpu")
    small = tuple(part * SPACING_MM for part in share)

    known, stretched = (
        estimator.estimate(scan_of(pixels)),
        estimator.estimate(scan_of(pixels, small)),
    )

    factors = torch.tensor([0.9, 0.95, 1, 1 / 0.95, 1 / 0.9, 1], dtype=torch.float64)
    middle = (SIDE - 1) / 2
    expected = about_center(known.motion, (middle * SPACING_MM,) * 2) * factors
    found = about_center(stretched.motion, (middle * small[0], middle * small[1]))
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=0)
    assert "stretched" in stretched.assumptions[1]


def test_what_looks_stretched_to_the_network_is_what_moved():
    """A plane that turns and slides, told in pixels 0.9 and 0.95 as large, to first order."""
    true = torch.tensor([[2e-3, 3e-3, 1e-2, 4e-4, -3e-4, 2e-4]], dtype=torch.float64)
    across, down = 0.9, 0.95
    x, y = np.meshgrid(np.linspace(-10, 10, 9), np.linspace(-12, 12, 9))
    points = torch.tensor(np.stack((x, y, 0 * x), -1).reshape(-1, 3))
    step = step_from_motion(true)[0]
    moved = points @ step[:3, :3].T + step[:3, 3] - points
    pixels = torch.tensor([across, down, 1.0], dtype=torch.float64)
    seen, shifts = points / pixels, moved / pixels  # what a network of larger pixels sees
    ones = torch.ones(len(seen), 1, dtype=torch.float64)
    plane = torch.linalg.lstsq(torch.cat((ones, seen[:, :2]), 1), shifts).solution

    told = torch.stack(
        (plane[0, 0], plane[0, 1], plane[0, 2], plane[2, 2], -plane[1, 2], true[0, 5])
    )
    factors = torch.tensor([across, down, 1, 1 / down, 1 / across, 1], dtype=torch.float64)

    torch.testing.assert_close(told * factors, true[0], atol=1e-6, rtol=0)


def test_of_a_sector_a_rectangle_is_looked_at(tmp_path):
    """As near to the probe as a full one lies within the sector."""
    rows, columns = np.mgrid[:200, :160]
    mask = np.abs(columns - 79.5) < 10 + 0.5 * rows
    left = 48
    top = int(np.argmax(mask[:, left]))
    scan = scan_of(speckle(3, 200, 160), region=Region((0, 0, 160, 200), mask))

    fitted = fit_scan(scan, tiny_info())

    middle = ((left + (SIDE - 1) / 2) * SPACING_MM, (top + (SIDE - 1) / 2) * SPACING_MM)
    assert fitted.center_mm == pytest.approx(middle)
    assert fitted.stretch == pytest.approx((1, 1))
    assert np.array_equal(fitted.frames[1][0], scan.frames[1][top : top + SIDE, left : left + SIDE])
    assert "sector" in fitted.notes[-1]
    narrow = replace(scan, region=Region((0, 0, 160, 200), mask & (np.abs(columns - 79.5) < 20)))
    with pytest.raises(ScanError, match="sector that holds no 16 x 16 mm"):
        fit_scan(narrow, tiny_info())


def test_standard_deviations_are_of_the_image_too(tmp_path):
    """Of a network that predicts them: scaled, and larger away from where it looks."""
    options = {"width": 8, "hidden": 8, "log_variance": True}
    path = tiny_weights(tmp_path, options=options)
    estimator = LearnedEstimator(path, "fp32", "cpu")

    std = estimator.estimate(scan_of(speckle(5))).std

    whole = torch.from_numpy(speckle(5))[None, :, None].float() / 255
    with torch.inference_mode():
        variance = estimator.network(whole).log_variance[0].double().exp()
    at_center = variance.sqrt() * torch.tensor(SCALE, dtype=torch.float64)
    middle = (SIDE - 1) / 2 * SPACING_MM
    lateral, _, elevational, pitch, yaw, roll = at_center.unbind(-1)
    assert std is not None
    torch.testing.assert_close(std[:, 3:], at_center[:, 3:], rtol=1e-5, atol=0)
    torch.testing.assert_close(std[:, 0], torch.hypot(lateral, middle * roll), rtol=1e-5, atol=0)
    expected = (elevational**2 + middle**2 * (pitch**2 + yaw**2)).sqrt()
    torch.testing.assert_close(std[:, 2], expected, rtol=1e-5, atol=0)


def test_bf16_changes_motions_by_little(tmp_path):
    """Eight bits of mantissa are 0.4 % of each number."""
    path, scan = tiny_weights(tmp_path), scan_of(speckle(12))

    exact = LearnedEstimator(path, "fp32", "cpu").estimate(scan)
    rough = LearnedEstimator(path, "bf16", "cpu").estimate(scan)

    error = (exact.motion - rough.motion).abs().max(0).values / exact.motion.abs().mean(0)
    assert 0 < float(error.max()) < BF16
    assert "bf16" in rough.assumptions[0]


REFUSALS = {
    "no pixel spacing": lambda: replace(scan_of(speckle(4)), calibration=None),
    r"is 9\.6 mm wide, and the weights were trained on 19\.2": lambda: scan_of(
        speckle(4, columns=32)
    ),
    r"is 9\.6 mm deep": lambda: scan_of(speckle(4, rows=32)),
    r"lateral pixels of 'noise' are 0\.8 mm, too coarse": lambda: scan_of(
        speckle(4), (0.8, SPACING_MM)
    ),
    "has 1 frames, and network 'cnn' needs 2": lambda: scan_of(speckle(1)),
    "8-bit": lambda: scan_of(speckle(4).astype(np.float32)),
}


@pytest.mark.parametrize("sentence", REFUSALS)
def test_scans_that_the_weights_are_not_for_are_refused(tmp_path, sentence):
    """With what is wrong, and what would be right."""
    estimator = LearnedEstimator(tiny_weights(tmp_path), "fp32", "cpu")

    with pytest.raises(ScanError, match=sentence):
        estimator.estimate(REFUSALS[sentence]())


def test_channels_come_from_companions_of_the_same_place(tmp_path):
    """IQ is cut as B-mode is; a scan without it is refused."""
    info = tiny_info(input={"rows": SIDE, "columns": SIDE, "channels": "b_mode+iq"})
    gray = speckle(3, SIDE, SIDE + 8)
    iq = np.random.default_rng(2).standard_normal((3, SIDE, SIDE + 8, 2)).astype(np.float32)
    scan = scan_of(gray, companions={"iq": Companion(iq, (SPACING_MM, SPACING_MM))})

    read = fit_scan(scan, info).frames[1]

    inside = iq[1, :, 4:-4]
    assert read.shape == (3, SIDE, SIDE)
    for channel, part in ((1, inside[..., 0]), (2, inside[..., 1])):
        kept = np.abs(part) < 1  # larger ones are cut off at white
        assert np.corrcoef(read[channel][kept], part[kept])[0, 1] > 0.999
    with pytest.raises(ScanError, match="need the companion 'iq'"):
        fit_scan(scan_of(gray), info)


def test_names_that_stand_for_no_weights(tmp_path):
    """Say which there are; an unfinished run has none yet."""
    with pytest.raises(FormatError, match="no estimator is called 'mogli'; give decorrelation"):
        find_weights("mogli")
    with pytest.raises(FormatError, match="has the run ended"):
        find_weights(str(tmp_path))
    with pytest.raises(FormatError, match="there is no"):
        find_weights(str(tmp_path / "gone.safetensors"))


def test_a_run_is_named_by_its_folder(tmp_path):
    """Which holds weights.safetensors."""
    path = tiny_weights(tmp_path).rename(tmp_path / "weights.safetensors")

    assert find_weights(str(tmp_path)) == path
    assert LearnedEstimator(tmp_path, device="cpu").name == "cnn"


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_is_an_estimator(tmp_path, name):
    """In both precisions, with the sizes that are shipped."""
    side = 128 if name == "cnn" else SIDE
    path = tiny_weights(tmp_path, name, options={}, input={"rows": side, "columns": side})
    scan = scan_of(speckle(6, side, side))

    found = [
        LearnedEstimator(path, precision, "cpu").estimate(scan).motion
        for precision in ("fp32", "bf16")
    ]

    assert found[0].shape == found[1].shape == (5, 6)
    assert not torch.equal(found[0], found[1])


@pytest.mark.parametrize("name", shipped_weights())
def test_shipped_weights_load(name):
    """Each is what its name says and small enough to ship."""
    estimator = LearnedEstimator(name, device="cpu")

    assert estimator.info.network in name
    assert shipped_weights()[name].stat().st_size < 10e6


def test_coarse_pixels_are_read_with_a_warning(tmp_path):
    """Up to 1.5 times those of the weights nothing is said; beyond, a guess is called one."""
    estimator = LearnedEstimator(tiny_weights(tmp_path), "fp32", "cpu")
    fine = estimator.estimate(scan_of(speckle(4), (1.5 * SPACING_MM, SPACING_MM)))
    coarse = estimator.estimate(scan_of(speckle(4), (2.0 * SPACING_MM, SPACING_MM)))

    assert not any("hardly more than a guess" in words for words in fine.assumptions)
    assert any("hardly more than a guess" in words for words in coarse.assumptions)


def sector_mask(rows: int, columns: int) -> np.ndarray:
    """A sector whose sides run from a third of the width at the top to all of it."""
    half = np.linspace(columns / 5, columns / 2 - 2, rows)[:, None]
    mask = np.abs(np.arange(columns) - (columns - 1) / 2)[None] <= half
    mask[:2] = False
    return mask


@pytest.mark.parametrize("masked", [True, False])
def test_weights_trained_on_the_middle_of_frames_are_used_on_it(masked):
    """The pixels that training saw, also of a sector with room nearer to the probe."""
    frames = speckle(3, 120, 160)
    mask = sector_mask(120, 160)
    region = Region((0, 0, 160, 120), mask if masked else None)
    settings = InputSettings(rows=SIDE, columns=SIDE, crop_px=(86, 80))
    scan = scan_of(frames, region=region)
    spacing = (SPACING_MM * 86 / SIDE, SPACING_MM * 80 / SIDE)
    info = tiny_info(input=settings, spacing_mm=spacing)

    fitted = fit_scan(scan, info)

    assert np.array_equal(fitted.frames[:], network_frames(scan, settings)[:])
    assert fitted.center_mm == center_mm(scan)
    assert 0.95 < mask[20:100, 37:123].mean() < 1  # a corner sticks out


def test_a_crop_that_leaves_the_sector_is_replaced():
    """By the highest rectangle within it."""
    mask = sector_mask(120, 160)
    mask[60:] = False  # the middle of the frame is no longer image
    scan = scan_of(speckle(3, 120, 160), region=Region((0, 2, 160, 58), mask))
    settings = InputSettings(rows=SIDE, columns=SIDE, crop_px=(40, 40))
    info = tiny_info(input=settings, spacing_mm=(SPACING_MM * 40 / SIDE,) * 2)

    fitted = fit_scan(scan, info)

    assert fitted.center_mm[1] < 45 * SPACING_MM
    assert "40 x 40 pixels from column 60" in fitted.notes[0]


def test_frames_of_the_size_that_training_saw_are_read_whole():
    """Also where part of them seems to be no image, as training did."""
    frames = speckle(3)
    scan = scan_of(frames, region=Region((2, 0, SIDE - 5, SIDE), None))

    fitted = fit_scan(scan, tiny_info())

    assert np.array_equal(fitted.frames[:][:, 0], frames)
    assert fitted.stretch == (1.0, 1.0)

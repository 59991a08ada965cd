"""How a hand moves the probe over the skin: where it is at every moment, exactly.

Poses are ``plane_to_body``: plane coordinates have the image's axes and their origin in the
middle of the array's face.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from sonosweep.errors import ScanError
from sonosweep.simulate.body import Body
from sonosweep.simulate.probe_contact import Skin, lay_on_skin, skin_of
from sonosweep.simulate.sweep_path import SweepPath, SweepShape, sweep_path
from sonosweep.simulate.wander import Wander, slow_wander, tremor

Orientation = Literal["perpendicular", "parallel"]

MOST_FRAMES = 100_000
MOST_PAUSES = 1000
TICKS_PER_FRAME = 12  # on which the speed is integrated
SPEED_SCALE_S = 1.2  # over which speed changes
WANDER_SCALE_S = 0.8  # over which the hand drifts
# Standard deviations of the hand at hand_unsteadiness 1: with WANDER_SCALE_S and 20 frames/s
# they give steps of .155, .16 and .12 degrees and, with tremor, of .10 mm laterally and
# .05 mm axially, on a round arm.
PITCH_DEG, YAW_DEG, ROLL_DEG = 2.5, 2.5, 1.6
LATERAL_MM, AXIAL_MM = 1.4, 0.35
SHARE_FOR_SPEED = 0.4  # least part of the largest step that must be left for the sweep


@dataclass(frozen=True)
class MotionSettings:
    """A sweep over the skin.

    Attributes:
        shape: Of the line on the skin.
        length_mm: Of this line, along its bends.
        frames: How many.
        frame_rate_hz: How many per second.
        orientation: ``"perpendicular"``: frames lie across the arm. ``"parallel"``: frames
            lie along the arm, so that a straight sweep stays in its plane, as in TUS-REC.
        backward: Whether the line is traversed from its end: the same frames in reversed
            order.
        excursion_mm: How far C, L and S leave the straight line; negative for mirrored.
        turning: How much the probe turns with the line: 0 keeps its direction, 1 stays
            upright to the line.
        offset_mm: Body x and z of the line's middle, from the middle of the body.
        speed_variation: Standard deviation of the logarithm of the speed.
        pauses: How many times the hand stops.
        pause_s: For how long.
        largest_step_mm: Between neighboring frames.
        hand_unsteadiness: Scale of slow drift and rotation; 0 for a robot's arm, 1 for a
            hand.
        tremor_mm: Standard deviation of trembling at 8 to 12 Hz, of each coordinate.
        gel_mm: Between the face and the highest point of the skin.
        contact_width_mm: Length of the face that rests on the skin.
    """

    shape: SweepShape = "S"
    length_mm: float = 200.0
    frames: int = 950
    frame_rate_hz: float = 20.0
    orientation: Orientation = "perpendicular"
    backward: bool = False
    excursion_mm: float = 8.0
    turning: float = 0.3
    offset_mm: tuple[float, float] = (0.0, 0.0)
    speed_variation: float = 0.8
    pauses: int = 2
    pause_s: float = 0.8
    largest_step_mm: float = 1.0
    hand_unsteadiness: float = 1.0
    tremor_mm: float = 0.02
    gel_mm: float = 0.5
    contact_width_mm: float = 38.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ScanError: If one has no meaning, or the sweep is too long for its frames.
        """
        if self.shape not in get_args(SweepShape) or self.orientation not in get_args(Orientation):
            raise ScanError(
                f"a sweep has a shape of {', '.join(get_args(SweepShape))} and an orientation of"
                f" {' or '.join(get_args(Orientation))}, got '{self.shape}' and"
                f" '{self.orientation}'"
            )
        if not 1 <= self.frames <= MOST_FRAMES:
            raise ScanError(f"a sweep has from 1 to {MOST_FRAMES} frames, got {self.frames}")
        if not 0 <= self.pauses <= MOST_PAUSES:
            raise ScanError(f"a sweep has from 0 to {MOST_PAUSES} pauses, got {self.pauses}")
        for name in ("length_mm", "frame_rate_hz", "largest_step_mm", "contact_width_mm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ScanError(f"{name} of a sweep must be above 0, got {value:g}")
        for name in (
            "speed_variation",
            "pause_s",
            "hand_unsteadiness",
            "tremor_mm",
            "gel_mm",
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ScanError(f"{name} of a sweep must be 0 or more, got {value:g}")
        if not np.isfinite([self.excursion_mm, self.turning, *self.offset_mm]).all():
            raise ScanError("excursion, turning and offset of a sweep must be finite")

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last."""
        return (self.frames - 1) / self.frame_rate_hz


@dataclass(frozen=True, eq=False)
class ProbeMotion:
    """Where the probe is at every moment of a sweep.

    Attributes:
        settings: Of the sweep.
        path: On the skin.
        start_mm: Body x and z of its first point.
        progress_s: Times at which the way is known.
        progress_mm: The way along the path until then.
        hand: Deviations by name: ``"pitch"``, ``"yaw"``, ``"roll"`` in rad, ``"lateral"``
            and ``"axial"`` in mm, each the sum of its signals.
        skin: On which it slides.
    """

    settings: MotionSettings
    path: SweepPath
    start_mm: tuple[float, float]
    progress_s: Float[np.ndarray, " ticks"]
    progress_mm: Float[np.ndarray, " ticks"]
    hand: dict[str, tuple[Wander, ...]]
    skin: Skin

    def frame_times_s(self) -> Float[np.ndarray, " frames"]:
        """Return the time of each frame."""
        return np.arange(self.settings.frames) / self.settings.frame_rate_hz

    def poses_at(self, times_s: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 4 4"]:
        """Return ``plane_to_body`` at any times; before and after the sweep the hand rests."""
        chosen = self.settings
        times = chosen.duration_s - times_s if chosen.backward else times_s
        length = np.interp(times, self.progress_s, self.progress_mm)
        hand = {name: _sum(signals, times) for name, signals in self.hand.items()}
        across, along, heading = self.path.at(length)
        across, along = across + self.start_mm[0], along + self.start_mm[1]
        yaw = chosen.turning * heading
        # Sideways drift leaves the line at a right angle to the way ahead.
        across = across + hand["lateral"] * np.cos(heading)
        along = along - hand["lateral"] * np.sin(heading)
        if chosen.orientation == "parallel":
            yaw = yaw - np.pi / 2  # takes the lateral axis to body z
        yaw = yaw + hand["yaw"]
        contact = lay_on_skin(self.skin, across, along, yaw, chosen.contact_width_mm)
        angles = np.stack(
            [yaw, contact.pitch_rad + hand["pitch"], contact.roll_rad + hand["roll"]], axis=1
        )
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = Rotation.from_euler("YXZ", angles).as_matrix()
        depth = contact.depth_mm - chosen.gel_mm + hand["axial"]
        poses[:, :3, 3] = np.stack([across, depth, along], axis=1)
        return poses


def sweep_poses(
    settings: MotionSettings, body: Body, generator: np.random.Generator
) -> tuple[Float[np.ndarray, "frames 4 4"], Float[np.ndarray, " frames"]]:
    """Return ``plane_to_body`` (mm) and the time (s) of each frame of a sweep.

    Raises:
        ScanError: If the sweep leaves the body or is too fast.
    """
    motion = draw_motion(settings, body, generator)
    times = motion.frame_times_s()
    return motion.poses_at(times), times


def draw_motion(
    settings: MotionSettings, body: Body, generator: np.random.Generator
) -> ProbeMotion:
    """Return a random movement of the probe over a body.

    Raises:
        ScanError: If the sweep leaves the body or is too fast for its frames.
    """
    path = sweep_path(settings.shape, settings.length_mm, settings.excursion_mm)
    hand = _draw_hand(settings, generator)
    times, way = _draw_progress(settings, path, hand, generator)
    start = _start_mm(settings, path, body)
    motion = ProbeMotion(settings, path, start, times, way, hand, skin_of(body))
    _check_on_body(motion, body)
    return motion


def _draw_hand(
    settings: MotionSettings, generator: np.random.Generator
) -> dict[str, tuple[Wander, ...]]:
    """Return the hand's deviations; trembling shifts the probe and hardly turns it."""
    scale = settings.hand_unsteadiness
    turns = {"pitch": PITCH_DEG, "yaw": YAW_DEG, "roll": ROLL_DEG}
    hand: dict[str, tuple[Wander, ...]] = {
        name: (slow_wander(generator, scale * float(np.deg2rad(degrees)), WANDER_SCALE_S),)
        for name, degrees in turns.items()
    }
    for name, deviation in (("lateral", LATERAL_MM), ("axial", AXIAL_MM)):
        drift = slow_wander(generator, scale * deviation, WANDER_SCALE_S)
        hand[name] = (drift, tremor(generator, settings.tremor_mm))
    return hand


def _sum(signals: tuple[Wander, ...], times_s: np.ndarray) -> np.ndarray:
    return sum((signal(times_s) for signal in signals), np.zeros(len(times_s)))


def _draw_progress(
    settings: MotionSettings,
    path: SweepPath,
    hand: dict[str, tuple[Wander, ...]],
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and the way until then, never faster than the largest step allows."""
    wish = slow_wander(generator, settings.speed_variation, SPEED_SCALE_S)
    stops = generator.uniform(size=settings.pauses)
    if settings.frames == 1:
        return np.zeros(1), np.zeros(1)
    ticks = np.linspace(0, settings.duration_s, TICKS_PER_FRAME * (settings.frames - 1) + 1)
    middles = (ticks[1:] + ticks[:-1]) / 2
    wanted = np.exp(wish(middles))
    for stop in stops:
        wanted *= _stop(middles - stop * settings.duration_s, settings.pause_s)
    fastest = _fastest_step_mm(settings, path, hand) / TICKS_PER_FRAME

    def steps(scale: float) -> np.ndarray:
        # Goes smoothly over into the fastest speed.
        return scale * wanted / (1 + (scale * wanted / fastest) ** 4) ** 0.25

    length = path.lengths_mm[-1]
    most = 1e3 * fastest / max(float(np.median(wanted)), 1e-9)
    if steps(most).sum() < length:
        raise ScanError(
            f"{settings.frames} frames are too few for a sweep of {settings.length_mm:g} mm with"
            f" steps of {settings.largest_step_mm:g} mm at most: take more frames, a shorter"
            " sweep, fewer pauses or a larger largest_step_mm"
        )
    scale = brentq(lambda value: steps(value).sum() - length, 0, most, xtol=1e-15, rtol=1e-14)
    return ticks, np.concatenate([[0.0], np.cumsum(steps(scale))])


def _stop(times_s: np.ndarray, pause_s: float) -> np.ndarray:
    """Return 1 far from a pause and 0 within it, with half a second of slowing down."""
    away = np.clip((np.abs(times_s) - pause_s / 2) / 0.5, 0, 1)
    return away * away * (3 - 2 * away)


def _fastest_step_mm(
    settings: MotionSettings, path: SweepPath, hand: dict[str, tuple[Wander, ...]]
) -> float:
    """Return what rotations leave of the largest step at the ends of the face."""
    times = np.arange(settings.frames) / settings.frame_rate_hz
    lever = settings.contact_width_mm / 2
    turns = np.abs(np.diff(_sum(hand["yaw"], times))) * lever
    drift = np.abs(np.diff(_sum(hand["lateral"], times)))
    # Drift is sideways; a probe that is turned sees part of it as elevational.
    aside = np.sin(np.abs(_sum(hand["yaw"], times))[1:]) * drift
    left = settings.largest_step_mm - float((turns + aside).max())
    fastest = left / (1 + abs(settings.turning) * path.sharpest_rad_per_mm * lever)
    if fastest < SHARE_FOR_SPEED * settings.largest_step_mm:
        raise ScanError(
            "the probe turns so fast that its edge moves by most of largest_step_mm ="
            f" {settings.largest_step_mm:g}: choose a smaller excursion_mm, turning or"
            " hand_unsteadiness, or a larger largest_step_mm"
        )
    return fastest


def _extent_mm(body: Body) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return where the body begins and ends, across and along."""
    depth, _, width = body.tissue.shape
    x, _, z = body.origin_mm
    return (
        (x, x + (width - 1) * body.spacing_mm),
        (z, z + (depth - 1) * body.spacing_mm),
    )


def _start_mm(settings: MotionSettings, path: SweepPath, body: Body) -> tuple[float, float]:
    """Return where the path begins, so that its middle is where it should be."""
    middles = [(low + high) / 2 for low, high in _extent_mm(body)]
    ways = (path.across_mm, path.along_mm)
    across, along = (
        float(middle + offset - (way.min() + way.max()) / 2)
        for middle, offset, way in zip(middles, settings.offset_mm, ways, strict=True)
    )
    return across, along


def _check_on_body(motion: ProbeMotion, body: Body) -> None:
    half = motion.settings.contact_width_mm / 2
    poses = motion.poses_at(motion.frame_times_s())
    for name, axis, (low, high) in zip(("x", "z"), (0, 2), _extent_mm(body), strict=True):
        reach = np.abs(poses[:, axis, 0]) * half
        first, last = poses[:, axis, 3] - reach, poses[:, axis, 3] + reach
        outside = np.maximum(low - first, last - high)
        worst = int(outside.argmax())
        if outside[worst] > 0:
            place = first[worst] if low - first[worst] > last[worst] - high else last[worst]
            raise ScanError(
                f"the sweep leaves phantom '{body.name}': the probe reaches {name} ="
                f" {place:.1f} mm at frame {worst}, but the phantom lies between {low:.1f} and"
                f" {high:.1f} mm: choose a shorter length_mm, a smaller excursion_mm or another"
                " offset_mm"
            )

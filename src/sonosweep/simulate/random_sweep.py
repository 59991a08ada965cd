"""Sweeps whose probe, scanner and body differ from scan to scan as they do between clinics.

=========================== =================================== ================================
setting                     range                               why
=========================== =================================== ================================
elevation waist             0.50 to 0.75 mm                     known to about 25 %
elevation focus             14 to 22 mm                         lenses of linear probes
center frequency            5.8 to 7.4 MHz                      of the echoes of a 7.6 MHz probe
axial, lateral width        0.15 to 0.22, 0.30 to 0.45 mm       pulse length, aperture, preset
attenuation                 0.55 to 0.95 of the table           people, and how it is tabled
gain                        -30 to -16 dB                       the gain knob
time gain compensation      85 to 115 % of muscle's loss        the preset
sliders                     8 of standard deviation 1.5 dB      the operator
dynamic range               50 to 72 dB                         the preset
gray map                    gamma 0.85 to 1.4, contrast to 0.5  the preset
electronic noise            -90 to -68 dB                       the machine
side lobes                  -52 to -38 dB, over 2 to 5 mm       aperture, apodization
reverberation near the face -40 to -20 dB, over 0.8 to 2.5 mm   contact, lens
persistence                 1, 3 or 5 frames (40, 40, 20 %)     the preset
speckle reduction           0 (30 %) or 0.3 to 0.9              the preset
compression                 0 to 0.08, changing by 0 to 0.015   pressure of the hand
pulse                       0 to 0.12 of the radius, 50-100/min arteries of the arm
breathing                   0 to 0.4 mm, 12 to 20/min           an arm at rest
blood, its noise, its flow  -54 to -46, -90 to -80 dB, 1.5 to 3 power Doppler
=========================== =================================== ================================

These are the settings of ``"clinical"`` scanners. A ``"research"`` scanner, such as the paper's
Verasonics, shows what it hears: 60 dB on a straight gray map, no persistence, no speckle
reduction; all else is as above. A ``"speckle_reduced"`` one is the same with speckle reduction
of medium strength, one preset for all scans, as the machine of the paper's data set 3.

A convex probe has 2.6 to 3.6 MHz, a radius of 40 mm, wider beams and less haze.
"""

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from sonosweep.errors import ScanError
from sonosweep.imaging import PixelGrid, SectorGrid, centered_grid
from sonosweep.simulate.attenuation import two_way_loss_db_per_mm
from sonosweep.simulate.beam import Beam
from sonosweep.simulate.body import Tissue
from sonosweep.simulate.body_motion import BodyMotionSettings
from sonosweep.simulate.doppler_frames import DopplerSettings
from sonosweep.simulate.motion import MotionSettings
from sonosweep.simulate.scanner import Scanner
from sonosweep.simulate.seeds import generator
from sonosweep.simulate.sweep_settings import SweepSettings
from sonosweep.simulate.tracker import TrackerSettings

ScannerKind = Literal["research", "speckle_reduced", "clinical"]

PROBE_KINDS = ("linear", "convex")

LINEAR_SIDE_MM = 256 * 0.1484
CONVEX_RADIUS_MM = 40.0
CONVEX_SECTOR = SectorGrid(
    lines=256,
    samples=448,
    line_spacing_rad=float(np.deg2rad(60.0 / 255)),
    sample_spacing_mm=0.22,
    first_depth_mm=0.5,
    radius_mm=CONVEX_RADIUS_MM,
)
CONVEX_WIDTH_MM, CONVEX_TOP_MM = 640 * 0.22, -5.6
PERSISTENCE, PERSISTENCE_CHANCE = (1, 3, 5), (0.4, 0.4, 0.2)
NO_REDUCTION_CHANCE = 0.3
RESEARCH_RANGE_DB = 60.0
MEDIUM_REDUCTION = 0.6  # of those that clinical scanners have, the middle


def draw_sweep(
    subject: int,
    scan: int,
    motion: MotionSettings | None = None,
    *,
    probe: str = "linear",
    pixels: tuple[int, int] | None = None,
    modalities: tuple[str, ...] = (),
    tracker: TrackerSettings | None = None,
    scanner: str = "clinical",
) -> SweepSettings:
    """Return the settings of one scan; the same numbers give the same settings.

    Args:
        subject: Number of the subject.
        scan: Number of the scan.
        motion: Of the probe; ``None`` is an S of 200 mm.
        probe: ``"linear"`` as in the paper's data sets 1 and 2, ``"convex"`` as in 3.
        pixels: Columns and rows over the same field of view; ``None`` is 256 x 256 of a
            linear and 640 x 480 of a convex probe.
        modalities: What is recorded beside B-mode.
        tracker: What sees the poses; ``None`` gives the truth.
        scanner: ``"clinical"`` with a preset of its own, ``"research"``, or
            ``"speckle_reduced"``.

    Raises:
        ScanError: If there is no such subject, probe, scanner or modality.
    """
    if probe not in PROBE_KINDS:
        raise ScanError(f"a probe is 'linear' or 'convex', got '{probe}'")
    if scanner not in get_args(ScannerKind):
        raise ScanError(
            f"a scanner is 'research', 'speckle_reduced' or 'clinical', got '{scanner}'"
        )
    draw = generator(subject, scan, "settings")
    beam = _draw_beam(draw, probe)
    body_motion = _draw_body_motion(draw)
    drawn = _draw_scanner(draw, beam, probe)
    if scanner != "clinical":
        drawn = _without_preset(drawn, 0.0 if scanner == "research" else MEDIUM_REDUCTION)
    return SweepSettings(
        subject=subject,
        scan=scan,
        motion=motion or MotionSettings(),
        body_motion=body_motion,
        beam=beam,
        scanner=drawn,
        grid=_grid(probe, pixels),
        sector=CONVEX_SECTOR if probe == "convex" else None,
        modalities=modalities,
        doppler=DopplerSettings(
            blood_db=draw.uniform(-54, -46),
            noise_db=draw.uniform(-90, -80),
            flow=draw.uniform(1.5, 3),
            tissue_speed_mm_per_s=draw.uniform(0.2, 1),
        ),
        tracker=tracker,
    )


def _draw_beam(draw: np.random.Generator, probe: str) -> Beam:
    if probe == "linear":
        return Beam(
            center_frequency_hz=draw.uniform(5.8e6, 7.4e6),
            axial_fwhm_mm=draw.uniform(0.15, 0.22),
            lateral_fwhm_mm=draw.uniform(0.30, 0.45),
            elevation_waist_mm=draw.uniform(0.50, 0.75),
            elevation_focus_mm=draw.uniform(14, 22),
        )
    return Beam(
        center_frequency_hz=draw.uniform(2.6e6, 3.6e6),
        axial_fwhm_mm=draw.uniform(0.35, 0.55),
        lateral_fwhm_mm=draw.uniform(0.9, 1.4),
        elevation_waist_mm=draw.uniform(1.0, 1.5),
        elevation_focus_mm=draw.uniform(35, 60),
        curvature_radius_mm=CONVEX_RADIUS_MM,
    )


def _draw_scanner(draw: np.random.Generator, beam: Beam, probe: str) -> Scanner:
    attenuation = draw.uniform(0.55, 0.95)
    muscle = two_way_loss_db_per_mm(beam.center_frequency_hz, attenuation)[Tissue.MUSCLE]
    reduces = draw.random() >= NO_REDUCTION_CHANCE
    reduction = draw.uniform(0.3, 0.9)
    return Scanner(
        attenuation_scale=attenuation,
        gain_db=draw.uniform(-30, -16),
        tgc_db_per_mm=float(muscle) * draw.uniform(0.85, 1.15),
        sliders_db=tuple(draw.normal(0, 1.5, 8).tolist()),
        dynamic_range_db=draw.uniform(50, 72),
        gray_gamma=draw.uniform(0.85, 1.4),
        gray_contrast=draw.uniform(0, 0.5),
        noise_db=draw.uniform(-90, -68),
        side_lobe_db=draw.uniform(-52, -38),
        side_lobe_mm=draw.uniform(2, 5),
        haze_db=draw.uniform(-40, -20),
        haze_mm=draw.uniform(0.8, 2.5),
        bone_db=draw.uniform(12, 22),
        persistence_frames=int(draw.choice(PERSISTENCE, p=PERSISTENCE_CHANCE)),
        speckle_reduction=reduction if reduces else 0.0,
    )


def _without_preset(scanner: Scanner, speckle_reduction: float) -> Scanner:
    """Return a scanner that shows what it hears, but for speckle."""
    return replace(
        scanner,
        dynamic_range_db=RESEARCH_RANGE_DB,
        gray_gamma=1.0,
        gray_contrast=0.0,
        persistence_frames=1,
        speckle_reduction=speckle_reduction,
    )


def _draw_body_motion(draw: np.random.Generator) -> BodyMotionSettings:
    return BodyMotionSettings(
        strain=draw.uniform(0, 0.08),
        strain_variation=draw.uniform(0, 0.015),
        pulse=draw.uniform(0, 0.12),
        heart_rate_hz=draw.uniform(50 / 60, 100 / 60),
        breathing_mm=draw.uniform(0, 0.4),
        breathing_rate_hz=draw.uniform(0.2, 0.33),
    )


def _grid(probe: str, pixels: tuple[int, int] | None) -> PixelGrid:
    """Return pixels over the field of view of the paper's frames."""
    columns, rows = pixels or ((256, 256) if probe == "linear" else (640, 480))
    if min(columns, rows) < 1:
        raise ScanError(f"a frame needs pixels, got {columns} x {rows}")
    if probe == "linear":
        return centered_grid(columns, rows, (LINEAR_SIDE_MM / columns, LINEAR_SIDE_MM / rows), 0.5)
    spacing = CONVEX_WIDTH_MM / columns
    return centered_grid(columns, rows, (spacing, spacing), CONVEX_TOP_MM)

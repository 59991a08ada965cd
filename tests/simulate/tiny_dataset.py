"""A data set that takes seconds."""

from sonosweep.simulate.datasets import DatasetRecipe, Part, PlannedScan
from sonosweep.simulate.motion import MotionSettings

MOTION = MotionSettings(
    frames=3, length_mm=1.5, excursion_mm=0.1, pauses=0, hand_unsteadiness=0.3, turning=0.0
)


def planned(subject: int, scan: int, part: Part, motion: MotionSettings = MOTION) -> PlannedScan:
    """Return a scan of a uniform phantom with 24 x 20 pixels."""
    return PlannedScan(
        name=f"RH_Per_S_{scan + 1}",
        subject=subject,
        scan=scan,
        part=part,
        side="right",
        motion=motion,
        pixels=(24, 20),
        modalities=("amplitude",),
        body="uniform",
    )


def tiny_recipe() -> DatasetRecipe:
    """Return two scans for training and two for tests."""
    who: tuple[tuple[int, Part], ...] = ((3, "train"), (900_007, "test"))
    scans = tuple(planned(subject, scan, part) for subject, part in who for scan in range(2))
    return DatasetRecipe("tiny", "small", 0, scans)

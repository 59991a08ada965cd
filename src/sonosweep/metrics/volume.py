"""How alike two volumes are, where both hold something."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Shaped

from sonosweep.errors import ScanError
from sonosweep.scan import Volume, voxel_to_reference

# A voxel centre this far outside, in voxels, still counts as inside: round-off of origins
# that files print with six digits.
EDGE_VOXELS = 1e-3


@dataclass(frozen=True)
class VolumeMetrics:
    """How alike two volumes are; a number that is not defined is ``None``.

    Attributes:
        overlap: Dice: twice the volume that both cover over the sum of what each covers.
        correlation: Of the values of the common voxels (Pearson).
        psnr_db: Peak signal to noise ratio of the common voxels; ``None`` if they are equal.
        mean_difference: Mean of first minus second over the common voxels.
        common_voxels: How many voxels of the first are covered in both.
    """

    overlap: float
    correlation: float | None
    psnr_db: float | None
    mean_difference: float | None
    common_voxels: int

    def as_dict(self) -> dict[str, float | int | None]:
        """Return the numbers by name, in the order above."""
        return asdict(self)


def compare_volumes(first: Volume, second: Volume, peak: float | None = None) -> VolumeMetrics:
    """Return how alike two volumes of one reference are.

    Each voxel of the first is compared with the voxel of the second that holds its centre,
    so the grids may differ in size, origin, spacing and direction. A voxel is covered
    where the coverage says so or, without coverage, where it is not 0.

    Args:
        first: One channel.
        second: One channel.
        peak: Largest value a voxel can have; that of the first's pixel type when ``None``,
            or 1 for floats.

    Raises:
        ScanError: If a volume has several channels.
    """
    for volume in (first, second):
        if volume.voxels.ndim != 3:
            raise ScanError(f"compare volumes of one channel, got shape {volume.voxels.shape}")
    if peak is None:
        kind = first.voxels.dtype
        peak = float(np.iinfo(kind).max) if np.issubdtype(kind, np.integer) else 1.0
    sums = _Sums()
    for a, b in _common_values(first, second):
        sums = sums.with_values(a, b)
    covered = _covered_mm3(first) + _covered_mm3(second)
    common = sums.count * float(np.prod(first.grid.spacing_mm))
    return VolumeMetrics(
        overlap=2 * common / covered if covered > 0 else 0.0,
        correlation=sums.correlation,
        psnr_db=sums.psnr_db(peak),
        mean_difference=sums.mean_difference,
        common_voxels=sums.count,
    )


@dataclass(frozen=True)
class _Sums:
    """Sums over pairs of values, about the first pair so that no digits cancel."""

    count: int = 0
    shift_a: float = 0.0
    shift_b: float = 0.0
    a: float = 0.0
    b: float = 0.0
    aa: float = 0.0
    bb: float = 0.0
    ab: float = 0.0
    squared_difference: float = 0.0

    def with_values(self, a: np.ndarray, b: np.ndarray) -> "_Sums":
        if len(a) == 0:
            return self
        shift_a, shift_b = (self.shift_a, self.shift_b) if self.count else (a[0], b[0])
        da, db = a - shift_a, b - shift_b
        return _Sums(
            self.count + len(a),
            float(shift_a),
            float(shift_b),
            self.a + float(da.sum()),
            self.b + float(db.sum()),
            self.aa + float(da @ da),
            self.bb + float(db @ db),
            self.ab + float(da @ db),
            self.squared_difference + float(((a - b) ** 2).sum()),
        )

    @property
    def mean_difference(self) -> float | None:
        if self.count == 0:
            return None
        return self.shift_a - self.shift_b + (self.a - self.b) / self.count

    @property
    def correlation(self) -> float | None:
        if self.count == 0:
            return None
        variance_a = self.aa - self.a**2 / self.count
        variance_b = self.bb - self.b**2 / self.count
        # What is left of a constant after rounding is not a variance.
        if not (variance_a > 1e-12 * self.aa and variance_b > 1e-12 * self.bb):
            return None
        covariance = self.ab - self.a * self.b / self.count
        return covariance / float(np.sqrt(variance_a * variance_b))

    def psnr_db(self, peak: float) -> float | None:
        if self.count == 0 or self.squared_difference == 0:
            return None
        return float(10 * np.log10(peak**2 * self.count / self.squared_difference))


def covered_voxels(
    voxels: Shaped[np.ndarray, "*zyx"], coverage: Shaped[np.ndarray, "*zyx"] | None
) -> Bool[np.ndarray, "*zyx"]:
    """Say of each voxel whether a frame reached it."""
    return (voxels if coverage is None else coverage) != 0


def _covered_mm3(volume: Volume) -> float:
    source = volume.voxels if volume.coverage is None else volume.coverage
    return float(np.count_nonzero(source)) * float(np.prod(volume.grid.spacing_mm))


def _common_values(first: Volume, second: Volume) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Give the values of both at the voxels of the first that both cover, by slice."""
    first_to_second = (
        np.linalg.inv(voxel_to_reference(second.grid).numpy())
        @ voxel_to_reference(first.grid).numpy()
    )
    size = np.array(second.grid.size)
    x, y = np.meshgrid(np.arange(first.grid.size[0]), np.arange(first.grid.size[1]))
    plane = first_to_second[:3, :1] * x.ravel() + first_to_second[:3, 1:2] * y.ravel()
    for z, values in enumerate(first.voxels):
        coverage = None if first.coverage is None else first.coverage[z]
        place = plane + (first_to_second[:3, 2] * z + first_to_second[:3, 3])[:, None]
        inside = ((place >= -0.5 - EDGE_VOXELS) & (place <= size[:, None] - 0.5 + EDGE_VOXELS)).all(
            axis=0
        )
        inside &= covered_voxels(values, coverage).ravel()
        i, j, k = np.clip(np.rint(place[:, inside]).astype(np.intp), 0, size[:, None] - 1)
        other = second.voxels[k, j, i]
        both = covered_voxels(other, None if second.coverage is None else second.coverage[k, j, i])
        yield values.ravel()[inside][both].astype(np.float64), other[both].astype(np.float64)

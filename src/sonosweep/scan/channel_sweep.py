"""The channel data of a whole sweep, all its modalities interleaved."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from jaxtyping import Bool, Float
from torch import Tensor

from sonosweep.errors import ScanError
from sonosweep.scan.channel_data import ChannelData


@dataclass(frozen=True, eq=False)
class ChannelSweep:
    """What the elements received during one sweep; at least one modality.

    Attributes:
        name: What to call it.
        b_mode: Transmits of different angles; ``None`` for purely photoacoustic machines.
        power_doppler: Ensembles: the transmits of a frame are repetitions of one another.
        photoacoustic: One laser shot for each frame, no transmit delays.
        image_to_reference: Tracked pose of each frame's image plane whose origin is the
            middle of the array's face, mm; ``None`` without tracker.
        tracked: Which poses are valid; ``None`` means all.
        subject: Who was scanned.
        notes: What the reader found and could not express otherwise.
    """

    name: str
    b_mode: ChannelData | None = None
    power_doppler: ChannelData | None = None
    photoacoustic: ChannelData | None = None
    image_to_reference: Float[Tensor, "frames 4 4"] | None = None
    tracked: Bool[Tensor, " frames"] | None = None
    subject: str | None = None
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that there is something and that the frame counts agree.

        Raises:
            ScanError: If not.
        """
        counts = {what: len(data.samples) for what, data in modalities(self).items()}
        if not counts:
            raise ScanError(f"'{self.name}' holds no channel data of any modality")
        if self.image_to_reference is not None:
            counts["poses"] = len(self.image_to_reference)
        if self.tracked is not None:
            counts["tracking flags"] = len(self.tracked)
        if len(set(counts.values())) > 1:
            told = ", ".join(f"{count} {what}" for what, count in counts.items())
            raise ScanError(f"the parts of '{self.name}' have different frame counts: {told}")
        doppler = self.power_doppler
        if doppler is not None and doppler.samples.shape[1] < 2:
            raise ScanError(
                f"power Doppler needs an ensemble of at least 2 pulses, '{self.name}' has"
                f" {doppler.samples.shape[1]}"
            )


def modalities(sweep: ChannelSweep) -> dict[str, ChannelData]:
    """Return the modalities that a sweep holds, by name."""
    named = {
        "b_mode": sweep.b_mode,
        "power_doppler": sweep.power_doppler,
        "photoacoustic": sweep.photoacoustic,
    }
    return {name: data for name, data in named.items() if data is not None}

"""How much of a pulse is left after its way through tissue."""

import numpy as np
from jaxtyping import Float32

from sonosweep.simulate.body import Tissue

ATTENUATION_DB_PER_CM_MHZ = {
    Tissue.OUTSIDE: 40.0,  # air reflects all of it
    Tissue.GEL: 0.02,
    Tissue.SKIN: 1.5,
    Tissue.FAT: 0.48,
    Tissue.FASCIA: 1.5,
    Tissue.MUSCLE: 1.09,
    Tissue.TENDON: 4.7,
    Tissue.NERVE: 1.0,
    Tissue.BONE: 12.0,  # 6.9 in cortical bone, and most is reflected at its surface
    Tissue.VESSEL_WALL: 1.0,
    Tissue.ARTERY: 0.2,
    Tissue.VEIN: 0.2,
}
"""One way, amplitude. Fat, muscle, tendon, blood, bone: Culjat et al., "A review of tissue
substitutes for ultrasound imaging", Ultrasound Med. Biol. 2010, table 1."""


def two_way_loss_db_per_mm(
    center_frequency_hz: float, scale: float = 1.0
) -> Float32[np.ndarray, "256"]:
    """Return the loss of an echo per mm of depth for each tissue label.

    Args:
        center_frequency_hz: Of the echoes; loss is proportional to it.
        scale: Factor for soft tissues, which differ between people; gel, air and bone keep
            theirs.
    """
    loss = np.zeros(256)
    for tissue, one_way in ATTENUATION_DB_PER_CM_MHZ.items():
        is_soft = tissue not in (Tissue.OUTSIDE, Tissue.GEL, Tissue.BONE)
        loss[tissue] = 2 * one_way * (scale if is_soft else 1.0) * center_frequency_hz * 1e-7
    return loss.astype(np.float32)

"""The 256 kinds of voxels that a forearm is made of, so that one byte says all about each.

Where the echogenicity of a tissue varies, neighboring levels are 0.5 to 1 dB apart; speckle
varies by 5.6 dB.
"""

from functools import lru_cache

import numpy as np

from sonosweep.simulate.body import Tissue
from sonosweep.simulate.coded_voxels import Palette
from sonosweep.simulate.forearm_nerves import BUNDLE_DB, NERVE_DB
from sonosweep.simulate.tubes import BLOOD_DB, code_of

LEVELS = {
    Tissue.OUTSIDE: (0,),
    Tissue.GEL: (0,),
    Tissue.SKIN: range(184, 242, 2),
    Tissue.FAT: range(95, 256, 4),
    Tissue.FASCIA: range(131, 256, 4),
    Tissue.MUSCLE: range(83, 256, 4),
    Tissue.TENDON: range(160, 242, 3),
    Tissue.NERVE: (code_of(BUNDLE_DB), code_of(NERVE_DB)),
    Tissue.BONE: range(116, 256, 4),
    Tissue.VESSEL_WALL: range(172, 218, 2),
    Tissue.ARTERY: (code_of(BLOOD_DB),),
    Tissue.VEIN: (code_of(BLOOD_DB),),
}
"""Echogenicity codes (0.25 dB each) that each tissue may have."""


@lru_cache(maxsize=1)
def forearm_palette() -> Palette:
    """Return the palette; what it does not need are copies of its first entry."""
    pairs = np.zeros((256, 2), np.uint8)
    known = [(int(label), level) for label, levels in LEVELS.items() for level in levels]
    pairs[: len(known)] = known
    return Palette(pairs[:, 0].copy(), pairs[:, 1].copy())

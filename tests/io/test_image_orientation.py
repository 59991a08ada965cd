"""Orientations: what the letters of PLUS say about a picture."""

import numpy as np
import pytest

from sonosweep.errors import ScanError
from sonosweep.io.image_orientation import (
    KNOWN_ORIENTATIONS,
    check_orientation,
    turn_frames,
    turn_to,
)

# One frame, marked side right, far side down.
MF = np.array([[[1, 2, 3], [4, 5, 6]]])


@pytest.mark.parametrize(
    ("stored", "frame"),
    [
        ("MF", [[1, 2, 3], [4, 5, 6]]),
        ("MN", [[4, 5, 6], [1, 2, 3]]),
        ("UF", [[3, 2, 1], [6, 5, 4]]),
        ("UN", [[6, 5, 4], [3, 2, 1]]),
        ("FM", [[1, 4], [2, 5], [3, 6]]),
        ("FU", [[3, 6], [2, 5], [1, 4]]),
        ("NM", [[4, 1], [5, 2], [6, 3]]),
        ("NU", [[6, 3], [5, 2], [4, 1]]),
    ],
)
def test_every_stored_orientation_becomes_the_same_picture(stored, frame):
    """The marked side goes right and the far side down, wherever they were."""
    turned = turn_frames(np.array([frame]), turn_to("MF", stored))

    np.testing.assert_array_equal(turned[0], MF[0])
    np.testing.assert_array_equal(turned[0:1], MF)
    assert turned.shape == MF.shape
    assert len(turned) == 1


def test_the_third_letter_says_nothing_about_a_frame():
    """UFD is UF: its frames do not depend on how slices follow each other."""
    for letters in KNOWN_ORIENTATIONS:
        for slices in "ad":
            assert turn_to("MF", letters.lower() + slices) == turn_to("MF", letters)


@pytest.mark.parametrize("stored", ["", "??", "MM", "XX", "MFQ", "MFAA"])
def test_unknown_letters_are_not_guessed(stored):
    """Frames stay as they are, and asking for such an orientation is refused."""
    assert turn_to("MF", stored) is None
    assert turn_frames(MF, turn_to("MF", stored)) is MF
    with pytest.raises(ScanError, match="use one of MF"):
        check_orientation(stored)


def test_colour_channels_stay_with_their_pixel():
    """Mirroring a colour image moves pixels, not colours."""
    colour = np.stack([MF, MF + 10, MF + 20], axis=-1)

    turned = turn_frames(colour, turn_to("MF", "UF"))

    assert turned[0][0, 0].tolist() == [3, 13, 23]


def test_lines_of_rf_keep_depth_along_the_row():
    """RF in FM orientation is left alone, and B-mode in MF becomes FM for RF."""
    assert turn_frames(MF, turn_to("FM", "FM")) is MF
    assert turn_frames(MF, turn_to("FM", "MF")).shape == (1, 3, 2)

"""The six numbers and the forms of others."""

import math

import pytest
import torch
from hypothesis import given
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from sonosweep.geometry import (
    moglo_from_step,
    motion_from_step,
    pose_from_parts,
    rotation_from_euler,
    step_from_moglo,
    step_from_motion,
    step_from_ucl,
    ucl_from_step,
)

from ..strategies import poses

ROUND_OFF = 1e-9  # float64 on mm below 1 m; cm and degrees lose a digit
FORMS = [
    (motion_from_step, step_from_motion),
    (moglo_from_step, step_from_moglo),
    (ucl_from_step, step_from_ucl),
]


@pytest.mark.parametrize(("write", "read"), FORMS)
@given(step=poses(10, largest_angle_rad=1.5))
def test_every_form_round_trips(write, read, step):
    """Writing a step in any of the forms and reading it back changes nothing."""
    assert_close(read(write(step)), step, atol=ROUND_OFF, rtol=0)


def test_motion_worked_example():
    """1 mm to the right, 2 mm deeper, 3 mm forward and 0.1 rad of roll."""
    angles = torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    step = pose_from_parts(
        rotation_from_euler(angles, "ZYX"), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    )

    assert_close(motion_from_step(step), torch.tensor([1, 2, 3, 0, 0, 0.1], dtype=torch.float64))


def test_moglo_axes_are_rows_columns_and_against_our_z():
    """1 mm deeper is 0.1 cm on its first axis; forward for us is backward for it."""
    step = step_from_motion(torch.tensor([2.0, 1.0, 3.0, 0, 0, 0], dtype=torch.float64))

    assert_close(
        moglo_from_step(step), torch.tensor([0.1, 0.2, -0.3, 0, 0, 0], dtype=torch.float64)
    )


def test_moglo_angles_are_intrinsic_yzx_in_degrees():
    """A row of its file is Ry @ Rz @ Rx (SciPy's upper-case YZX) in its own axes."""
    row = torch.tensor([0, 0, 0, 10.0, 20.0, 30.0], dtype=torch.float64)
    theirs = torch.tensor(Rotation.from_euler("YZX", [10, 20, 30], degrees=True).as_matrix())
    swap = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=torch.float64)

    assert_close(step_from_moglo(row)[:3, :3], swap @ theirs @ swap, atol=ROUND_OFF, rtol=0)


def test_ucl_parameters_are_zyx_angles_then_mm():
    """Angles about z, y, x in rad come first, then the translation."""
    parameters = torch.tensor([0.3, 0.2, 0.1, 1.0, 2.0, 3.0], dtype=torch.float64)
    expected = torch.tensor(Rotation.from_euler("ZYX", [0.3, 0.2, 0.1]).as_matrix())

    step = step_from_ucl(parameters)

    assert_close(step[:3, :3], expected, atol=ROUND_OFF, rtol=0)
    assert step[:3, 3].tolist() == [1.0, 2.0, 3.0]


def test_the_order_of_turns_matters_little_for_steps_and_much_for_poses():
    """Below a degree two orders agree to 0.01 degree; at 40 degrees they do not."""
    small = torch.full((6,), math.radians(0.7), dtype=torch.float64)
    large = torch.full((6,), math.radians(40.0), dtype=torch.float64)

    def disagreement(motion):
        return (motion_from_step(step_from_motion(motion, "ZYX"), "XYZ") - motion).abs().max()

    assert float(disagreement(small)) < math.radians(0.01)
    assert float(disagreement(large)) > math.radians(5)

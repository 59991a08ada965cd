"""Tables of poses, as trackers and people write them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError, SonosweepError
from sonosweep.geometry import quaternion_from_rotation, rotation_from_euler
from sonosweep.io.pose_table import read_pose_table
from sonosweep.io.trajectory_text import write_trajectory_csv, write_tum
from sonosweep.scan import Trajectory

from ..strategies import sweeps
from .damage import assert_one_sentence, assert_reads_or_explains, damaged

ROUND_OFF = 1e-12  # float64 on entries of a rotation, and on mm below 1 m


def write(path, text: str):
    """Write text and return where."""
    path.write_text(text)
    return path


@given(sweeps(6), st.booleans(), st.lists(st.text(max_size=20), max_size=3), st.text(max_size=20))
def test_a_csv_gives_back_the_same_trajectory(tmp_path_factory, sweep, known, assumptions, method):
    """Every bit of poses, times and deviations survives, and every character of the words."""
    path = tmp_path_factory.mktemp("csv") / "trajectory.csv"
    trajectory = Trajectory(
        image_to_reference=sweep,
        timestamps_s=torch.arange(6, dtype=torch.float64) / 3 if known else None,
        step_std=torch.rand(5, 6, dtype=torch.float64) if known else None,
        method=method,
        assumptions=tuple(assumptions),
        settings={"direction": "forward"} if known else {},
    )

    write_trajectory_csv(trajectory, path)
    table = read_pose_table(path)

    again = table.trajectory
    assert torch.equal(again.image_to_reference, sweep)
    assert (again.method, again.assumptions) == (method, trajectory.assumptions)
    assert table.frame_indices.tolist() == list(range(6))
    if known:
        assert torch.equal(again.timestamps_s, trajectory.timestamps_s)
        assert torch.equal(again.step_std, trajectory.step_std)
        assert dict(again.settings) == {"direction": "forward"}
    else:
        assert again.timestamps_s is again.step_std is None


def test_a_single_pose_makes_a_csv(tmp_path):
    """One frame has no step, so no deviations."""
    one = Trajectory(torch.eye(4, dtype=torch.float64)[None], step_std=torch.zeros(0, 6).double())

    write_trajectory_csv(one, tmp_path / "one.csv")

    assert read_pose_table(tmp_path / "one.csv").trajectory.step_std.shape == (0, 6)


@given(sweeps(6))
def test_tum_text_gives_back_the_same_poses(tmp_path_factory, sweep):
    """A quaternion says the same as its matrix, and times are exact."""
    path = tmp_path_factory.mktemp("tum") / "trajectory.txt"
    times = torch.arange(6, dtype=torch.float64) * 0.1 + 1.5e9

    write_tum(Trajectory(sweep, times), path)
    again = read_pose_table(path).trajectory

    torch.testing.assert_close(again.image_to_reference, sweep, atol=ROUND_OFF, rtol=0)
    assert torch.equal(again.timestamps_s, times)


def test_tum_without_times_counts_frames(tmp_path):
    """A folder of images has no clock; its trajectory can still be written and plotted."""
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)

    write_tum(Trajectory(poses), tmp_path / "poses.txt")

    assert "frame number" in (tmp_path / "poses.txt").read_text()
    assert read_pose_table(tmp_path / "poses.txt").trajectory.timestamps_s.tolist() == [0, 1, 2]


QUARTER = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
HALF = repr(math.sqrt(0.5))
SAME_POSE = {  # a quarter turn about z, then at (1, 2, 3) mm, at 0.5 s
    "tum": f"0.5 1 2 3 0 0 {HALF} {HALF}\n",
    "quaternion": f"1 2 3 0 0 {HALF} {HALF}\n",
    "csv": f"frame,timestamp,tx,ty,tz,qx,qy,qz,qw\n0,0.5,1,2,3,0,0,{HALF},{HALF}\n",
    "any order": f"qw,qz,qy,qx,note,tz,ty,tx\n{HALF},{HALF},0,0,7,3,2,1\n",
    "semicolons": f"TX;TY;TZ;QX;QY;QZ;QW\n1,0;2,0;3,0;0;0;{HALF};{HALF}\n".replace(".", ","),
    "tabs": f"tx_mm\tty_mm\ttz_mm\tqx\tqy\tqz\tqw\n1\t2\t3\t0\t0\t{HALF}\t{HALF}\n",
    "degrees": "time_s,tx,ty,tz,rx_deg,ry_deg,rz_deg\n0.5,1,2,3,0,0,90\n",
    "radians": f"tx,ty,tz,rx_rad,ry_rad,rz_rad\n1,2,3,0,0,{math.pi / 2!r}\n",
    "matrix": "0 -1 0 1 1 0 0 2 0 0 1 3 0 0 0 1\n",
    "time and matrix": "0.5,0,-1,0,1,1,0,0,2,0,0,1,3,0,0,0,1\n",
    "kitti": "0 -1 0 1 1 0 0 2 0 0 1 3\n",
    "named matrix": ",".join(f"m{i}{j}" for i in range(4) for j in range(4))
    + "\r\n0,-1,0,1,1,0,0,2,0,0,1,3,0,0,0,1\r\n",
    "byte-order mark": f"\ufefftx,ty,tz,qx,qy,qz,qw\n# a comment\n\n1,2,3,0,0,{HALF},{HALF}\n",
}


@pytest.mark.parametrize("text", SAME_POSE.values(), ids=SAME_POSE)
def test_every_layout_says_the_same_pose(tmp_path, text):
    """A quarter turn about z at (1, 2, 3) mm, written in thirteen ways."""
    table = read_pose_table(write(tmp_path / "poses.txt", text), euler_order="ZYX")

    pose = table.trajectory.image_to_reference[0]
    torch.testing.assert_close(pose[:3, :3], QUARTER, atol=ROUND_OFF, rtol=0)
    assert pose[:3, 3].tolist() == [1.0, 2.0, 3.0]
    assert table.trajectory.timestamps_s is None or table.trajectory.timestamps_s.tolist() == [0.5]


def test_the_order_of_euler_turns_is_never_guessed(tmp_path):
    """10, 20 and 30 degrees are different rotations in different orders."""
    text = "tx,ty,tz,rx_deg,ry_deg,rz_deg\n0,0,0,10,20,30\n"
    path = write(tmp_path / "poses.csv", text)
    angles = torch.tensor([10.0, 20, 30], dtype=torch.float64) * math.pi / 180

    with pytest.raises(FormatError, match="say in which order"):
        read_pose_table(path)

    for order in ("ZYX", "YZX"):
        read = read_pose_table(path, euler_order=order).trajectory.image_to_reference[0, :3, :3]
        torch.testing.assert_close(read, rotation_from_euler(angles, order))


def test_meters_become_millimeters(tmp_path):
    """TUM files of other software are in metres: scale=1000 reads them."""
    path = write(tmp_path / "tum.txt", "0 0.1 0.2 0.3 0 0 0 1\n")

    pose = read_pose_table(path, scale=1000.0).trajectory.image_to_reference[0]

    torch.testing.assert_close(pose[:3, 3], torch.tensor([100.0, 200, 300]).double())


def test_six_printed_digits_still_make_a_rotation(tmp_path):
    """Tracker files round; the pose that is read is rigid to float64 precision."""
    angles = torch.tensor([0.3, -0.5, 1.1], dtype=torch.float64)
    rotation = rotation_from_euler(angles, "ZYX")
    rows = torch.cat((rotation, torch.tensor([[1.0], [2], [3]])), dim=1).flatten().tolist()
    path = write(tmp_path / "poses.txt", " ".join(f"{value:.6f}" for value in rows))

    read = read_pose_table(path).trajectory.image_to_reference[0, :3, :3]

    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(read @ read.mT, identity, atol=ROUND_OFF, rtol=0)
    assert float((read - rotation).abs().max()) < 1e-6  # half of the last digit, twice over


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("# only words\n", "holds no poses"),
        ("tx,ty,tz,qx,qy,qz,qw\n", "holds no poses"),
        ("1 2 3\n", "rows of 3 numbers"),
        ("0 1 2 3 0 0 0 1\n0 1 2 3\n", "4 values instead of 8 in line 2"),
        ("0 1 2 3 0 0 x 1\n", "'x' is not a number, in line 1"),
        ("0 1 2 3 0 0 0 0\n", "length 0 instead of 1"),
        ("0 1 2 3 nan 0 0 0\n", "length nan instead of 1"),
        ("0 1 2 nan 0 0 0 1\n", "pose 0 of the trajectory is not rigid"),
        ("nan 1 2 3 0 0 0 1\n", "a time in 'poses.txt' is missing"),
        ("2 0 0 1 0 2 0 2 0 0 2 3 0 0 0 1\n", "not rigid"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1\n", "column by column: transpose"),
        ("tx,ty,tz\n1,2,3\n", "needs a rotation"),
        ("x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,1\n", "needs the columns tx, ty, tz"),
        ("tx,ty,tz,tx,qx,qy,qz,qw\n1,2,3,1,0,0,0,1\n", "column 'tx' occurs twice"),
        ("frame,tx,ty,tz,qx,qy,qz,qw\n0.5,1,2,3,0,0,0,1\n", "frame column"),
        ("tx,ty,tz,qx,qy,qz,qw\n,1,2,0,0,0,1\n", "not rigid"),
        ("\0\0\0\0", "zero bytes"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(tmp_path, text, message):
    """Each message names the line, the pose or the column, and the file."""
    with pytest.raises(FormatError, match=message) as caught:
        read_pose_table(write(tmp_path / "poses.txt", text))

    assert_one_sentence(caught.value)
    assert "poses.txt" in str(caught.value)


def test_no_text_and_no_file_are_said(tmp_path):
    """A picture given as poses, a folder, or a name that was mistyped."""
    (tmp_path / "poses.txt").write_bytes(b"\x89PNG\xff\xfe")

    for path in (tmp_path / "poses.txt", tmp_path, tmp_path / "none.csv"):
        with pytest.raises(FormatError):
            read_pose_table(path)


SMALL = (
    '# sonosweep trajectory 1\n# method: "made up"\n# settings: {"a": "b"}\n'
    "frame,time_s,tx_mm,ty_mm,tz_mm,qx,qy,qz,qw\n0,0.0,1,2,3,0,0,0,1\n1,0.1,1,2,4,0,0,0,1\n"
)


@given(data=st.data())
def test_damaged_tables_are_explained(tmp_path_factory, data):
    """Text lost or changed anywhere gives poses or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / "poses.csv"
    path.write_bytes(data.draw(damaged(SMALL.encode())))

    assert_reads_or_explains(lambda: read_pose_table(path))


@given(
    st.lists(
        st.lists(st.floats(width=32) | st.sampled_from([0.0, 1.0]), min_size=8, max_size=8),
        min_size=1,
        max_size=3,
    )
)
def test_any_numbers_are_rigid_poses_or_refused(tmp_path_factory, rows):
    """No row of eight numbers gets through as a pose that scales or holds NaN."""
    path = tmp_path_factory.mktemp("numbers") / "tum.txt"
    path.write_text("\n".join(" ".join(map(repr, row)) for row in rows))

    try:
        poses = read_pose_table(path).trajectory.image_to_reference
    except SonosweepError as error:
        assert_one_sentence(error)
    else:
        assert bool(torch.isfinite(poses).all())
        assert np.allclose(quaternion_from_rotation(poses[:, :3, :3]).norm(dim=-1), 1)

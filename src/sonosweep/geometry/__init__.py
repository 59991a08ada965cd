"""Poses, steps, motions and points: tensors in, tensors out."""

from sonosweep.geometry.alignment import align_points
from sonosweep.geometry.interpolation import interpolate_poses
from sonosweep.geometry.motion import (
    MOTION_NAMES,
    moglo_from_step,
    motion_from_step,
    step_from_moglo,
    step_from_motion,
    step_from_ucl,
    ucl_from_step,
)
from sonosweep.geometry.plane import frame_corners, pixel_grid, scale_pixels
from sonosweep.geometry.pose import (
    invert_pose,
    is_rigid,
    left_steps_from_poses,
    nearest_pose,
    pose_from_parts,
    poses_from_left_steps,
    poses_from_steps,
    steps_from_poses,
    transform_points,
)
from sonosweep.geometry.rotation import (
    EulerOrder,
    angle_between_rotations,
    euler_from_rotation,
    nearest_rotation,
    quaternion_from_rotation,
    quaternion_from_vector,
    rotation_from_euler,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_quaternion,
    vector_from_rotation,
)

__all__ = [
    "MOTION_NAMES",
    "EulerOrder",
    "align_points",
    "angle_between_rotations",
    "euler_from_rotation",
    "frame_corners",
    "interpolate_poses",
    "invert_pose",
    "is_rigid",
    "left_steps_from_poses",
    "moglo_from_step",
    "motion_from_step",
    "nearest_pose",
    "nearest_rotation",
    "pixel_grid",
    "pose_from_parts",
    "poses_from_left_steps",
    "poses_from_steps",
    "quaternion_from_rotation",
    "quaternion_from_vector",
    "rotation_from_euler",
    "rotation_from_quaternion",
    "rotation_from_vector",
    "scale_pixels",
    "step_from_moglo",
    "step_from_motion",
    "step_from_ucl",
    "steps_from_poses",
    "transform_points",
    "ucl_from_step",
    "vector_from_quaternion",
    "vector_from_rotation",
]

"""Rotations against SciPy's."""

import numpy as np
from cases import each
from scipy.spatial.transform import Rotation, Slerp

from ogm.pose import Trajectory, matrix_to_quaternion, matrix_to_vector, pose, quaternion_to_matrix, vector_to_matrix

SMALL = [1e-3, 1e-8, 1e-13, 0.0, np.pi - 1e-7]
TURNS = np.concatenate([Rotation.random(500, random_state=1).as_rotvec(), np.outer(SMALL, [0.6, 0.0, 0.8])])


def test_they_are_those_of_scipy() -> None:
    other = Rotation.from_rotvec(TURNS)
    R = other.as_matrix()
    np.testing.assert_allclose(vector_to_matrix(TURNS), R, atol=1e-14)
    np.testing.assert_allclose(matrix_to_vector(R), TURNS, atol=1e-14)
    np.testing.assert_allclose(quaternion_to_matrix(3 * other.as_quat()), R, atol=1e-14)
    q = other.as_quat()
    np.testing.assert_allclose(matrix_to_quaternion(R), q * np.where(q[:, 3:] < 0, -1, 1), atol=1e-14)
    assert matrix_to_quaternion(R[:6].reshape(2, 3, 3, 3)).shape == (2, 3, 4)


def test_angles_are_applied_about_fixed_axes_in_this_order() -> None:
    for roll, pitch, yaw in TURNS[:50]:
        expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
        np.testing.assert_allclose(pose(roll=roll, pitch=pitch, yaw=yaw)[:3, :3], expected, atol=1e-14)


@each("shape", [(), (0,), (1,), (40,), (4, 5)])
def test_a_trajectory_turns_as_slerp_does(shape: tuple[int, ...]) -> None:
    stamps = np.cumsum(np.random.default_rng(2).uniform(0.1, 1.0, 20))
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(TURNS[:20]).as_matrix()
    times = np.random.default_rng(3).uniform(stamps[0], stamps[-1], shape)
    found = Trajectory(stamps, poses).at(times)
    assert found.shape == (*shape, 4, 4)
    if times.size:
        expected = Slerp(stamps, Rotation.from_matrix(poses[:, :3, :3]))(times.ravel()).as_matrix()
        np.testing.assert_allclose(found.reshape(-1, 4, 4)[:, :3, :3], expected, atol=1e-12)

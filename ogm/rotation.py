"""Rotations: matrices, quaternions x, y, z, w, and rotation vectors (axis times angle)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["quaternion_to_matrix", "vector_to_matrix", "matrix_to_quaternion", "matrix_to_vector"]


def matrix_to_quaternion(R: ArrayLike) -> NDArray[np.float64]:
    """Return unit quaternions x, y, z, w of rotations, (..., 3, 3) to (..., 4), with w of 0 or more.

    By the greatest of the four, so that no digits are lost (Shepperd 1978).
    """
    R = np.asarray(R, np.float64)
    trace = np.trace(R, axis1=-2, axis2=-1)
    # Rows: the quaternion times 4 x, 4 y, 4 z, 4 w.
    K = np.empty((*R.shape[:-2], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        K[..., i, i] = 1 + 2 * R[..., i, i] - trace
        K[..., i, j] = K[..., j, i] = R[..., i, j] + R[..., j, i]
        K[..., i, 3] = K[..., 3, i] = R[..., k, j] - R[..., j, k]
    K[..., 3, 3] = 1 + trace
    greatest = np.diagonal(K, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(K, greatest[..., None, None], axis=-2)[..., 0, :]
    q *= np.where(q[..., 3:] < 0, -1, 1) / np.linalg.norm(q, axis=-1, keepdims=True)
    return q + 0.0  # no -0


def quaternion_to_matrix(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Return the rotations of quaternions x, y, z, w of any length above 0, (..., 4) to (..., 3, 3)."""
    q = np.asarray(quaternions, np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_vector(R: ArrayLike) -> NDArray[np.float64]:
    """Return axis times angle [rad] of rotations by at most pi, (..., 3, 3) to (..., 3)."""
    q = matrix_to_quaternion(R)
    half_sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(half_sine, q[..., 3:])
    return q[..., :3] * np.where(half_sine > 1e-12, angle / np.maximum(half_sine, 1e-12), 2.0)


def vector_to_matrix(vectors: ArrayLike) -> NDArray[np.float64]:
    """Return the rotations of axis times angle [rad], (..., 3) to (..., 3, 3)."""
    v = np.asarray(vectors, np.float64)
    half = np.linalg.norm(v, axis=-1, keepdims=True) / 2
    return quaternion_to_matrix(np.concatenate([v / 2 * np.sinc(half / np.pi), np.cos(half)], axis=-1))

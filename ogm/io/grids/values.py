"""TEMPORARY until ogm.io.messages is merged."""

import numpy as np

from ogm.state import predict_state


def occupancy_values(grid):
    p = np.rint(100 * grid.probability).astype(np.int8)
    return np.where(predict_state(grid.mass) == 0, np.int8(-1), p)


def grid_of_values(values):
    occ = (values / np.float32(100)).astype(np.float32)
    m = np.stack([1 - occ, occ], axis=-1)
    m[values < 0] = 0
    return m

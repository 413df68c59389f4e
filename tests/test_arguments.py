"""Stamps, poses and masses that are none are refused, not taken for something else."""

import numpy as np
import pytest

from ogm import EvidentialGrid, GridSpec, Scan
from ogm.fusion import BinaryBayesMapper, DynamicMapper, EvidentialMapper
from ogm.io import PlacedGrid
from ogm.pose import LATEST, Trajectory, check_pose, check_stamp

SPEC = GridSpec(0.5, (8, 6), (0.0, 0.0))
GRID = EvidentialGrid.vacuous(SPEC)
STAMPS = ["5", b"5", True, np.True_, 1 + 0j, [5.0], np.array([5.0]), float("nan"), float("inf"), 1e18, -1e12, 10**400]
MAPPERS = [EvidentialMapper, BinaryBayesMapper, DynamicMapper]


@pytest.mark.parametrize("stamp", STAMPS)
def test_what_is_no_time_in_seconds_is_refused(stamp):
    for take in (
        check_stamp,
        lambda one: Scan(np.zeros((1, 4), np.float32), stamp=one),
        lambda one: PlacedGrid(GRID, stamp=one),
        *(lambda one, kind=kind: kind(SPEC).update(GRID, np.eye(4), stamp=one) for kind in (EvidentialMapper,)),
    ):
        with pytest.raises(ValueError, match="stamp must be"):
            take(stamp)


@pytest.mark.parametrize("stamp", [0, -3, 1.5e9, np.float32(2), np.int64(7), LATEST])
def test_times_in_seconds_are_floats(stamp):
    assert type(check_stamp(stamp)) is float
    assert check_stamp(stamp) == stamp


@pytest.mark.parametrize("kind", [complex, str, object, bool])
def test_poses_are_of_real_numbers(kind):
    T = np.eye(4).astype(kind)
    with pytest.raises(ValueError, match="must be a 4x4 array of real numbers"):
        check_pose(T)
    with pytest.raises(ValueError, match="poses must be real numbers"):
        Trajectory([0.0], T[None])
    assert check_pose(np.eye(4, dtype=int)).dtype == np.float64


def test_trajectories_are_in_seconds():
    with pytest.raises(ValueError, match="divide nanoseconds by 1e9"):
        Trajectory([1.3e18, 1.4e18], np.tile(np.eye(4), (2, 1, 1)))


@pytest.mark.parametrize("kind", MAPPERS)
@pytest.mark.parametrize(
    ("mass", "message"),
    [
        (np.zeros((6, 8, 2), np.float32), "wanted float32"),
        (np.zeros((8, 6, 2)), "wanted float32"),
        (np.full((8, 6, 2), np.nan, np.float32), "in .0, 1."),
        (np.full((8, 6, 2), -0.5, np.float32), "in .0, 1."),
        (np.full((8, 6, 2), 1.5, np.float32), "in .0, 1."),
    ],
)
def test_a_trusted_grid_that_is_none_changes_no_map(kind, mass, message):
    mapper = kind(SPEC)
    with pytest.raises(ValueError, match=message):
        mapper.update(EvidentialGrid.trusted(SPEC, mass), np.eye(4), stamp=0.0)
    assert mapper.scans == 0
    one_is_odd = np.zeros((8, 6, 2), np.float32)
    one_is_odd[3, 3] = -0.0, -1e-9  # rounding
    mapper.update(EvidentialGrid.trusted(SPEC, one_is_odd), np.eye(4), stamp=0.0)
    assert np.isfinite(mapper.grid.mass).all()


@pytest.mark.parametrize(
    "arguments",
    [(0.1, (float("inf"), 3), (0, 0)), (0.1, (3, float("nan")), (0, 0)), (10**400, (3, 3), (0, 0)),
     (0.1, (3, 3), (10**400, 0)), (0.1, (10**400, 3), (0, 0))],
)  # fmt: skip
def test_numbers_that_no_float_holds_are_refused(arguments):
    with pytest.raises(ValueError, match="shape|resolution|origin"):
        GridSpec(*arguments)

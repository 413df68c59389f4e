"""Several sensors of one robot: what the plane of a laser calls free clears nothing above or below it."""

import itertools

import numpy as np
from cases import each
from rooms import CAMERA, MAN, TABLE, depths, looking, ranges

from ogm import Frame, GridSpec, Mount, Scan, fuse, load_model
from ogm.fusion import EvidentialMapper
from ogm.io import depth_scan
from ogm.pose import pose

SPEC = GridSpec(0.1, (90, 60), (-3.5, -3.0))
NO_FOOTPRINT = (0.0, 0.0, 0.0, 0.0)
LOW = 0.2  # [m] height of the laser: it sees the legs of the table


def frames(order: str) -> list[Frame]:
    """Return frames of a laser (l) and of a depth camera (d) of a robot that stands, at 10 Hz in an order."""
    boxes, found = (*TABLE, MAN), []
    azimuth = np.radians(np.arange(-135, 135, 0.5))
    ways = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    laser = (ranges(np.array([0, 0, LOW]), ways, boxes)[:, None] * ways).astype(np.float32)
    for k, sensor in enumerate(order):
        T = looking(1.2, 15) if sensor == "d" else pose(z=LOW)
        scan = Scan(laser, stamp=0.1 * k, kind="planar", max_range=8.0)
        if sensor == "d":
            scan = depth_scan(depths(T, boxes), CAMERA, 1.0, stamp=0.1 * k)
        mount = Mount(T[2, 3], T, NO_FOOTPRINT)
        found.append(Frame(scan, mount, T_map_sensor=T, stamp=0.1 * k, name=str(k)))
    return found


@each("order, model", itertools.product(("dllllllll", "lllldllll", "lllllllld"), ("ray+planar+depth",)))
def test_a_laser_between_the_legs_of_a_table_does_not_clear_its_top(order: str, model: str) -> None:
    mapper = EvidentialMapper(SPEC, half_life=np.inf, window="fixed")
    for step in fuse(frames(order), load_model(model, SPEC), mapper):
        assert step.grid is not None
    grid = mapper.grid
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    table = (x > 2.0) & (x < 2.9) & (abs(y) < 0.5)
    assert grid.occupied[table].min() > 0.5
    assert grid.free[table].max() < 0.5
    assert grid.occupied[(x > 1.7) & (x < 1.9) & (y > 0.85) & (y < 1.05)].max() > 0.9  # the man
    assert grid.free[(x > 0.2) & (x < 0.8) & (abs(y - 2) < 0.5)].min() > 0.5  # beside the view, in the laser's plane
    assert (grid.mass.sum(-1) <= 1 + 1e-6).all()
    only = EvidentialMapper(SPEC, half_life=np.inf, window="fixed")
    for _ in fuse([one for one in frames(order) if one.scan.kind == "planar"], load_model(model, SPEC), only):
        pass
    assert only.grid.free[table].max() > 0.7

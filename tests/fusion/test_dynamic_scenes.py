"""The dynamic map on cast scans: what moves is found soon and keeps its cells, what stops and what stands is static."""

import numpy as np
from cases import each
from cast_scenes import MOUNT, Look, braking, driving, looks
from dynamic_scenes import Block

from ogm.geometric import RayISM
from ogm.grid import GridSpec

SPEC = GridSpec.centered(length=48.0, width=38.4, resolution=0.2)
ISM, LIDAR = RayISM(SPEC, MOUNT), "hdl-32e"
HOUSES = [(Block(-40 + 15 * k, side * 12, 0, 0, length=9, width=6, yaw=0.0), 6.0) for k in range(8) for side in (-1, 1)]
PARKED = [(Block(-15 + 9 * k, -5, 0, 0, length=4.5, width=1.8, yaw=0.0), 1.5) for k in range(6)]


def moving_share(look: Look) -> float:
    """Return the share of the cells of the first block that the scan shows, which are predicted moving."""
    cells = look.near[0] & look.shown
    return float((look.moving & cells).sum() / max(cells.sum(), 1))


def seconds(first: float, last: float) -> np.ndarray:
    return np.arange(round(10 * first), round(10 * last) + 1) / 10


def test_a_truck_keeps_its_cells():
    """Its inside was free and is hidden then: no scan measures it as occupied."""
    truck, free = Block(-14, 5, 8, 0, length=12, width=2.5), []
    for look in looks(ISM, lambda t: [(truck.at(t), 3.5)], driving(0.0), seconds(0, 2.2), lidar=LIDAR):
        free += [(look.view.free[look.cells[0]] > 0.5).mean()] if look.stamp >= 0.5 else []
    assert max(free) <= 0.15


@each("course", [Block(12, -12, 0, 8), Block(20, 3.5, -8, 0)])
def test_what_brakes_to_a_stop_stands_within_half_a_second(course):
    car = braking(course, 0.5, 6.0)
    for look in looks(ISM, lambda t: [(car(t), 1.5)], driving(0.0), seconds(0, 2.3), lidar=LIDAR):
        if look.stamp == 0.5:
            assert moving_share(look) > 0.8
    assert moving_share(look) < 0.05  # it stands from 1.83 s on
    assert look.objects == 0


def test_a_car_that_crosses_is_found_when_half_of_it_is_out_of_a_shadow():
    ism = RayISM(GridSpec.centered(length=48.0, width=38.4, resolution=0.16), MOUNT)
    house = (Block(9, -10, 0, 0, length=6, width=14, yaw=0.0), 5.0)
    car = Block(15, -9, 0, 10, length=4.5, width=1.8)
    first = None
    for look in looks(ism, lambda t: [(car.at(t), 1.5), house], driving(0.0), seconds(0, 1.4), lidar=LIDAR):
        first = look.stamp if first is None and (look.near[0] & look.shown).any() else first
        if first is not None and moving_share(look) >= 0.5:
            break
    assert look.stamp <= first + 0.4 + 1e-6


def test_edges_that_come_out_of_shadows_do_not_move():
    wrong, objects = [], 0
    for look in looks(ISM, lambda t: HOUSES + PARKED, driving(10.0), seconds(0, 1.5), lidar=LIDAR):
        wrong.append((look.moving & look.shown).sum() / look.shown.sum())
        objects += look.objects
    assert np.mean(wrong) < 0.01
    assert objects == 0

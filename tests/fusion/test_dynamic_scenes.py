"""The dynamic map on cast scenes: moving objects are found soon and keep their cells, and what stops is static."""

import numpy as np
from cast_scenes import MOUNT, braking, looks
from dynamic_scenes import Block

from ogm.geometric import RayISM
from ogm.grid import GridSpec

ISM = RayISM(GridSpec.centered(length=48.0, width=38.4, resolution=0.2), MOUNT)


def test_a_truck_keeps_its_cells():
    """Its inside was free and is hidden then: no scan measures it as occupied."""
    truck, free = Block(-14, 5, 8, 0, length=12, width=2.5), []
    for look in looks(ISM, lambda t: [(truck.at(t), 3.5)], 2.2):
        free += [(look.view.free[look.cells] > 0.5).mean()] if look.stamp >= 0.5 else []
    assert max(free) <= 0.15


def test_what_brakes_to_a_stop_stands_within_half_a_second():
    car = braking(Block(12, -12, 0, 8), 0.5, 6.0)
    for look in looks(ISM, lambda t: [(car(t), 1.5)], 2.3):
        if look.stamp == 0.5:
            assert look.share > 0.8
    assert look.share < 0.05  # it stands from 1.83 s on
    assert look.objects == 0


def test_a_car_that_crosses_is_found_when_half_of_it_is_out_of_a_shadow():
    ism = RayISM(GridSpec.centered(length=48.0, width=38.4, resolution=0.16), MOUNT)
    building = (Block(9, -10, 0, 0, length=6, width=14, yaw=0.0), 5.0)
    car, first = Block(15, -9, 0, 10, length=4.5, width=1.8), None
    for look in looks(ism, lambda t: [(car.at(t), 1.5), building], 1.4):
        first = look.stamp if first is None and (look.near & look.shown).any() else first
        if first is not None and look.share >= 0.5:
            break
    assert look.stamp <= first + 0.4 + 1e-6


def test_edges_that_come_out_of_shadows_do_not_move():
    """Gaps between buildings and behind parked cars open while the vehicle drives by at 10 m/s."""
    sides = [Block(-40 + 15 * k, y, 0, 0, length=9, width=6, yaw=0.0) for k in range(8) for y in (-12, 12)]
    parked = [Block(-15 + 9 * k, -5, 0, 0, length=4.5, width=1.8, yaw=0.0) for k in range(6)]
    blocks, moving, objects = [(block, 6.0) for block in sides] + [(block, 1.5) for block in parked], [], 0
    for look in looks(ISM, lambda _: blocks, 1.5, speed=10.0):
        moving.append((look.moving & look.shown).sum() / look.shown.sum())
        objects += look.objects
    assert np.mean(moving) < 0.01
    assert objects == 0

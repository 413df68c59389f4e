"""Laws of the default map, on cast scenes: free falls at once and rises slowly, and whatever has left is not kept."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from cases import each, needs

from ogm.datasets import open_dataset
from ogm.fusion import fuse, make_mapper, rolling_window
from ogm.grid import CombinedGrid, EvidentialGrid, GridSpec
from ogm.metrics import accumulate, score
from ogm.models import load_model
from ogm.scan import run_model
from ogm.simulation.hand_built_scenes import ANY, car, road
from ogm.simulation.mesh import Mesh, box, merge
from ogm.simulation.shape_scan import MOUNT, SPEC, rectangle, scan_shapes

needs("open3d", "onnxruntime")

HALF_LIVES = (2.0, float("inf"))
STEP = 0.1  # [s]
AHEAD = slice(256, 448), slice(96, 256)  # cells of SPEC around the objects
SMALL = GridSpec(SPEC.resolution, (192, 160), (0.0, -12.8))
Mask = np.ndarray


class Cast(NamedTuple):
    """A scene: grids of two scans, with noise of their own, cells with returns of the object, and its footprint."""

    grids: list[CombinedGrid]
    hits: Mask
    footprint: Mask


def cut(grid: EvidentialGrid) -> CombinedGrid:
    """Return the cells around the objects, so that maps are small."""
    assert isinstance(grid, CombinedGrid)
    parts = [np.ascontiguousarray(part[AHEAD]) for part in grid.parts]
    return CombinedGrid.of_parts(SMALL, parts, grid.combine)


def posts(places: list[tuple[float, float]], width: float, height: float) -> Mesh:
    return merge([box((x, y, 0), (x + width, y + width, height), ANY) for x, y in places])


@pytest.fixture(scope="module")
def scenes() -> dict[str, Cast]:
    """Scenes by name, mapped by the default model."""
    model = load_model("combined", SPEC, MOUNT)
    body, footprint = car(12.0, 1.0)
    rails = [box((2, 9, z), (28, 9.05, z + 0.1), ANY) for z in (0.4, 0.9)]
    objects = {
        "empty": (None, (0.0, 0.0, 0.0, 0.0)),
        "car": (body, footprint),
        "person": (posts([(13.8, -2.2)], 0.4, 1.7), (13.8, 14.2, -2.2, -1.8)),
        "poles and fence": (merge([posts([(9, 4), (14, -5), (18, 6)], 0.15, 2.5), *rails]), (0.0, 0.0, 0.0, 0.0)),
    }
    found = {}
    for name, (mesh, place) in objects.items():
        grids, hits = [], np.zeros(SPEC.shape, bool)
        for seed in (0, 1):
            cast = scan_shapes(np.random.default_rng(seed), {"ground": road()} | ({"it": mesh} if mesh else {}))
            grids.append(cut(model(cast.scan)))
            hits |= cast.regions.get("it", hits)
        found[name] = Cast(grids, hits[AHEAD], rectangle(*place, whole=True)[AHEAD])
    return found


def mapped(grids: list[CombinedGrid], half_life: float) -> Iterator[np.ndarray]:
    """Yield the masses of the default map after each scan of a standing vehicle."""
    mapper = make_mapper("revise", SMALL, half_life, window="fixed")
    for k, grid in enumerate(grids):
        mapper.update(grid, np.eye(4), stamp=STEP * k)
        yield mapper.grid.mass


def repeated(scene: Cast, count: int) -> list[CombinedGrid]:
    return [scene.grids[k % 2] for k in range(count)]


def shares(masses: list[np.ndarray], cells: Mask, state: int) -> list[float]:
    """Return the share of some cells that are free (0) or occupied (1), after each scan."""
    return [float((mass[cells][:, state] > 0.5).mean()) for mass in masses]


@each("half_life", HALF_LIVES)
def test_one_wrong_scan_frees_no_obstacle(scenes: dict[str, Cast], half_life: float) -> None:
    here, gone = scenes["car"], scenes["empty"]
    maps = list(mapped(repeated(here, 15) + repeated(gone, 1) + repeated(here, 3), half_life))
    free, occupied = shares(maps[15:], here.hits, 0), shares(maps[15:], here.hits, 1)
    assert free[0] <= 0.1
    assert max(free[1:]) <= 0.05
    assert occupied[1] >= 0.8


@each("half_life", HALF_LIVES)
def test_a_new_obstacle_is_never_free(scenes: dict[str, Cast], half_life: float) -> None:
    for name in ("car", "person"):
        here = scenes[name]
        maps = list(mapped(repeated(scenes["empty"], 15) + repeated(here, 4), half_life))[15:]
        free = shares(maps, here.hits, 0)
        assert free[0] <= 0.25, name
        assert max(free[1:]) == 0, name
        assert shares(maps, here.hits, 1)[3] >= 0.8, name


@each("half_life", HALF_LIVES)
def test_the_place_of_a_car_that_left_is_free_within_half_a_second(scenes: dict[str, Cast], half_life: float) -> None:
    was = scenes["car"]
    maps = list(mapped(repeated(was, 15) + repeated(scenes["empty"], 5), half_life))[14:]
    free = shares(maps, was.footprint, 0)
    assert free[0] < 0.05  # while it stood there
    assert free[1] < 0.5  # slowly: not by one scan
    assert free[5] > 0.95


def test_without_forgetting_a_person_and_strays_go_and_poles_and_a_fence_stay(scenes: dict[str, Cast]) -> None:
    rng, empty, person = np.random.default_rng(0), scenes["empty"], scenes["person"]
    strayed, was_stray = [], np.zeros(SMALL.shape, bool)
    for grid in repeated(person, 20):
        cells = tuple(rng.integers(0, n, 40) for n in SMALL.shape)
        was_stray[cells] = True
        parts = [part.copy() for part in grid.parts]
        for part in parts:
            part[cells] = 0, 0.9
        strayed.append(CombinedGrid.of_parts(SMALL, parts, grid.combine))
    maps = list(mapped(strayed + repeated(empty, 30), float("inf")))
    measured = empty.grids[0].mass[..., 0] > 0.5
    assert shares(maps, person.hits, 1)[19] > 0.5  # it was there
    assert shares(maps, was_stray & measured, 1)[19] > 0.02
    for cells in (person.footprint, person.hits, was_stray & measured):
        assert not (maps[-1][cells][:, 1] > 0.5).any()
    assert shares(maps, person.footprint, 0)[-1] == 1

    fixed = scenes["poles and fence"]
    *_, last = mapped(repeated(fixed, 40), float("inf"))
    assert (last[fixed.hits][:, 1] > 0.5).mean() > 0.9
    assert not (last[fixed.hits][:, 0] > 0.5).any()


@pytest.mark.slow
@each("place", ("kitti_odometry_00", "sustechpoints", "kitti_raw_0005"))
def test_the_map_of_a_real_drive_has_no_more_false_free_than_its_scans(real, place: str) -> None:
    frames = open_dataset(real(place), others="later")
    model, mapper = load_model("combined", SPEC), make_mapper("revise", rolling_window(SPEC))
    of_scans, of_map = [], []
    for frame, step in zip(frames, fuse(frames, lambda scan: model(scan), mapper), strict=True):
        assert step.error is None
        truth = frame.truth.crop(SPEC).state
        of_scans.append(score(accumulate(run_model(model, frame).mass, truth))["false_free"])
        of_map.append(score(accumulate(mapper.view(SPEC).mass, truth))["false_free"])
    assert np.nanmean(of_map) <= np.nanmean(of_scans)

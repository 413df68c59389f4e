"""Why cells of a map are unknown: forgotten, contradicted, or the cause of the last scan that covered them."""

import numpy as np
import pytest
from cases import each, refused

from ogm import EvidentialGrid, GridSpec, UnknownCause
from ogm.evidence import dempster, pcr6, revise, yager
from ogm.fusion import EvidentialMapper
from ogm.grid import CombinedGrid, PartialGrid
from ogm.pose import pose
from ogm.state import predict_state

K = UnknownCause
SPEC = GridSpec.centered(4.0, 4.0, 0.5)


def measured(free: float, occupied: float, cause: int | None = 0, spec: GridSpec = SPEC) -> EvidentialGrid:
    grid = EvidentialGrid(spec, np.broadcast_to(np.float32([free, occupied]), (*spec.shape, 2)).copy())
    return grid if cause is None else grid.with_cause(np.full(spec.shape, cause, np.uint8))


def causes(mapper: EvidentialMapper) -> set[UnknownCause]:
    return {K(int(code)) for code in np.unique(mapper.cause["cause"])}


@each("rule", [revise, yager, pcr6])
def test_a_map_names_the_last_knowledge_that_it_lost(rule) -> None:
    mapper = EvidentialMapper(SPEC, rule, half_life=1.0, min_unknown=0.02)
    assert not mapper.has_causes
    refused("no scan of the map has causes", lambda: mapper.cause)
    mapper.update(measured(0, 0, K.BEHIND_OBSTACLE), pose(), stamp=0.0)
    assert causes(mapper) == {K.BEHIND_OBSTACLE}
    mapper.update(measured(0, 0, K.NO_ECHO), pose(), stamp=0.1)
    assert causes(mapper) == {K.NO_ECHO}
    mapper.update(measured(0.8, 0), pose(), stamp=0.2)
    assert causes(mapper) == {K.KNOWN}
    mapper.update(measured(0, 0, K.OUTSIDE_VIEW), pose(), stamp=4.0)
    assert causes(mapper) == {K.FORGOTTEN}
    mapper.update(measured(0, 0, None), pose(), stamp=4.1)  # a sensor that does not say why
    assert causes(mapper) == {K.FORGOTTEN}
    mapper.update(measured(0.8, 0), pose(), stamp=4.2)
    assert causes(mapper) == {K.KNOWN}
    mapper.reset()
    refused("no scan of the map has causes", lambda: mapper.cause)


def test_a_map_that_is_contradicted_says_so() -> None:
    mapper = EvidentialMapper(SPEC, yager, half_life=10.0)
    mapper.update(measured(0.8, 0), pose(), stamp=0.0)
    mapper.update(measured(0, 0.8), pose(), stamp=0.1)
    assert (predict_state(mapper.grid.mass) == 0).all()
    assert causes(mapper) == {K.CONTRADICTED}
    mapper.update(measured(0, 0, K.NO_ECHO), pose(), stamp=0.2)
    assert causes(mapper) == {K.CONTRADICTED}


def test_cells_that_come_into_view_are_outside_it_until_a_scan_covers_them() -> None:
    half = GridSpec(0.5, (4, 8), (-2.0, -2.0))
    mapper = EvidentialMapper(SPEC, half_life=1.0)
    mapper.update(measured(0, 0, K.BETWEEN_BEAMS, half), pose(), stamp=0.0)
    cause = mapper.cause["cause"]
    assert (cause[:4] == K.BETWEEN_BEAMS).all()
    assert (cause[4:] == K.OUTSIDE_VIEW).all()
    mapper.update(measured(0.1, 0, 0, half), pose(1.0), stamp=0.1)  # known to the scan, too weak for the map
    assert (mapper.cause["cause"][:4] == K.BETWEEN_BEAMS).all()
    assert (mapper.cause["cause"][4:] == K.OUTSIDE_VIEW).all()
    assert mapper.cause.spec == mapper.grid.spec


def test_maps_of_several_models_and_of_planes_know_what_they_know_together() -> None:
    parts = [np.full((*SPEC.shape, 2), (0.5, 0.0), np.float32)] * 2
    both = CombinedGrid.of_parts(SPEC, parts, lambda masses: dempster(*masses))
    mapper = EvidentialMapper(SPEC, half_life=np.inf)
    mapper.update(both.with_cause(np.zeros(SPEC.shape, np.uint8)), pose(), stamp=0.0)
    assert causes(mapper) == {K.KNOWN}
    plane = PartialGrid.of(SPEC, (0, 0), np.full((2, 8, 2), (0.7, 0.0), np.float32), in_plane=True)
    mapper = EvidentialMapper(SPEC, half_life=np.inf)
    mapper.update(plane.with_cause(np.full(SPEC.shape, K.BEHIND_OBSTACLE, np.uint8)), pose(), stamp=0.0)
    cause = mapper.cause["cause"]
    assert (cause[:2] == K.KNOWN).all()
    assert (cause[2:] == K.BEHIND_OBSTACLE).all()


def test_codes_are_those_of_a_loop_over_cells() -> None:
    """Against plain Python, while the window rolls and scans are turned."""
    rng = np.random.default_rng(0)
    mapper = EvidentialMapper(GridSpec.centered(8.0, 8.0, 0.5), yager, half_life=0.3, conflict_half_life=0.4)
    codes: dict[tuple[int, int], int] = {}
    for step in range(12):
        mass = (
            rng.choice([0.0, 0.0, 0.5, 0.9], (*SPEC.shape, 1))
            * rng.permutation(np.eye(2))[rng.integers(0, 2, SPEC.shape)]
        )
        grid = EvidentialGrid(SPEC, mass.astype(np.float32))
        cause = np.where(predict_state(grid.mass) == 0, rng.integers(1, 7, SPEC.shape), 0).astype(np.uint8)
        T = pose(0.4 * step, 0.1 * step, yaw=0.3 * step)
        mapper.update(grid.with_cause(cause), T, stamp=0.1 * step)
        spec, states, clash = mapper.spec, predict_state(mapper.grid.mass), mapper.conflict
        most = np.maximum(*clash.layers.values())
        x, y = spec.cell_centers
        first = np.rint(np.array(spec.origin) / 0.5).astype(int)
        inside = {}
        for i, j in np.ndindex(spec.shape):
            key = (int(first[0]) + i, int(first[1]) + j)
            before = codes.get(key, 0)
            u, v = (np.linalg.inv(T) @ [x[i, 0], y[0, j], 0, 1])[:2]
            scan = int(cause[*SPEC.index(u, v)]) if SPEC.contains(u, v) else -1
            if states[i, j]:
                code = 255
            elif before == 255:
                code = K.CONTRADICTED if most[i, j] >= 0.25 else K.FORGOTTEN
            elif before in (K.FORGOTTEN, K.CONTRADICTED) or scan < 0:
                code = before
            else:
                code = scan or max(before, K.BETWEEN_BEAMS)
            inside[key] = int(code)
        codes = inside
        expected = np.array(list(codes.values())).reshape(spec.shape)
        shown = np.where(expected == 255, 0, np.where(expected == 0, K.OUTSIDE_VIEW, expected))
        np.testing.assert_array_equal(mapper.cause["cause"], shown)
    assert set(codes.values()) >= {0, 255, K.FORGOTTEN, K.CONTRADICTED}


def test_a_rule_that_fails_leaves_the_causes_as_they_were() -> None:
    mapper = EvidentialMapper(SPEC, lambda a, b: np.full_like(a, 0.7) if b.max() > 0.5 else a, half_life=1.0)
    mapper.update(measured(0.1, 0, K.NO_ECHO), pose(), stamp=0.0)
    before = mapper.cause
    with pytest.raises(ValueError, match="sum"):
        mapper.update(measured(0.9, 0), pose(1.0), stamp=0.1)
    assert mapper.cause == before

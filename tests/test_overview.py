"""Bytes and levels of half the resolution: how far numbers are off, and that what is occupied stays visible."""

from itertools import product

import numpy as np
from cases import each
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ogm.plot.overview import FULL_MASS, Steps, halve_mass, halve_numbers, mass_to_bytes

SHAPES = st.tuples(st.integers(1, 5), st.integers(1, 5))


@st.composite
def byte_masses(draw: st.DrawFn) -> np.ndarray:
    """Masses as bytes: many are 0, 1/2 or 1, so that ties happen."""
    shape = draw(SHAPES)
    some = st.sampled_from([0, 1, 85, 127, 128, 254, 255]) | st.integers(0, 255)
    occupied = draw(arrays(np.uint8, shape, elements=some))
    free = np.minimum(draw(arrays(np.uint8, shape, elements=some)), FULL_MASS - occupied)
    return np.stack([free, occupied], axis=-1)


def is_occupied(free: int, occupied: int) -> bool:
    """Return the rule of `ogm.state.predict_state`, in whole numbers."""
    return occupied > FULL_MASS - free - occupied and occupied >= free


def blocks(cells: np.ndarray) -> dict[tuple[int, int], list[tuple[int, ...]]]:
    """Return the cells of each block of 2 x 2, where the far border is repeated."""
    (nx, ny), found = cells.shape[:2], {}
    for i, j in product(range(-(-nx // 2)), range(-(-ny // 2))):
        corners = product((2 * i, min(2 * i + 1, nx - 1)), (2 * j, min(2 * j + 1, ny - 1)))
        found[i, j] = [tuple(int(one) for one in cells[at]) for at in corners]
    return found


@given(st.floats(0, 1), st.floats(0, 1))
def test_masses_are_at_most_half_a_step_off_and_sum_to_at_most_one(first: float, second: float) -> None:
    mass = np.array([first, second * (1 - first)], np.float32)
    steps = mass_to_bytes(mass).astype(int)
    assert (np.abs(steps - 255.0 * mass) <= 0.5 + 1e-4).all()
    assert steps.sum() <= 255


@each("mass, steps", [((0.5, 0.5), (127, 128)), ((1, 0), (255, 0)), ((0, 1), (0, 255))])
def test_ends_and_halves_are_exact(mass: tuple[float, float], steps: tuple[int, int]) -> None:
    assert mass_to_bytes(np.array(mass, np.float32)).tolist() == list(steps)


@given(byte_masses())
def test_a_block_is_its_most_occupied_cell_or_the_mean(cells: np.ndarray) -> None:
    half = halve_mass(cells)
    for at, four in blocks(cells).items():
        occupied = [one for one in four if is_occupied(*one)]
        if occupied:
            assert is_occupied(*half[at].tolist())
            assert half[at].tolist() in [list(one) for one in occupied if one[1] == max(o for _, o in occupied)]
        else:
            assert half[at].tolist() == [sum(one[k] for one in four) // 4 for k in (0, 1)]
    assert half.astype(int).sum(axis=-1).max() <= FULL_MASS


def test_one_occupied_cell_is_seen_from_afar() -> None:
    cells = np.zeros((512, 300, 2), np.uint8)
    cells[..., 0] = 255
    cells[313, 77] = 0, 200
    while len(cells) > 1:
        cells = halve_mass(cells)
    assert cells.tolist() == [[[0, 200]]]


@given(
    arrays(np.uint8, SHAPES.map(lambda shape: (*shape, 2)), elements=st.sampled_from([0, 1, 90, 128, 255])),
    st.sampled_from([(-5.0, 5.0), (0.0, 1.0), (-3.0, 1.0), (2.0, 2.0)]),
)
def test_other_numbers_are_those_of_the_cell_furthest_from_zero(cells: np.ndarray, ends: tuple[float, float]) -> None:
    steps = Steps(*ends)
    numbers = steps.numbers

    def size(cell: tuple[int, ...]) -> float:
        return sum(-1.0 if byte == 0 else numbers[byte] ** 2 for byte in cell)

    half = halve_numbers(cells, steps)
    for at, four in blocks(cells).items():
        assert tuple(half[at].tolist()) in four
        assert size(tuple(half[at].tolist())) == max(map(size, four))


@given(arrays(np.float32, st.tuples(st.integers(1, 6), st.integers(1, 6)), elements=st.floats(-1e6, 1e6, width=32)))
def test_numbers_are_at_most_half_a_step_off(layer: np.ndarray) -> None:
    layer[0, 0] = np.nan
    steps = Steps.of(layer)
    read = steps.numbers[steps.to_bytes(layer)]
    assert np.isnan(read[0, 0])
    known = ~np.isnan(layer)
    assert (np.isnan(read) == ~known).all()
    assert (np.abs(read - layer)[known] <= 0.5001 * steps.step + 1e-9 * np.abs(layer[known])).all()


def test_steps_hold_all_finite_numbers_and_zero_where_they_are_symmetric() -> None:
    layer = np.array([[np.inf, -3.0, np.nan], [1.0, 0.0, -np.inf]], np.float32)
    assert Steps.of(layer) == (-3.0, 1.0)
    symmetric = Steps.of(layer, layer + 1, symmetric=True)
    assert symmetric == (-3.0, 3.0)
    assert abs(symmetric.numbers[symmetric.to_bytes(np.zeros(1))[0]]) < 1e-12
    assert Steps.of(layer).to_bytes(layer)[[0, 1], [0, 2]].tolist() == [255, 1]
    assert Steps.of(np.full((2, 2), np.nan)) == (0.0, 0.0)
    assert Steps(2.0, 2.0).to_bytes(np.array([2.0, np.nan])).tolist() == [1, 0]

"""How long do distances, costs and answers for a planner take? Beside a copy, scipy and plain numpy.

    python benchmarks/planning.py [--rounds N]

One core, the shipped scan of a road on 512 x 352 cells of 0.16 m, by `RayISM`. Writes benchmarks/results/planning.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from typing import Any

import numpy as np
from _timing import Contender, measure
from numpy.typing import NDArray
from scipy import ndimage

from ogm import EvidentialGrid, GridSpec, Mount, read_scan
from ogm.geometric import RayISM
from ogm.planning import collision, costmap, distance_to_obstacles, inflated, ray_is_free
from ogm.state import CellState, predict_state

COSTS = 0.9, 3.0, 2.0  # inscribed and inflation radius [m], cost_scaling [1/m]
CAR = -1.0, 3.5, -0.9, 0.9  # [m]: 4.5 x 1.8 m
COUNT = 1000
LIMITS = {"distance_to_obstacles": 6.0, "costmap": 8.0, "collision, 1,000 footprints of 4.5 x 1.8 m": 5.0}  # [ms]


def plain_costs(grid: EvidentialGrid) -> NDArray[np.float64]:
    """Return the costs of nav2's formula in scipy and numpy."""
    inscribed, radius, scaling = COSTS
    state = predict_state(grid.mass)
    distance = ndimage.distance_transform_edt(state != CellState.OCCUPIED) * grid.spec.resolution
    costs = np.floor(252 * np.exp(-scaling * (distance - inscribed)))
    costs[distance <= inscribed], costs[distance == 0], costs[distance > radius] = 253, 254, 0
    costs[(state == CellState.UNKNOWN) & (costs < 253)] = 255
    return costs


def plain_collision(grid: EvidentialGrid, poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the greatest occupied under each footprint, by points half a cell apart in numpy."""
    step = grid.spec.resolution / 2
    x, y = (a.ravel() for a in np.meshgrid(np.arange(CAR[0], CAR[1], step), np.arange(CAR[2], CAR[3], step)))
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    cells = grid.spec.index(poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y)
    return grid.occupied[cells].max(axis=1)


def main() -> None:
    parser = run.Parser(__doc__, rounds=30)
    given = parser.parse_args()
    record: dict[str, Any] = run.environment("ray")
    scan = read_scan(run.ROOT / "ogm/data/vls128_road.pcd.xz", axes=("+y", "-x", "+z"))
    grid = RayISM(GridSpec.centered(), Mount(1.98))(scan)
    rng = np.random.default_rng(0)
    poses = np.column_stack(
        [rng.uniform(-35, 35, COUNT), rng.uniform(-22, 22, COUNT), rng.uniform(-np.pi, np.pi, COUNT)]
    )
    ends, copy = poses[:, :2] + 20 * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])]), grid.mass.copy()
    points = rng.uniform((-40, -28), (40, 28), (10_000, 2))
    occupied = predict_state(grid.mass) == CellState.OCCUPIED
    contenders = {
        "copy of the masses": Contender(lambda _: np.copyto(copy, grid.mass)),
        "distance_to_obstacles": Contender(lambda _: distance_to_obstacles(grid)),
        "scipy: distance_transform_edt": Contender(lambda _: ndimage.distance_transform_edt(~occupied)),
        "costmap": Contender(lambda _: costmap(grid, *COSTS)),
        "scipy and numpy: nav2's formula": Contender(lambda _: plain_costs(grid)),
        "inflated, 0.9 m": Contender(lambda _: inflated(grid, COSTS[0])),
        "collision, 1,000 footprints of 4.5 x 1.8 m": Contender(lambda _: collision(grid, CAR, poses)),
        "numpy: points of 1,000 footprints": Contender(lambda _: plain_collision(grid, poses)),
        "ray_is_free, 1,000 lines of 20 m": Contender(lambda _: ray_is_free(grid, poses[:, :2], ends)),
        "opinion_at, 10,000 points": Contender(lambda _: grid.opinion_at(points)),
        "opinion_at, bilinear": Contender(lambda _: grid.opinion_at(points, "bilinear")),
    }
    times = measure(contenders, given.rounds)
    copied = times["copy of the masses"].median
    record["times"] = {
        name: {"median [ms]": one.median, "x copy": one.median / copied, "on core": one.on_core}
        for name, one in times.items()
    }
    record["share of occupied cells"] = float(occupied.mean())
    limits = ((name, times[name].median, "<=", limit, "ms") for name, limit in LIMITS.items())
    record["verdicts"] = run.verdicts(limits)
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()

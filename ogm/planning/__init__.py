"""Distances, costs and collision checks for planners, from grids of scans and of maps.

>>> import numpy as np
>>> from ogm import EvidentialGrid, GridSpec
>>> from ogm.planning import collision, costmap, distance_to_obstacles, ray_is_free
>>> spec = GridSpec(0.5, (20, 10), (0.0, 0.0))
>>> mass = np.full((*spec.shape, 2), (0.9, 0.0), np.float32)
>>> mass[16, 4] = 0.0, 0.8                                               # an obstacle at x = 8.25 m, y = 2.25 m
>>> grid = EvidentialGrid(spec, mass)
>>> float(distance_to_obstacles(grid, unknown="free")[10, 4])
3.0
>>> costmap(grid, inscribed_radius=0.5, inflation_radius=1.5, cost_scaling=2.0)[12:17, 4].tolist()
[0, 34, 92, 253, 254]
>>> poses = np.array([(x, 2.25, 0.0) for x in (2.0, 4.0, 6.0)])          # x, y [m], yaw [rad]
>>> collision(grid, (-1.0, 3.0, -0.9, 0.9), poses).first_doubtful
2
>>> bool(ray_is_free(grid, (1.0, 1.0), (9.0, 1.0))), bool(ray_is_free(grid, (1.0, 2.25), (9.0, 2.25)))
(True, False)
"""

from ogm.planning.costs import CostUnknown, costmap
from ogm.planning.distances import DistanceUnknown, distance_to_obstacles, inflated
from ogm.planning.footprints import Collision, collision, ray_is_free

__all__ = [
    "Collision", "CostUnknown", "DistanceUnknown", "collision", "costmap", "distance_to_obstacles", "inflated",
    "ray_is_free",
]  # fmt: skip

"""Is the way ahead free? A map is asked along a path: opinions at points, the vehicle's footprint, lines of sight.

python examples/path_query.py
"""

import numpy as np
from yard import MOUNT, frames

from ogm import GridSpec
from ogm.fusion import DynamicMapper, EvidentialMapper, Mapper, fuse, rolling_window
from ogm.geometric import RayISM
from ogm.planning import Collision, collision, ray_is_free

FOOTPRINT = (-1.0, 3.5, -0.9, 0.9)  # [m] of the vehicle, behind, ahead, right and left of its origin
SPEED = 2.0  # [m/s] along the path


def mapped(mapper: Mapper) -> Mapper:
    """Return a mapper that has fused the drive."""
    for _ in fuse(frames(), RayISM(GridSpec.centered(40.0, 40.0, 0.2), MOUNT), mapper):
        pass
    return mapper


def main() -> tuple[Collision, Collision]:
    """Ask a static and a dynamic map along a path straight ahead, to a place behind the wall."""
    window = rolling_window(GridSpec.centered(40.0, 40.0, 0.2))
    mapper, x = mapped(EvidentialMapper(window)), np.arange(8.0, 20.0, 0.5)  # the lidar sees no ground nearer
    path = np.column_stack([x, 0 * x, 0 * x])  # x, y [m], yaw [rad]

    # Opinions at points, also where the map ends
    for point, (free, occupied, unknown) in zip(path[::8, :2], mapper.opinion_at(path[::8, :2]), strict=True):
        print(f"{point} free {free:.2f}, occupied {occupied:.2f}, unknown {unknown:.2f}")
    print("far away:", mapper.opinion_at((500.0, 0.0)))

    # The vehicle's footprint at each pose
    found = collision(mapper.grid, FOOTPRINT, path)
    print(f"no doubt before x = {path[found.first_doubtful, 0]} m: plausibility {found.plausibility.round(2)}")
    print("free lines of sight to 13 m and 16 m:", ray_is_free(mapper.grid, (8.0, 0.0), [(13.0, 0.0), (16.0, 0.0)]))

    # The same with the map as it is predicted for each pose
    dynamic = mapped(DynamicMapper(window, particles=50_000))
    seconds = np.round((x - x[0]) / SPEED, 1)
    return found, collision(dynamic.predicted, FOOTPRINT, path, seconds)


if __name__ == "__main__":
    main()

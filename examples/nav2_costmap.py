"""Costs of a map for nav2: as nav2_msgs/Costmap in a log, and as a map of map_server.

ogm fuse drive.mcap --out map.npz
python examples/nav2_costmap.py map.npz
"""

import sys
from dataclasses import replace
from pathlib import Path

from ogm import LayeredGrid
from ogm.io import occupancy_from_costs, read_placed_grid, write_grid
from ogm.planning import costmap


def main(path: str) -> LayeredGrid:
    """Write the costs beside the map, as NAME_costs.mcap and NAME_costs.yaml."""
    placed = read_placed_grid(path)
    costs = costmap(placed.evidential, inscribed_radius=0.3, inflation_radius=1.0, cost_scaling=3.0)
    layers = LayeredGrid(placed.grid.spec, {"cost": costs})
    name = Path(path).with_suffix("")
    write_grid(f"{name}_costs.mcap", replace(placed, grid=layers), message="costmap")  # exact, on /costmap_raw
    write_grid(f"{name}_costs.yaml", replace(placed, grid=occupancy_from_costs(layers)), mode="scale")  # 0 to 100
    return layers


if __name__ == "__main__":
    print(main(sys.argv[1]))

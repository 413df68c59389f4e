"""Maps of a whole city: tiles on disk or in an object store, merged from many drives (needs the extra ``world``).

>>> from ogm.world import WorldMap
>>> with WorldMap.create("town", resolution=0.16) as world:                        # doctest: +SKIP
...     world.integrate(grid, T_map_sensor, stamp=12.3)
"""

from ogm.world.build import Progress, build_world, rebuild_world
from ogm.world.layout import WorldLayout
from ogm.world.pyramid import world_to_xarray, write_pyramid
from ogm.world.world_map import WorldMap

__all__ = ["WorldLayout", "Progress", "WorldMap", "build_world", "rebuild_world", "world_to_xarray", "write_pyramid"]

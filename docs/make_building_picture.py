"""Make the picture of the map of a made hall in docs/fusion.md: ``python docs/make_building_picture.py``."""

import math
import sys
from pathlib import Path

import numpy as np

from ogm import EvidentialGrid, GridSpec, Mount, Scan, plot
from ogm.fusion import make_mapper
from ogm.geometric import PlanarISM

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "examples"))
from hall import cast, drive  # noqa: E402

PICTURE = ROOT / "docs" / "pictures" / "building.png"
WINDOW = GridSpec(0.05, (260, 210), (-0.5, -0.5))

rng, poses = np.random.default_rng(0), drive(120)
ism = PlanarISM(GridSpec.centered(26.0, 26.0, WINDOW.resolution), Mount(0.3, ego_footprint=(0, 0, 0, 0)))
maps: list[EvidentialGrid] = []
mapper = make_mapper("smooth", WINDOW, math.inf, "fixed")
for T in poses:
    mapper.update(ism(Scan(cast(T, rng), kind="planar")), T)
    if not maps:
        maps.append(mapper.grid)
maps.append(mapper.grid)
plot.save_picture(PICTURE, *maps, titles=["map after 1 scan", f"after {len(poses)}"])

"""Truth by the paper's HD lidar and by rays aimed at cells, both against a far denser lidar.

    python benchmarks/truth_modes.py [--frames N] [--quick]

In a simulated town both modes of `ogm.simulation.survey` observe the same moments. What they miss is counted in
narrow sectors against a lidar of 12000 layers every 0.02 degrees. Writes benchmarks/results/truth_modes.json and
docs/pictures/truth_modes.png.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _charts import caption, save_picture
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.plot.colours import colours
from ogm.pose import pose
from ogm.simulation.cells import Below, measure_ground
from ogm.simulation.dataset import SceneSetup, World, truth_of
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.scene import Scene
from ogm.simulation.sensors import LIDARS, hd_directions
from ogm.simulation.survey import aimed_truth, hd_truth
from ogm.simulation.town import build_town
from ogm.simulation.traffic.bodies import ego_vehicle
from ogm.simulation.traffic.motion import Traffic
from ogm.state import CellState, Truth
from ogm.truth import TRUTH_SPEC

PAPER = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
SENSOR = LIDARS["vlp-32c"]
VIEW = (min(SENSOR.elevations), max(SENSOR.elevations))
TOWN, TRAFFIC = 1, 3  # seeds
LAYERS, STEP, SECTOR = 12000, 0.02, 5.0  # of the reference: layers, [deg], [deg]
SECTORS = (25.0, 115.0, 205.0, 295.0)  # [deg] of the reference; they turn by 10 degrees per frame
MODES = ("hd", "aimed")
PUBLISHED = {"free": "25 to 36 %", "occupied": "0.9 to 2.5 %", "unknown": "63 to 74 %"}
COLOURS = ListedColormap(("black", colours().free, colours().occupied, "#707070", "white"))
NOTE = (
    "Shares count cells of the reference's sectors by what the reference, which sees more than either mode, finds "
    "in them. A cell that an obstacle only touches counts as occupied there, so that no mode reaches 100 %. "
    "Traffic participants are not filled for this comparison; the pictures show truth with filled ones."
)


class Moment(NamedTuple):
    """One moment in the town, with its moving things in place: the ground below, and the sensor's returns by object."""

    here: SceneSetup
    below: Below
    returns: NDArray[np.int64]

    @property
    def seen_from(self) -> tuple[Scene, Below]:
        """Scene and cells, with the pose that truth is observed from."""
        return self.here.world.scene, self.below


def place_traffic(world: World, traffic: Traffic, time: float) -> Moment:
    """Put the traffic of a moment in place, and scan it once to count returns."""
    state, T_vehicle_sensor = traffic.at(time), pose(0, 0, 1.9)
    T = state.ego @ T_vehicle_sensor
    world.scene.place([thing.mesh.moved(thing.pose) for thing in state.objects], ego_vehicle().moved(state.ego))
    things = world.scene.cast(T, SENSOR.directions().reshape(-1, 3)).object
    returns = np.bincount(things[things >= 0], minlength=len(state.objects))
    here = SceneSetup(world, state, tuple(state.objects), SENSOR, T_vehicle_sensor, T)
    return Moment(here, measure_ground(world.ground, T), returns)


def observed(mode: str, moment: Moment) -> Truth:
    """Return the truth that the rays of a mode find."""
    if mode == "hd":
        return hd_truth(*moment.seen_from, hd_directions(SENSOR))
    return aimed_truth(*moment.seen_from, VIEW)


def whole(mode: str, moment: Moment) -> Truth:
    """Return the truth as it is stored: with filled participants, without the ego vehicle."""
    return truth_of(DatasetPlan(truth=mode), moment.here, moment.returns)


def reference(moment: Moment, first: float, layers: int) -> tuple[Truth, NDArray[np.bool_]]:
    """Return the truth of a far denser lidar in one sector, and a mask of the cells that lie wholly in it."""
    up = np.linspace(*VIEW, layers)[:, None]
    around = np.deg2rad(np.arange(first, first + SECTOR, STEP))
    parts = np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up) + 0 * around
    directions = np.stack(parts, axis=-1).astype(np.float32)
    x, y = TRUTH_SPEC.cell_centers
    margin = np.rad2deg(0.12 / np.maximum(np.hypot(x, y), 1e-6))  # half a cell's diagonal
    angle = np.mod(np.rad2deg(np.arctan2(y, x)) - first, 360.0)
    inside = (angle > margin) & (angle < SECTOR - margin)
    return hd_truth(*moment.seen_from, directions), inside


def table(counts: NDArray[np.int64]) -> dict[str, float]:
    """Turn counts [state of the reference, state of the mode] into shares."""
    total = counts.sum(axis=1)
    share = np.round(counts / np.maximum(total, 1)[:, None], 4).tolist()
    unknown, free, occupied = CellState.UNKNOWN, CellState.FREE, CellState.OCCUPIED
    known = counts[unknown, free] + counts[unknown, occupied]
    return {
        "free found": share[free][free],
        "free called unknown": share[free][unknown],
        "free called occupied": share[free][occupied],
        "occupied found": share[occupied][occupied],
        "occupied called unknown": share[occupied][unknown],
        "occupied called free": share[occupied][free],
        "unknown called known": round(float(known) / max(int(total[unknown]), 1), 4),
        "cells free in the reference": int(total[free]),
        "cells occupied in the reference": int(total[occupied]),
    }


def compare(times: list[float], place: Callable[[int], Moment], layers: int, sectors: int) -> dict[str, Any]:
    """Count what both modes make of the reference's cells, and how far they agree with each other."""
    counts = {mode: np.zeros((4, 4), np.int64) for mode in MODES}
    pairs = np.zeros((4, 4), np.int64)
    shares: dict[str, list] = {mode: [] for mode in MODES}
    for k in range(len(times)):
        moment = place(k)
        bare = {mode: observed(mode, moment).state for mode in MODES}
        for first in SECTORS[:sectors]:
            dense, inside = reference(moment, first + 10 * k, layers)
            for mode in MODES:
                np.add.at(counts[mode], (dense.state[inside], bare[mode][inside]), 1)
        truths = {mode: whole(mode, moment) for mode in MODES}
        np.add.at(pairs, tuple(one.state for one in truths.values()), 1)
        for mode, one in truths.items():
            shares[mode].append(one.crop(PAPER).shares())
    both = pairs[np.ix_((CellState.FREE, CellState.OCCUPIED), (CellState.FREE, CellState.OCCUPIED))]
    return {
        "against the reference": {mode: table(counts[mode]) for mode in MODES},
        "hd and aimed agree where both know": round(float(np.trace(both) / both.sum()), 4),
        "known to aimed only [share of cells]": round(float(pairs[CellState.UNKNOWN, 1:3].sum() / pairs.sum()), 4),
        "known to hd only [share of cells]": round(float(pairs[1:3, CellState.UNKNOWN].sum() / pairs.sum()), 4),
        "shares on the 512 x 352 grid": {
            mode: {
                name: [round(getattr(one, name) + (one.ignore if name == "unknown" else 0), 4) for one in shares[mode]]
                for name in ("free", "occupied", "unknown")
            }
            for mode in MODES
        },
    }


def picture(truths: list[dict[str, Truth]], record: Mapping[str, Any], path: Path) -> None:
    """Draw both truths side by side, and where they differ."""
    figure = Figure(figsize=(13, 6.2 * len(truths)), layout="constrained")
    axes = figure.subplots(len(truths), 3, squeeze=False)
    x0, x1, y0, y1 = PAPER.extent
    for row, pair in zip(axes, truths, strict=True):
        states = [pair[mode].crop(PAPER).state for mode in MODES]
        differ = np.where(states[0] == states[1], CellState.IGNORE + 1, states[1])
        titles = ("3000 layers (the paper's way)", "aimed at cells", "aimed where they differ")
        for axis, state, title in zip(row, (*states, differ), titles, strict=True):
            style = {"cmap": COLOURS, "vmin": 0, "vmax": 4, "interpolation": "nearest"}
            axis.imshow(state[::-1, ::-1], extent=(y1, y0, x0, x1), **style)
            axis.set(title=title, xlabel="y, left [m]")
        row[0].set_ylabel("x, forward [m]")
    save_picture(figure, path, caption(record), dpi=90)


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("--frames", type=int, default=6, help="moments in the town (default 6)")
    options = parser.parse_args()
    frames = 1 if options.quick else options.frames
    record = run.environment()
    town = build_town(TOWN)
    world = World(town, Scene(town.mesh, threads=1), Scene(town.ground, threads=1))
    traffic, times = Traffic(town, TRAFFIC, clockwise=True), [30.0 + 25.0 * k for k in range(frames)]

    def place(k: int) -> Moment:
        return place_traffic(world, traffic, times[k])

    layers, sectors = (4000, 1) if options.quick else (LAYERS, len(SECTORS))
    record |= {"town": TOWN, "traffic": TRAFFIC, "moments [s]": times, "published": {"ranges": PUBLISHED}, "note": NOTE}
    record["reference"] = {"layers": layers, "azimuth step [deg]": STEP, "sectors": sectors}
    record |= compare(times, place, layers, sectors)
    run.write_record(options.out, record)
    shown = [{mode: whole(mode, m) for mode in MODES} for m in map(place, range(min(frames, 2)))]
    picture(shown, record, options.picture)


if __name__ == "__main__":
    main()

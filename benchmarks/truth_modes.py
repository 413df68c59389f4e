"""Truth by the paper's HD lidar and by rays aimed at cells, both against a far denser lidar.

    python benchmarks/truth_modes.py [--frames N] [--quick]

In a simulated town both modes of `ogm.simulation.survey` observe the same moments. What they miss is counted in
narrow sectors against a lidar of 12000 layers every 0.02 degrees. Writes benchmarks/results/truth_modes.json and
docs/pictures/truth_modes.png.
"""

from _run import PICTURES, RESULTS, caption, environment, write_json

# isort: split
import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.pose import inverse, pose
from ogm.simulation.cells import Below, measure_ground
from ogm.simulation.scene import Scene
from ogm.simulation.sensors import LIDARS, hd_directions
from ogm.simulation.survey import Known, aimed_truth, hd_truth
from ogm.simulation.town import Town, build_town
from ogm.simulation.traffic import Traffic, ego_vehicle
from ogm.state import CellState, Truth
from ogm.truth import TRUTH_SPEC, boxes_seen_from, cells_in_boxes

PAPER = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
SENSOR = LIDARS["vlp-32c"]
VIEW = (min(SENSOR.elevations), max(SENSOR.elevations))
TOWN, TRAFFIC = 1, 3  # seeds
LAYERS, STEP, SECTOR = 12000, 0.02, 5.0  # of the reference: layers, [deg], [deg]
SECTORS = (25.0, 115.0, 205.0, 295.0)  # [deg] of the reference; they turn by 10 degrees per frame
MODES = ("hd", "aimed")
PUBLISHED = {"free": "25 to 36 %", "occupied": "0.9 to 2.5 %", "unknown": "63 to 74 %"}
COLOURS = ("black", "#3a9a4a", "#e03030", "#707070")
NOTE = (
    "Shares count cells of the reference's sectors by what the reference, which sees more than either mode, finds "
    "in them. A cell that an obstacle only touches counts as occupied there, so that no mode reaches 100 %. "
    "Traffic participants are not filled for this comparison; the pictures show truth with filled ones."
)


class Moment(NamedTuple):
    """One moment in the town, with its moving things in place, and where the sensor is."""

    scene: Scene
    below: Below
    known: Known  # boxes, their returns and the ego vehicle, for truth as it is stored


def place_traffic(town: Town, scene: Scene, ground: Scene, traffic: Traffic, time: float) -> Moment:
    """Put the traffic of a moment in place, and scan it once to count returns."""
    frame = traffic.at(time)
    T = frame.ego @ pose(0, 0, 1.9)
    ego = ego_vehicle()
    scene.place([thing.mesh.moved(thing.pose) for thing in frame.objects], ego.moved(frame.ego))
    hit = scene.cast(T, SENSOR.directions().reshape(-1, 3)).object
    returns = np.bincount(hit[hit >= 0], minlength=len(frame.objects))
    low, high = ego.vertices.min(axis=0), ego.vertices.max(axis=0)
    middle = frame.ego @ pose((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    things = frame.objects
    boxes = boxes_seen_from(inverse(T), [one.pose for one in things], [one.size for one in things])
    ego_cells = cells_in_boxes(boxes_seen_from(inverse(T), [middle], [high - low]), TRUTH_SPEC)
    return Moment(scene, measure_ground(ground, T), Known(boxes, returns, ego_cells))


def truth(mode: str, moment: Moment, known: Known) -> Truth:
    scene, below, _ = moment
    if mode == "hd":
        return hd_truth(scene, below, hd_directions(SENSOR), known)
    return aimed_truth(scene, below, VIEW, known)


def reference(moment: Moment, first: float, layers: int) -> tuple[Truth, NDArray[np.bool_]]:
    """Return what a far denser lidar sees in one sector, and which cells lie wholly in it."""
    up = np.linspace(*VIEW, layers)[:, None]
    around = np.deg2rad(np.arange(first, first + SECTOR, STEP))
    parts = np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up) + 0 * around
    directions = np.stack(parts, axis=-1).astype(np.float32)
    x, y = TRUTH_SPEC.cell_centers
    margin = np.rad2deg(0.12 / np.maximum(np.hypot(x, y), 1e-6))  # half a cell's diagonal
    angle = np.mod(np.rad2deg(np.arctan2(y, x)) - first, 360.0)
    inside = (angle > margin) & (angle < SECTOR - margin)
    return hd_truth(moment.scene, moment.below, directions), inside


def table(counts: NDArray[np.int64]) -> dict[str, float]:
    """Turn counts [state of the reference, state of the mode] into shares."""
    free, occupied, unknown = counts[CellState.FREE], counts[CellState.OCCUPIED], counts[CellState.UNKNOWN]

    def share(part: int, whole: NDArray[np.int64]) -> float:
        return round(float(part) / max(int(whole.sum()), 1), 4)

    return {
        "free found": share(free[CellState.FREE], free),
        "free called unknown": share(free[CellState.UNKNOWN], free),
        "free called occupied": share(free[CellState.OCCUPIED], free),
        "occupied found": share(occupied[CellState.OCCUPIED], occupied),
        "occupied called unknown": share(occupied[CellState.UNKNOWN], occupied),
        "occupied called free": share(occupied[CellState.FREE], occupied),
        "unknown called known": share(unknown[CellState.FREE] + unknown[CellState.OCCUPIED], unknown),
        "cells free in the reference": int(free.sum()),
        "cells occupied in the reference": int(occupied.sum()),
    }


def compare(times: list[float], place: Callable[[int], Moment], layers: int, sectors: int) -> dict[str, Any]:
    """Count what both modes make of the reference's cells, and how far they agree with each other."""
    counts = {mode: np.zeros((4, 4), np.int64) for mode in MODES}
    pairs = np.zeros((4, 4), np.int64)
    shares: dict[str, list] = {mode: [] for mode in MODES}
    for k in range(len(times)):
        moment = place(k)
        bare = {mode: truth(mode, moment, Known()).state for mode in MODES}
        for first in SECTORS[:sectors]:
            dense, inside = reference(moment, first + 10 * k, layers)
            for mode in MODES:
                np.add.at(counts[mode], (dense.state[inside], bare[mode][inside]), 1)
        whole = {mode: truth(mode, moment, moment.known) for mode in MODES}
        np.add.at(pairs, tuple(whole[mode].state for mode in MODES), 1)
        for mode in MODES:
            shares[mode].append(whole[mode].crop(PAPER).shares())
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
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import ListedColormap

    figure, axes = plt.subplots(len(truths), 3, figsize=(13, 6.2 * len(truths)), squeeze=False)
    x0, x1, y0, y1 = PAPER.extent
    for row, pair in zip(axes, truths, strict=True):
        states = [pair[mode].crop(PAPER).state for mode in MODES]
        differ = np.where(states[0] == states[1], CellState.IGNORE + 1, states[1])
        titles = ("3000 layers (the paper's way)", "aimed at cells", "aimed where they differ")
        for axis, state, title in zip(row, (*states, differ), titles, strict=True):
            colours = ListedColormap([*COLOURS, "white"])
            extent = (y1, y0, x0, x1)
            axis.imshow(state[::-1, ::-1], cmap=colours, vmin=0, vmax=4, interpolation="nearest", extent=extent)
            axis.set_title(title, fontsize=10)
            axis.set_xlabel("y, left [m]")
        row[0].set_ylabel("x, forward [m]")
    figure.text(0.01, 0.005, caption(record), fontsize=6, color="#555555")
    figure.tight_layout(rect=(0, 0.015, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=6, help="moments in the town (default 6)")
    parser.add_argument("--quick", action="store_true", help="one moment, a coarse reference")
    parser.add_argument("--out", type=Path, default=RESULTS / "truth_modes.json", help="where the figures go")
    parser.add_argument("--picture", type=Path, default=PICTURES / "truth_modes.png")
    options = parser.parse_args()
    frames = 1 if options.quick else options.frames
    if frames < 1:
        parser.error("--frames must be at least 1")

    record = environment()
    town = build_town(TOWN)
    scene, ground = Scene(town.mesh, threads=1), Scene(town.ground, threads=1)
    traffic = Traffic(town, TRAFFIC, clockwise=True)
    times = [30.0 + 25.0 * k for k in range(frames)]

    def place(k: int) -> Moment:
        return place_traffic(town, scene, ground, traffic, times[k])

    layers, sectors = (4000, 1) if options.quick else (LAYERS, len(SECTORS))
    record["town"], record["traffic"], record["moments [s]"] = TOWN, TRAFFIC, times
    record["reference"] = {"layers": layers, "azimuth step [deg]": STEP, "sectors": sectors}
    record["published"] = {"ranges": PUBLISHED}
    record.update(compare(times, place, layers, sectors))
    record["note"] = NOTE
    for mode in MODES:
        print(f"{mode}: {record['against the reference'][mode]}")
    write_json(options.out, record)
    shown = [{mode: truth(mode, m, m.known) for mode in MODES} for m in map(place, range(min(frames, 2)))]
    picture(shown, record, options.picture)
    print(f"\nwrote {options.out} and {options.picture}")


if __name__ == "__main__":
    main()

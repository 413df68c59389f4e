"""How good is a map of one radar sweep, by RadarISM and by others? In simulated towns.

    python benchmarks/radar.py [--frames N] [--fit] [--quick]

Sweeps of three radars (`ogm.simulation.radars.RADARS`) at the front bumper, in the towns and at the moments of `ogm
simulate --seed 3 --test 240 --drives 24 --test-towns 6 --spacing 10`, against the truth of the lidar's samples, within
the radar's field of view. `--fit` first fits RadarISM's masses to sweeps in the five training towns of seed 1, by log
loss with at most 4 % false free, and prints them; the defaults of `RadarISM` are such a fit, rounded. Also counts
detections, and compares the sweep of an ARS548 with the one recorded frame that may be shared. Without `--fit`, the
fits of the record stay. Werber's model marks only, and the rays are of a lidar. Writes benchmarks/results/radar.json
and docs/pictures/radar.png.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from _timing import Contender, measure
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import minimize

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.evaluation import compare_paired
from ogm.fusion import resample_to
from ogm.geometric import RadarISM, RayISM, flat_ground
from ogm.io.messages import scan_from_continental
from ogm.metrics import ConfusionSums, accumulate, score
from ogm.models import load_model
from ogm.models.radar import radar_numbers
from ogm.plot import mass_panel, show
from ogm.plot.panels import dots_panel
from ogm.pose import inverse, pose
from ogm.simulation.dataset import SceneSetup, make_sample, set_up
from ogm.simulation.exchange import truth_panel
from ogm.simulation.mounts import RADAR_POSITIONS
from ogm.simulation.plan import DatasetPlan, moment
from ogm.simulation.radar import Origin, RadarSweep, sweep
from ogm.simulation.radars import RADARS, RadarSpec
from ogm.simulation.traffic.bodies import ego_body
from ogm.state import CellState, Truth
from ogm.storage.files import atomic_write
from ogm.truth import TRUTH_SPEC

SPEC: GridSpec = TRUTH_SPEC
AHEAD = GridSpec(0.16, (312, 350), (0.0, -28.0))  # of the picture
AT = pose(*RADAR_POSITIONS["front"][:3])  # of the radar on the vehicle
TRAINING = DatasetPlan(seed=1, towns=5)
TEST = DatasetPlan(seed=3, samples=0, validation=0, test=240, drives=24, test_towns=6, spacing=10.0)
FITTED = ("free_mass", "hit_mass", "extent", "behind", "reach", "margin", "beam")
HIGH = {"free_mass": 0.98, "hit_mass": 0.98, "extent": 20.0, "behind": 1.0, "reach": 300.0, "margin": 15.0, "beam": 0.1}
PICTURED = ("RadarISM", "rays (RayISM)")
MOST_FREE = 0.04  # false free that a fit may have
METRICS = ("nll", "brier", "iou_free", "iou_occupied", "false_free", "missed_occupied", "ece", "auroc_unknown")
PARTS = ("object", "ground", "ghost", "clutter")
COLOURS = ((1.0, 1.0, 1.0), (0.45, 0.45, 0.45), (1.0, 0.65, 0.12), (0.3, 0.6, 1.0))


class Frame(NamedTuple):
    """A moment: the sweep of each radar, the truth where the radars look, the mount, and the drive."""

    sweeps: dict[str, RadarSweep]
    truth: dict[str, NDArray[np.uint8]]
    mount: Mount
    drive: int
    seconds: dict[str, float]

    def scan(self, name: str) -> Scan:
        """Return the sweep of a radar as a scan."""
        return replace(self.sweeps[name].scan(sensor=name), mount=self.mount)


Model = Callable[[str, Frame], EvidentialGrid]


def ego_footprint(here: SceneSetup) -> tuple[float, ...]:
    """Return the edges of the ego vehicle around the lidar (x_min, x_max, y_min, y_max) [m]."""
    body = ego_body().mesh.vertices
    edges = ((axis, edge) for axis in (0, 1) for edge in (body[:, axis].min(), body[:, axis].max()))
    return tuple(float(edge - here.T_vehicle_sensor[axis, 3]) for axis, edge in edges)


def velocities_of(here: SceneSetup) -> NDArray[np.float64]:
    """Return the velocities of the traffic participants, (N, 3)."""
    return np.array([participant.velocity for participant in here.objects]).reshape(-1, 3)


def frames(plan: DatasetPlan, split: str, numbers: Sequence[int]) -> Iterator[Frame]:
    """Simulate moments, the moments of one town after each other."""
    for k in sorted(numbers, key=lambda k: (moment(plan, split, k).town, k)):
        sample, here = make_sample(plan, split, k, 1), set_up(plan, split, k, 1)
        T_world_radar = here.state.ego @ AT
        T_grid_radar = inverse(here.T_world_sensor) @ T_world_radar
        mount = Mount(AT[2, 3], T_grid_radar, ego_footprint=ego_footprint(here))
        x, y = np.broadcast_arrays(*SPEC.cell_centers)
        off = np.abs(np.arctan2(y - mount.origin[1], x - mount.origin[0]))
        sweeps, truth, seconds = {}, {}, {}
        for n, (name, spec) in enumerate(RADARS.items()):
            rng, start = np.random.default_rng([plan.seed, k, n]), time.process_time()
            options: Any = {"velocity": here.state.ego_velocity, "velocities": velocities_of(here)}
            sweeps[name] = sweep(here.world.scene, spec, T_world_radar, rng, **options)
            seconds[name] = time.process_time() - start
            seen = off <= max(mode.half_width for mode in spec.modes)
            truth[name] = np.where(seen, sample.truth.state, np.uint8(CellState.IGNORE))
        yield Frame(sweeps, truth, mount, moment(plan, split, k).scenario, seconds)


def werber(scan: Scan, snr: NDArray[np.float32]) -> EvidentialGrid:
    """Map by Werber et al. 2015, as published code has it: plausibilities from 1/2 to 1, and no free space."""
    distance = np.hypot(scan.points[:, 0], scan.points[:, 1]).astype(np.float64)
    strength = np.sqrt(10 ** (snr / 10) / np.maximum(distance, 1) ** 4)
    likely = np.clip(np.exp(-0.02 * distance**2) + 1 / (1 + np.exp(-0.05 * strength)), 0.5, 1)
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    T, none = scan.mount.T_vehicle_points, np.ones(SPEC.shape)
    places = scan.points[:, :3] @ T[:3, :3].T + T[:3, 3]
    for (px, py, _), belief, r in zip(places, 2 * likely - 1, distance, strict=True):
        width = max(0.01 * r, 0.2)
        near = np.hypot(x - px, y - py) < 3 * width
        none[near] *= 1 - belief * np.exp(-((x[near] - px) ** 2 + (y[near] - py) ** 2) / (2 * width**2))
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[..., 1] = np.minimum(1 - none, 0.98)
    return EvidentialGrid(SPEC, mass)


def as_lidar(scan: Scan) -> EvidentialGrid:
    """Map the detections as if each were a return of a lidar at the height of the sensor, over flat ground."""
    points = scan.points.copy()
    points[:, 2] = 0
    return RayISM(SPEC, scan.mount, ground=flat_ground)(points)


def all_models() -> dict[str, Model]:
    """Return the models by name; each maps the sweep of a radar in a frame."""
    by_numbers = load_model("radar", SPEC)
    return {
        "RadarISM": lambda name, one: by_numbers(one.scan(name)),
        "RadarISM, static": lambda name, one: RadarISM(SPEC, **radar_numbers(name))(one.scan(name)),
        "rays (RayISM)": lambda name, one: as_lidar(one.scan(name)),
        "Werber 2015": lambda name, one: werber(one.scan(name), one.sweeps[name].snr),
    }


def timed() -> dict[str, float]:
    """Return the median time of one sweep on the grid of 512 x 352 cells [ms], of 300 detections."""
    rng, points = np.random.default_rng(0), np.zeros((300, 4), np.float32)
    r, azimuth = rng.uniform(3, 60, 300), rng.uniform(-1, 1, 300)
    points[:, 0], points[:, 1] = r * np.cos(azimuth), r * np.sin(azimuth)
    scan = Scan(points, doppler=-8 * np.cos(azimuth), rcs=rng.uniform(-20, 20, 300))
    mount, spec = Mount(0.6, AT), GridSpec.centered()
    model = RadarISM(spec, mount)
    times = measure({"RadarISM": Contender(lambda _: model(scan))}, 20)
    return {title: one.median for title, one in times.items()}


def pooled(counts: Iterable[ConfusionSums]) -> dict[str, float]:
    """Return the scores of all cells of several frames together."""
    total = ConfusionSums.zeros()
    for one in counts:
        total = total.plus(one)
    found = score(total)
    return {name: float(found[name]) if math.isfinite(found[name]) else 0.0 for name in METRICS}


def fit(found: Sequence[Frame], name: str) -> dict[str, float]:
    """Fit the masses of RadarISM to frames, by log loss with few false free."""

    def numbers(x: NDArray[np.float64]) -> dict[str, float]:
        shares = 1 / (1 + np.exp(-x))
        return {key: float(HIGH[key] * share) for key, share in zip(FITTED, shares, strict=True)}

    def cost(x: NDArray[np.float64]) -> float:
        options: Any = numbers(x) | {"keep_moving": True}
        model = RadarISM(SPEC, **radar_numbers(name) | options)
        grids = (model(one.scan(name)) for one in found)
        scores = pooled(accumulate(grid.mass, one.truth[name]) for grid, one in zip(grids, found, strict=True))
        excess = max(scores["false_free"] - MOST_FREE, 0)
        return scores["nll"] + 10 * excess**2 + excess

    first = RadarISM(SPEC, found[0].mount)
    shares = np.array([getattr(first, key) / HIGH[key] for key in FITTED])
    start = np.log(shares / (1 - shares))
    best = minimize(cost, start, method="Nelder-Mead", options={"maxfev": 250, "xatol": 0.02, "fatol": 1e-4})
    return numbers(best.x) | {"cost": float(best.fun)}


def paired(counts: dict[str, list[ConfusionSums]], drives: Sequence[int], metric: str) -> dict[str, list[float]]:
    """Return the difference of RadarISM's score from the others', mean over drives with its 95 % interval."""
    each = {
        model: [
            pooled(one for one, k in zip(sums, drives, strict=True) if k == drive)[metric]
            for drive in sorted(set(drives))
        ]
        for model, sums in counts.items()
    }
    mine = each.pop("RadarISM")
    return {other: list(compare_paired(mine, theirs, "lower").difference) for other, theirs in each.items()}


def detections(found: Sequence[Frame], spec: RadarSpec) -> dict[str, Any]:
    """Count the detections of a radar, what they are of, and how far static ones seem to move."""
    sweeps = [one.sweeps[spec.name] for one in found]
    origin, thing, compensated = (
        np.concatenate([getattr(one, key) for one in sweeps]) for key in ("origin", "object", "compensated")
    )
    counts = np.array([len(one.xyz) for one in sweeps])
    static = compensated[(origin == Origin.OBJECT) & (thing < 0)]
    return {
        "per sweep, least, median, most": [int(counts.min()), float(np.median(counts)), int(counts.max())],
        "share of each": dict(zip(PARTS, (np.bincount(origin, minlength=4) / len(origin)).tolist(), strict=True)),
        "compensated Doppler of static things, 5, 50, 95 %": np.percentile(static, [5, 50, 95]).tolist(),
        "seconds per sweep": float(np.median([one.seconds[spec.name] for one in found])),
    }


def recorded() -> Scan | None:
    """Return the recorded frame of an ARS548."""
    paths = sorted((run.DATA / "nebula_apache2" / "ars548").glob("*_detection.yaml"))
    return scan_from_continental(yaml.safe_load(paths[0].read_text())) if paths else None


def histograms(scans: Sequence[Scan]) -> dict[str, list[float]]:
    """Return the number of detections of a scan by range and by azimuth."""
    points = np.concatenate([one.points for one in scans])
    distance, azimuth = np.hypot(*points[:, :2].T), np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    by_range = np.histogram(distance, [0, 20, 40, 60, 100, 150, 300])[0] / len(scans)
    by_azimuth = np.histogram(np.abs(azimuth), [0, 10, 20, 40, 60])[0] / len(scans)
    return {
        "range 0, 20, 40, 60, 100, 150, 300 m": by_range.tolist(),
        "azimuth 0, 10, 20, 40, 60 degrees": by_azimuth.tolist(),
    }


def draw(path: Path, models: dict[str, Model], found: Sequence[Frame], real: Scan | None) -> None:
    """Draw one frame by some models, and the recorded one."""
    one = max(found, key=lambda frame: len(frame.sweeps["ars548"].xyz))
    panels = [truth_panel(Truth(SPEC, one.truth["ars548"]).crop(AHEAD), "truth, in the field of view")]
    panels += [mass_panel(resample_to(models[name]("ars548", one), AHEAD, "nearest"), name) for name in PICTURED]
    caught, colours = one.sweeps["ars548"], dict(zip(PARTS, COLOURS, strict=True))
    T = one.mount.T_vehicle_points
    places = caught.xyz @ T[:3, :3].T + T[:3, 3]
    panels.append(dots_panel(places, np.array(COLOURS)[caught.origin], AHEAD, "detections", colours, 7))
    if real is not None:
        mount = Mount(0.641, pose(0.0, 0.0, 0.641), ego_footprint=(-5.0, 0.1, -1.0, 1.0))
        noise: Any = {"range_noise": 0.2, "azimuth_noise": math.radians(0.5), "doppler_noise": 0.25}
        panels.append(
            mass_panel(resample_to(RadarISM(SPEC, mount, **noise)(real), AHEAD, "nearest"), "RadarISM, recorded frame")
        )
    rows = [show(*panels[:3]), show(*panels[3:])]
    picture = Image.new("RGB", (max(row.width for row in rows), sum(row.height for row in rows)), "white")
    picture.paste(rows[0], (0, 0))
    picture.paste(rows[1], (0, rows[0].height))
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as file:
        picture.save(file, "PNG", optimize=True)


def main() -> None:
    """Simulate, map, score, and write the record."""
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--fit", action="store_true")
    given = parser.parse_args()
    count = 4 if given.quick else given.frames
    record: dict[str, Any] = {"environment": run.environment("radar", "ray"), "fit": {}, "radars": {}}
    if given.out.exists():
        record["fit"] = json.loads(given.out.read_text())["fit"]
    if given.fit:
        training = list(frames(TRAINING, "training", range(0, 5 * count, 5)))
        for name in RADARS:
            record["fit"][name] = fit(training, name)
    models, test = all_models(), list(frames(TEST, "test", range(0, 5 * count, 5)))
    drives = [one.drive for one in test]
    for name, spec in RADARS.items():
        counts = {
            title: [accumulate(model(name, one).mass, one.truth[name]) for one in test]
            for title, model in models.items()
        }
        record["radars"][name] = {
            "detections": detections(test, spec),
            "scores": {title: pooled(some) for title, some in counts.items()},
            "RadarISM minus another, mean over drives, 95 %": {
                metric: paired(counts, drives, metric) for metric in ("nll", "brier", "iou_free", "false_free")
            },
        }
    record["ms per sweep, 512 x 352 cells"] = timed()
    record |= {"frames": len(test), "drives": len(set(drives))}
    real = recorded()
    if real is not None:
        record["ARS548, recorded"] = {"detections": len(real)} | histograms([real])
        record["ARS548, simulated"] = histograms([one.sweeps["ars548"].scan() for one in test])
    run.write_record(given.out, record)
    draw(given.picture, models, test, real)


if __name__ == "__main__":
    main()

"""``ogm demo`` and ``ogm map``: map scans to evidential grids."""

import logging
import statistics
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import chosen_model, complain, distinct, first_call, out, report_errors, stderr, ticked
from ogm.cli.sensor_options import SensorOptions, sensor_options

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.grid import EvidentialGrid, GridSpec
    from ogm.scan import InverseSensorModel

_LISTED = 3  # listed scans that failed for the same reason
DEMO_SCANS = {  # output: file, axes (Velodyne: y forward, x right), height by the ground returns [m], cells shown
    "ogm-demo": ("vls128_road.pcd.xz", ("+y", "-x", "+z"), 1.98, slice(None), slice(None)),
    "ogm-demo-sector": ("at128_sector.pcd.xz", "flu", 0.45, slice(244, 316), slice(132, 204)),
}
DEMO_MODELS = {
    "height-band": "height band (paper's baseline)",
    "ray": "RayISM",
    "lite": "deep (lite)",
    "combined": "combined (RayISM, lite)",
}


@report_errors
def demo(
    out_folder: Annotated[Path, Option("--out", help="Folder for the pictures and ogm-demo.npz.")] = Path("."),
) -> None:
    """Map two shipped scans and draw them: points, two geometric models, the learned model, and the combined model.

    Road around a Velodyne VLS-128: ogm-demo.png, ogm-demo.npz. Yard in the 120 degree view of a Hesai AT128:
    ogm-demo-sector.png.
    """
    from ogm import Mount, plot, read_scan
    from ogm.grid import GridSpec
    from ogm.models.named import COMBINED, LITE, load_model

    logging.getLogger("ogm").setLevel(logging.ERROR)  # no warnings: the yard's sensor stands low and sees no ground
    out_folder.mkdir(parents=True, exist_ok=True)
    spec, table, pictures = GridSpec.centered(), _table(), []
    best, models = chosen_model(None, spec).partition("+")[0], dict(DEMO_MODELS)
    if best != COMBINED:
        del models[LITE], models[COMBINED]
    for output, (file, axes, height, *cells) in DEMO_SCANS.items():
        with as_file(files("ogm") / "data" / file) as path:
            scan, grids = read_scan(path, axes=axes), {}
        for name, title in models.items():
            ism = load_model(name, spec, Mount(height))
            with first_call():
                ism(scan)
            grids[title], seconds = _timed(partial(ism, scan), repeats=9)
            _row(table, name, len(scan), grids[title], seconds)
        shown = [_part(grid, *cells) for grid in grids.values()]
        cloud = plot.points_panel(scan.points, shown[0].spec, f"{len(scan)} points", -height)
        pictures.append(out_folder / f"{output}.png")
        plot.save_picture(pictures[-1], cloud, *shown, titles=["", *grids])
        if len(pictures) == 1:
            grids[DEMO_MODELS[best]].save(out_folder / f"{output}.npz")
    out.print(f"Two scans on {_cells(spec)}")
    out.print(table)
    out.print(f"pictures {pictures[0]}, {pictures[1]}   grid {pictures[0].with_suffix('.npz')}", markup=False)


@report_errors
@sensor_options
def map_(
    scans: Annotated[
        list[Path],
        Argument(
            help="Scan files (.pcd .bin .pcd.bin .ply .las .laz .npy .feather, .xz, .gz), a folder, a dataset, or a "
            "log (.mcap .db3 .bag)."
        ),
    ],
    ism: Annotated[
        str | None,
        Option(
            help="Sensor model: combined, ray, planar, height-band, height-band-released, lite, radar, "
            "a file of `ogm train`, `ogm export` or `ogm calibrate`. [default: combined; ray if the network is not "
            "installed or does not suit the grid; planar for planar lasers and sonars]"
        ),
    ] = None,
    axes: options.Axes = "flu",
    sensors: SensorOptions = SensorOptions(),  # noqa: B008  it is immutable
    intensity_max: options.IntensityMax = None,
    time_unit: options.TimeUnit = None,
    topic: options.Topic = None,
    fixed_frame: options.FixedFrame = None,
    sensor: options.Sensor = None,
    first: options.First = None,
    out_path: Annotated[
        Path | None,
        Option(
            "--out",
            help="Grid file (.npz, .yaml of map_server, .tif, .nc, .zarr, .png of masses as colours), or a folder for "
            ".npz files; folders are created. [default: ./NAME.npz]",
        ),
    ] = None,
    picture: Annotated[Path | None, Option(help="Picture (.png), or a folder. [default: ./NAME.png]")] = None,
    layers: Annotated[
        str | None,
        Option(
            help="Further layers, separated by commas: ground_height, ground_variance, slope, step, roughness, "
            "highest_obstacle, clearance, traversability, distance, cost, cause. Written as NAME_layers with the "
            "ending of the grid, and drawn.",
            metavar="NAME[,NAME]...",
        ),
    ] = None,
    length: options.Length = None,
    width: options.Width = None,
    resolution: options.Resolution = 0.16,
) -> None:
    """Map each scan to an evidential grid, and draw it."""
    from ogm.datasets import open_dataset
    from ogm.grid import GridSpec
    from ogm.models.named import RELEASED, title_of
    from ogm.workflows import map_to_files
    from ogm.workflows.checks import gravest
    from ogm.workflows.findings import without_numbers

    options.check_first(first)
    spec = GridSpec.centered(length, width, resolution)
    reading = {"axes": axes, "intensity_max": intensity_max, "time_unit": time_unit}
    chosen = {"topic": topic or (), "frame": fixed_frame, "sensors": sensor or ()}
    dataset = open_dataset(scans, **reading, **chosen, **sensors._asdict())[:first]  # type: ignore[arg-type]
    ism = chosen_model(ism, spec)
    model = _model(ism, spec, sensors.sensor_height, sensors.sensor_position)
    estimated = sensors.sensor_height is None and ism != RELEASED and dataset.format.startswith(("scans", "log"))
    if out_path is None and picture is None:
        out_path, picture = Path(), Path()
        _check_replaced(dataset, spec)
    beside = tuple(layers.split(",")) if layers is not None else ()
    results = map_to_files(dataset, model, out_path, picture, title=ism, layers=beside, first_call=first_call)
    names = distinct([frame.name.replace("/", "_") for frame in dataset])
    table, heights, failed, done, titles = _table(), set(), Counter[str](), list[str](), dict[str, None]()
    for name, (frame, grid, seconds, error) in ticked(zip(names, results, strict=True), "mapping", len(names)):
        if grid is None:
            kind = without_numbers(error.replace(frame.name, ""))
            failed[kind] += 1
            if failed[kind] <= _LISTED:
                more = "; further scans with the same reason are not listed" if failed[kind] == _LISTED else ""
                complain(f"{frame.name}: {error}{more}")
            continue
        _row(table, name, len(frame.scan), grid, seconds)
        done.append(frame.name.replace("/", "_"))
        titles[title_of(ism, frame.scan, frame.mount)] = None
        if estimated:
            heights.add(f"{frame.mount.sensor_height:.2f} m")
    if ism != RELEASED:
        for finding in gravest(dataset, ism):
            complain(str(finding))
    if heights:
        stderr.print(f"sensor height {', '.join(sorted(heights))}, estimated from the scans (--sensor-height sets it)")
    if table.row_count:
        out.print(f"{_cells(spec)}, {'; '.join(titles)}", markup=False, soft_wrap=True)
        out.print(table)
        out.print(f"written {_written(done, out_path, picture)}", markup=False, soft_wrap=True)
    if failed:
        raise typer.Exit(2)


def _model(
    name: str, spec: "GridSpec", height: float | None, position: tuple[float, float, float] | None
) -> "InverseSensorModel":
    """Return the model by the options; the released model has its own mount."""
    from ogm.models.named import RELEASED, load_model, with_radar
    from ogm.pose import pose
    from ogm.scan import Mount

    if name != RELEASED:
        return load_model(with_radar(name), spec)
    if height is not None:
        raise ValueError(f"{RELEASED} has a fixed sensor height of 1.61 m; leave out --sensor-height")
    mount = Mount(1.61) if position is None else Mount(1.61, pose(*position), points_in="vehicle")
    return load_model(name, spec, mount)


def _check_replaced(dataset: "Dataset", spec: "GridSpec") -> None:
    """Raise a ValueError if a default output would replace a file that the same command did not write."""
    from ogm.grid import EvidentialGrid

    for frame in dataset:
        grid = Path(f"{frame.name.replace('/', '_')}.npz")
        there = [path for path in (grid, grid.with_suffix(".png")) if path.exists()]
        with suppress(ValueError, OSError):
            if EvidentialGrid.load(grid).spec == spec:
                continue
        if there:
            raise ValueError(f"{there[0]} exists and is no result of this command: give --out and --picture or move it")


def _written(names: list[str], grids: Path | None, pictures: Path | None) -> str:
    """Return the written files, or their folders, as text."""
    parts = []
    for path, ending in ((grids, ".npz"), (pictures, ".png")):
        if path is not None and path.is_dir() and path.suffix != ".zarr":
            parts.append(str(path / f"{names[0]}{ending}") if len(names) == 1 else f"{len(names)} {ending} in {path}")
        elif path is not None:
            parts.append(str(path))
    return ", ".join(parts)


def _cells(spec: "GridSpec") -> str:
    return f"{spec.shape[0]} x {spec.shape[1]} cells of {spec.resolution:g} m"


def _part(grid: "EvidentialGrid", along: slice, across: slice) -> "EvidentialGrid":
    """Return a part of a grid."""
    from ogm.grid import EvidentialGrid, GridSpec

    spec, mass = grid.spec, grid.mass[along, across]
    x, y = (low + spec.resolution * (part.start or 0) for low, part in zip(spec.origin, (along, across), strict=True))
    return EvidentialGrid(GridSpec(spec.resolution, mass.shape[:2], (x, y)), mass)


def _table() -> Table:
    table = Table(box=None, pad_edge=False)
    for name in ("", "points", "free", "occupied", "unknown", "ms/scan"):
        table.add_column(name, justify="left" if name == "" else "right", no_wrap=name != "")
    return table


def _row(table: Table, name: str, count: int, grid: "EvidentialGrid", seconds: float) -> None:
    shares = (f"{100 * float(share.mean()):.1f} %" for share in (grid.free, grid.occupied, grid.unknown))
    table.add_row(Text(name.encode("utf-8", "replace").decode()), f"{count}", *shares, f"{1e3 * seconds:.1f}")


def _timed(call: "Callable[[], EvidentialGrid]", repeats: int) -> tuple["EvidentialGrid", float]:
    """Return a grid and its computing time, the median of `repeats` calls [s]."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        grid = call()
        seconds.append(time.perf_counter() - start)
    return grid, statistics.median(seconds)

"""``ogm world``: maps of a whole city from many drives."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import chosen_model, complain, out, print_facts, progress_bar, report_errors, stderr
from ogm.cli.fuse_command import UsualModel
from ogm.cli.sensor_options import SensorOptions, sensor_options
from ogm.extras import import_extra

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.world import Progress as Event
    from ogm.world import WorldMap


world_app: typer.Typer = typer.Typer(
    name="world",
    help="Maps of a whole city: tiles in a folder or an object store, built from many drives.",
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
MAX_CONFLICT = 0.2  # share of contradictory cells above which poses of drives are unlikely to be in one frame

Url = Annotated[str, Argument(help="Map: a folder, a .zip (read only), or s3://bucket/prefix.", metavar="URL")]
DataSets = Annotated[list[Path], Argument(help="Datasets, logs, or folders of scans.", metavar="DATASETS")]
OutUrl = Annotated[str, Option("--out", help="Map: a new folder, s3://bucket/prefix, or a map to add drives to.")]
PosesOf = Annotated[list[Path] | None, Option(help="Poses of each dataset, in order: KITTI, TUM, .csv, .g2o.")]
Calib = Annotated[Path | None, Option(help="KITTI's calib.txt, for poses of its camera.")]
Rate = Annotated[float, Option(help="Rate of scans without stamps [Hz], if the poses have none either.")]
Rule = Annotated[str, Option(help="Combination rule of a new map: cautious, dempster, cumulative.")]
Trust = Annotated[float, Option("--drive-reliability", help="Reliability of each drive's map, (0, 1], of a new map.")]
Tile = Annotated[int, Option(help="Cells along a side of a tile, a power of two, of a new map.")]
Crs = Annotated[str | None, Option(help="Coordinate reference system of the poses, such as EPSG:25832, of a new map.")]
SubMaps = Annotated[float, Option("--submap-length", help="Length of the path covered by a sub-map [m].")]
Extent = Annotated[tuple[float, float, float, float] | None, Option(help="x_min x_max y_min y_max [m]. [default: all]")]
Level = Annotated[int, Option(help="Level: cells of 2**LEVEL times the side.", min=0)]
DriveName = Annotated[str | None, Option("--drive", help="Name of the drive; `ogm world info` lists the names.")]


@report_errors
@sensor_options
def build(
    datasets: DataSets,
    out_url: OutUrl,
    workers: options.Workers = 1,
    scheduler: options.Scheduler = None,
    poses: PosesOf = None,
    calib: Calib = None,
    rate: Rate = 10.0,
    ism: UsualModel = None,
    first: options.First = None,
    axes: options.Axes = "flu",
    sensors: SensorOptions = SensorOptions(),  # noqa: B008  it is immutable
    length: options.Length = None,
    width: options.Width = None,
    resolution: options.Resolution = 0.16,
    rule: Rule = "cautious",
    drive_reliability: Trust = 0.8,
    tile: Tile = 512,
    crs: Crs = None,
    submap_length: SubMaps = 50.0,
) -> None:
    """Build a map from drives, or add drives to a map.

    Every sequence of a dataset is a drive, named after both. Finished parts are never recomputed: the same command
    resumes after Ctrl-C or a kill, and adds new drives. The map is identical for any number of workers. Workers of
    --scheduler need datasets and map under the same paths. Address and credentials of an object store are taken from
    the environment (AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID, ...).
    """
    from ogm.grid import GridSpec
    from ogm.models.named import load_model, with_radar
    from ogm.workflows import drives_of
    from ogm.workflows.checks import gravest
    from ogm.world import WorldMap, build_world

    if poses is not None and len(poses) != len(datasets):
        raise ValueError(f"--poses must be given once per dataset, or not at all, got {len(poses)} for {len(datasets)}")
    options.check_first(first)
    import_extra("zarr", "world")  # before scans are read
    spec = GridSpec.centered(length, width, resolution)
    ism = chosen_model(ism, spec)
    model = load_model(with_radar(ism), spec)
    placed = sensors._asdict()
    opened = [
        (path, _open(path, axes, poses[n] if poses else None, calib, rate, placed)) for n, path in enumerate(datasets)
    ]
    drives = {name: drive[:first] for name, drive in drives_of(opened).items()}
    for name, drive in drives.items():
        for finding in gravest(drive, ism):
            complain(f"{name}: {finding}")
    try:
        world = WorldMap.open(out_url, "r+")
    except FileNotFoundError:
        world = WorldMap.create(
            out_url,
            resolution,
            tile,
            crs=crs,
            rule=rule,  # type: ignore[arg-type]
            drive_reliability=drive_reliability,
        )
    with world, _progress() as show:
        build_world(world, drives, model, length=submap_length, workers=workers, scheduler=scheduler, progress=show)
        if not world.tiles():
            raise ValueError(f"{out_url} stays empty: no scan has evidence on the grid; `ogm map` of a scan states why")
        world.build_overviews()
        _print(world)
        _print_contradictions(world)


@report_errors
def rebuild(
    url: Url,
    drive: DriveName = None,
    poses: Annotated[Path | None, Option(help="New poses of the drive's sensor: .g2o, TUM, KITTI, .csv.")] = None,
    calib: Calib = None,
    workers: options.Workers = 1,
    scheduler: options.Scheduler = None,
) -> None:
    """Move a drive to other poses, such as after a loop closure, and rebuild the changed tiles.

    Poses with stamps (TUM, .csv) are matched by stamp, others by frame number (vertex identifiers in .g2o), or by
    row. Without --drive and --poses, all tiles are read, and missing or damaged tiles are rebuilt.
    """
    from ogm.io import read_calibration, read_poses
    from ogm.world import WorldMap, rebuild_world

    if (drive is None) != (poses is None):
        raise ValueError("give both --drive and --poses, or neither to repair the map")
    moved: dict[str, Any] = {}
    if drive is not None and poses is not None:
        found = read_poses(poses, T_camera_sensor=None if calib is None else read_calibration(calib))
        rows = found.poses if found.numbers is None else dict(zip(found.numbers.tolist(), found.poses, strict=True))
        moved[drive] = rows if found.stamps is None else found.trajectory()
    with WorldMap.open(url, "r+") as world, _progress() as show:
        rebuild_world(world, moved, workers=workers, scheduler=scheduler, progress=show)
        world.build_overviews()
        _print(world)


@report_errors
def info(url: Url) -> None:
    """Print the contents of a map and its drives."""
    from ogm.world import WorldMap

    with WorldMap.open(url) as world:
        _print(world)


@report_errors
def export(
    url: Url,
    path: Annotated[Path, Argument(help="File: .tif, .yaml, .npz, .nc, .zarr, .png; .zip (whole map); new folder.")],
    extent: Extent = None,
    level: Level = 0,
) -> None:
    """Write a part of a map in another format, the whole map as .zip, or pictures of its tiles in a folder."""
    from ogm.io import PlacedGrid, write_grid
    from ogm.io.grids.files import check_grid_output
    from ogm.world import WorldMap, write_pyramid

    with WorldMap.open(url) as world:
        if path.suffix.lower() == ".zip" or not path.suffix:
            if extent is not None or level:
                raise ValueError("--extent and --level are for grid files: .zip and folders contain the whole map")
            if path.suffix:
                world.copy_to(path)
            else:
                out.print(f"{write_pyramid(world, path)} pictures", markup=False)
        else:
            check_grid_output(path, crs=world.crs)
            grid = world.window(world.cells(extent, level), level=level)
            write_grid(path, PlacedGrid(grid, crs=world.crs))
            print_facts({"cells": str(grid.spec)})
    out.print(f"written {path}", markup=False)


def _open(
    path: Path, axes: Any, poses: Path | None, calib: Path | None, rate: float, placed: Mapping[str, Any]
) -> "Dataset":
    """Return a dataset, with poses of a file if one is given."""
    from ogm.datasets import open_dataset, with_poses

    dataset = open_dataset(path, axes=axes, default_split="sequences", **placed)
    return dataset if poses is None else with_poses(dataset, poses, calib, rate)


class _progress:  # noqa: N801  a context manager
    """Progress bar; called with events of a build."""

    def __enter__(self) -> "_progress":
        self._display = progress_bar()
        self._display.start()
        self._task = self._display.add_task("reading poses", total=None)
        self._skipped = 0
        return self

    def __call__(self, event: "Event") -> None:
        self._skipped = max(self._skipped, event.skipped)
        self._display.update(self._task, description=event.stage, completed=event.done, total=event.total)

    def __exit__(self, *error: object) -> None:
        self._display.stop()
        if self._skipped:
            stderr.print(f"ogm: {self._skipped} frames were skipped: damaged, or without a pose", markup=False)


def _print(world: "WorldMap") -> None:
    """Print the contents of a map and its drives."""
    from ogm.world.drives import drive_names, load_drive

    facts = world.describe()
    for name in drive_names(world.store):
        drive = load_drive(world.store, name)
        made = sum(submap.tiles is not None for submap in drive.submaps)
        frames = sum(submap.mapped for submap in drive.submaps)
        facts[f"drive {name}"] = f"{frames} frames, {made} of {len(drive.submaps)} sub-maps"
    print_facts(facts)


def _print_contradictions(world: "WorldMap") -> None:
    """Print the share of cells in which the drives of a map contradict each other."""
    from ogm.world.drives import drive_names, load_drive
    from ogm.world.tasks import contradictions

    against, common = contradictions(world.store, [load_drive(world.store, name) for name in drive_names(world.store)])
    if common:
        share = against / common
        out.print(f"conflict of drives: {share:.1%} of {common} cells known to two drives or more", soft_wrap=True)
        if share > MAX_CONFLICT:
            complain("the drives contradict each other in many cells: check that their poses share a frame")


world_app.command(
    epilog="Examples:  ogm world build drives/ --out town --workers 2 · ogm world build a.mcap b.mcap --out "
    "s3://maps/town --scheduler tcp://10.0.0.1:8786 · ogm world build kitti/00 --poses 00.txt --calib calib.txt --out k"
)(build)
world_app.command(epilog="Example:  ogm world rebuild town --drive kitti-00 --poses closed.g2o")(rebuild)
world_app.command(epilog="Example:  ogm world info town")(info)
world_app.command(
    epilog="Examples:  ogm world export town part.tif --extent 0 200 -50 50 · ogm world export town map.yaml --level "
    "1 · ogm world export town town.zip · ogm world export town pictures/"
)(export)

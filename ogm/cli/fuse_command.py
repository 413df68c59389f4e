"""``ogm fuse``: the scans of a drive to one map that remembers and forgets."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import track
from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import chosen_model, complain, out, print_facts, report_errors, stderr
from ogm.cli.drive import check_pose_options, pick_drive, print_sensor, with_known_poses
from ogm.cli.options import File
from ogm.cli.sensor_options import SensorOptions, sensor_options
from ogm.evidence.map_rules import DYNAMIC, MAP_RULES, NUSS, REVISE, SMOOTH

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.workflows import FuseInto, Outputs

ScanPaths = Annotated[list[Path], Argument(help="Files of scans, a folder, a data set, or a log.", metavar="SCANS")]
Poses = Annotated[File, Option(help="Poses of the sensor: KITTI, KITTI-360, TUM (.txt), or what --save-poses wrote.")]
Calibration = Annotated[File, Option(help="KITTI's calib.txt, where the poses are those of its camera.")]
Odometry = Annotated[str | None, Option(help="Estimate the poses from the scans: kiss-icp or small-gicp.")]
SavePoses = Annotated[File, Option(help="Write the poses of the scans that were mapped (.csv, or .txt for TUM).")]
Match = Annotated[
    bool, Option("--match", help="Of planar lasers: take the poses for odometry, and refine them by scan matching.")
]
Rate = Annotated[float, Option(help="Rate of the scans [Hz], where neither they nor the poses have stamps.")]
Drive = Annotated[str | None, Option(help="Drive of a data set: its name or number. [default: the first]")]
_MODELS = (
    "Sensor model: ray, planar, height-band, lite, combined, weights that `ogm train` wrote, or the .json of "
    "`ogm calibrate`; of radars: radar, deep-radar; of several kinds: ray+radar, ray+planar, ..."
)
UsualModel = Annotated[
    str | None,
    Option(
        help=f"{_MODELS} [default: combined; ray for dynamic maps, and where the network is not installed or does not "
        "suit the grid; planar for planar lasers and sonars]"
    ),
]
Deskew = Annotated[bool, Option("--deskew", help="Undo the ego motion during a scan, by the times of its points.")]
RadarReliability = Annotated[
    float,
    Option(
        help="Of radars beside a lidar, 0 to 1: their masses are discounted by it, their Doppler is not.", min=0, max=1
    ),
]
Rule = Annotated[
    str | None, Option(help=f"Combine by: {', '.join(MAP_RULES)}. [default: {REVISE}, and {SMOOTH} for planar lasers]")
]
Dynamic = Annotated[bool, Option("--dynamic", help="Separate moving from static, with velocities: --rule dynamic.")]
Particles = Annotated[int | None, Option(help="Of a dynamic map: how many carry what moves. [default: 200000]")]
HalfLife = Annotated[
    float | None,
    Option(
        help="Time in which belief halves [s], or inf; of dynamic maps that in static. [default: 2; bayes, planar "
        "lasers: inf]"
    ),
]
Continue = Annotated[
    File,
    Option(
        "--continue", help="Go on with a map that was saved (.npz with all that it knows; .tif, ...), of this place."
    ),
]
Window = Annotated[
    str | None,
    Option(help="rolling: follows the vehicle. fixed: covers the drive. [default: rolling; planar lasers: fixed]"),
]
SideOfCell = Annotated[
    float | None, Option("--resolution", help="Side of a cell [m]. [default: 0.16; planar lasers: 0.05]")
]
Out = Annotated[
    File,
    Option(
        "--out",
        help="Map: .npz, .yaml (map_server), .tif, .nc, .zarr, .png (masses as colours), or .mcap, .db3, .bag with the "
        "map and pose after each scan; its folder is made if need be. [default: map.npz]",
    ),
]
Message = Annotated[
    str | None,
    Option(help="In logs: occupancy-grid, or with masses grid-map or foxglove-grid. [default: occupancy-grid]"),
]
Picture = Annotated[File, Option(help="Last scan: points, measurement, map, conflict (.png). [default: map.png]")]
Page = Annotated[
    File,
    Option(help="Page for a browser: the map, its conflict and why cells are unknown, zoom, values of cells (.html)."),
]
EachDrive = Annotated[
    bool,
    Option(
        "--each-drive",
        help="Fuse every drive of every data set of SCANS; the outputs, all in one folder, go into one for each drive "
        "there.",
    ),
]
MovieFile = Annotated[File, Option(help="Film of the drive, at its own pace: .gif, .webp or .png (animated).")]


@report_errors
@sensor_options
def fuse(
    scans: ScanPaths,
    poses: Poses = None,
    calib: Calibration = None,
    odometry: Odometry = None,
    match: Match = False,
    save_poses: SavePoses = None,
    rate: Rate = 10.0,
    sequence: Drive = None,
    topic: options.Topic = None,
    fixed_frame: options.FixedFrame = None,
    first: options.First = None,
    sensor: options.Sensor = None,
    ism: UsualModel = None,
    axes: options.Axes = "flu",
    sensors: SensorOptions = SensorOptions(),  # noqa: B008  it is immutable
    intensity_max: options.IntensityMax = None,
    time_unit: options.TimeUnit = None,
    deskew: Deskew = False,
    radar_reliability: RadarReliability = 0.25,
    rule: Rule = None,
    dynamic: Dynamic = False,
    particles: Particles = None,
    half_life: HalfLife = None,
    window: Window = None,
    continue_path: Continue = None,
    length: options.Length = None,
    width: options.Width = None,
    resolution: SideOfCell = None,
    out_path: Out = None,
    message: Message = None,
    picture: Picture = None,
    movie: MovieFile = None,
    page: Page = None,
    each_drive: EachDrive = False,
    workers: options.Workers = 1,
    scheduler: options.Scheduler = None,
) -> None:
    """Fuse the scans of a drive into one map.

    With --dynamic, the map has belief in static and in dynamic and velocities: in colour the heading of what moves, and
    an arrow as long as its way in 1 s. --out keeps them in .npz, .tif, .nc, .zarr, and in logs with grid-map or
    foxglove-grid.

    Frames: points lie around the sensor (x forward, y left), measurement grids around the levelled sensor. A pose takes
    its scan to the map, whose axes stay those of the poses; picture and film are along the vehicle's axes. With --axes,
    poses have the files' own axes, as the points have (not what --save-poses wrote). Poses belong to scans by frame
    number (the last number in a scan's name), else by stamp (interpolated), else by order. Data sets that know their
    poses need none.

    Scans of planar lasers give the map of a building: cells of 0.05 m, in a window that holds all echoes, and nothing
    is forgotten.

    A scan that is damaged, has no pose, or whose pose or stamp jumps is skipped with a message, and the exit code is 2.
    After three jumps in a row the map so far is saved as NAME.before-jump-1.npz and begins anew. Ctrl-C, or an error
    half-way through the mapping, writes what there is.

    With --continue, the drive goes on with a map in the frame of its poses. The map ages until the first scan, if that
    follows it in time. The result is the map of all scans if rule, half-life and models are those of before.

    With --each-drive, a drive is the work of one of --workers. Its folder appears when all in it is written: the same
    command goes on after Ctrl-C or a kill, and adds the drives that are new. One map of many drives is made by `ogm
    world build`.
    """
    from dataclasses import replace

    from ogm.datasets import open_dataset
    from ogm.grid import GridSpec
    from ogm.io.grids.files import check_grid_output, read_placed_grid
    from ogm.models.named import describe_model
    from ogm.workflows import FuseInto, FuseOptions, Outputs, drives_of, fuse_drive, map_defaults
    from ogm.workflows.buildings import BUILDING

    if out_path is None and picture is None and movie is None and page is None:
        out_path, picture = Path("map.npz"), Path("map.png")
    check_pose_options(poses, calib, odometry, save_poses, first)
    if match and odometry is not None:
        raise ValueError("--match and --odometry exclude each other: --match refines poses that are known")
    outputs = Outputs(out_path, picture, movie, save_poses, page)
    outputs.prepare(scans)
    if message == "costmap":
        raise ValueError("--message costmap is for costs: fuse to a map, and `ogm costmap` makes them of it")
    if message is not None:
        check_grid_output(out_path or "map.npz", message=message)  # type: ignore[arg-type]
    rule = _checked_rule(rule, dynamic, particles)
    reading = {"axes": axes, "intensity_max": intensity_max, "time_unit": time_unit, "topic": topic or ()}
    reading |= {"frame": fixed_frame, **sensors._asdict()}
    datasets = [
        open_dataset(paths, sensors=sensor or (), default_split="sequences", **reading)
        for paths in ([[path] for path in scans] if each_drive else [scans])
    ]
    usual = map_defaults(datasets[0], rule)
    rule = usual.rule
    saved = None if continue_path is None else read_placed_grid(continue_path)
    side = usual.resolution if saved is None else saved.grid.spec.resolution
    spec = GridSpec.centered(length, width, side if resolution is None else resolution)
    if ism is not None or usual.window != BUILDING.window:
        ism = chosen_model(ism, spec, rule)
    options = FuseOptions(
        ism=ism,
        spec=spec,
        rule=rule,
        half_life=usual.half_life if half_life is None else half_life,
        window=window or usual.window,
        match=match,
        particles=200_000 if particles is None else particles,
        deskew=deskew,
        radar_reliability=radar_reliability,
        sensors=tuple(sensor or ()),
        message=message,
        saved=saved,
    )
    options.check()
    if each_drive:
        if saved is not None:
            raise ValueError("--continue is of one drive: leave out --each-drive; `ogm world build` joins drives")
        _check_many(poses, sequence, outputs)
        weights = describe_model(str(options.ism))[1]
        options = replace(options, odometry=odometry, rate=rate, first=first, weights=weights)
        drives, fuse_one = drives_of(zip(scans, datasets, strict=True)), FuseInto(options, outputs.within(Path()))
        raise typer.Exit(_fuse_each(drives, fuse_one, outputs.base.parent, workers, scheduler))
    if workers > 1 or scheduler is not None:
        raise ValueError("--workers and --scheduler are for --each-drive: the scans of one drive follow each other")
    dataset = pick_drive(datasets[0], sequence)
    dataset = with_known_poses(dataset, poses, calib, odometry, rate, first, match)
    print_sensor(dataset)
    run = fuse_drive(
        dataset,
        outputs,
        replace(options, match=False),
        tell=complain,
        progress=lambda steps: track(steps, "mapping", len(dataset), console=stderr, transient=True),
    )
    print_facts(run.facts())
    written = (f"{name} {path}" for name, path in outputs.given().items())
    out.print("   ".join(written), markup=False, soft_wrap=True)
    if run.code:
        raise typer.Exit(run.code)


def _checked_rule(rule: str | None, dynamic: bool, particles: int | None) -> str | None:
    """Return the rule by the options, None for that of the sensor; refuse options that exclude each other."""
    chosen = rule or (DYNAMIC if dynamic else None)
    if dynamic and chosen not in (DYNAMIC, NUSS):
        raise ValueError(f"--dynamic has a filter of its own, {DYNAMIC} or {NUSS}: leave out --rule {rule}")
    if particles is not None and chosen not in (DYNAMIC, NUSS):
        raise ValueError("--particles belongs to --dynamic, which is missing")
    return chosen


def _check_many(poses: Path | None, sequence: str | None, outputs: "Outputs") -> None:
    """Refuse options of one drive, and outputs in several folders."""
    if poses is not None or sequence is not None:
        raise ValueError("--poses and --sequence are of one drive: leave them out, or leave out --each-drive")
    folders = sorted({str(path.parent) for path in outputs.given().values()})
    if len(folders) > 1:
        raise ValueError(f"with --each-drive all outputs lie in one folder, got {', '.join(folders)}")


def _fuse_each(
    drives: "dict[str, Dataset]", fuse_one: "FuseInto", folder: Path, workers: int, scheduler: str | None
) -> int:
    """Fuse drives into folders of their own, print what was done, and return the exit code."""
    from ogm.workflows import fuse_drives

    code, done, rows = 0, 0, dict[str, Any]()
    made = fuse_drives(drives, fuse_one, folder, workers=workers, scheduler=scheduler)
    try:
        for one in track(made, "fusing drives", len(drives), console=stderr, transient=True):
            done += not one.error
            code = max(code, 2 if one.error else one.facts["code"])
            for text in [one.error] if one.error else one.facts["messages"]:
                complain(f"{one.name}: {text}")
            rows[one.name] = "nothing is written" if one.error else f"{one.facts['scans']}, {one.facts['path']}"
            rows[one.name] += ", was finished before" if one.reused else ""
    except KeyboardInterrupt:
        kept = f"{done} of {len(drives)} drives are finished and kept in {folder}"
        raise KeyboardInterrupt(f"{kept}: repeat the command to resume") from None
    print_facts({name: rows[name] for name in drives})
    out.print(f"written {folder}", markup=False, soft_wrap=True)
    return code

"""``ogm fuse``: fuse the scans of a drive into one map with temporal forgetting."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import chosen_model, complain, out, print_facts, report_errors, ticked
from ogm.cli.drive import check_pose_options, pick_drive, print_sensor, with_known_poses
from ogm.cli.options import File
from ogm.cli.sensor_options import SensorOptions, sensor_options
from ogm.evidence.map_rules import DYNAMIC, MAP_RULES, NUSS, REVISE, SMOOTH

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.workflows import FuseInto, Outputs

ScanPaths = Annotated[list[Path], Argument(help="Scan files, a folder, a dataset, or a log.", metavar="SCANS")]
Poses = Annotated[File, Option(help="Poses of the sensor: KITTI, KITTI-360, TUM (.txt), or a file of --save-poses.")]
Calibration = Annotated[File, Option(help="KITTI's calib.txt, for poses of its camera.")]
Odometry = Annotated[str | None, Option(help="Estimate the poses from the scans: kiss-icp or small-gicp.")]
SavePoses = Annotated[File, Option(help="Write the poses of the mapped scans (.csv, or .txt for TUM).")]
Match = Annotated[bool, Option("--match", help="For planar lasers: refine poses, used as odometry, by scan matching.")]
Rate = Annotated[float, Option(help="Rate of scans without stamps [Hz], if the poses have none either.")]
Drive = Annotated[str | None, Option(help="Drive of a dataset: its name or number. [default: the first]")]
_MODELS = (
    "Sensor model: ray, planar, height-band, lite, combined, weights of `ogm train`, or the .json of "
    "`ogm calibrate`; for radars: radar; for several kinds: ray+radar, ray+planar, ..."
)
UsualModel = Annotated[
    str | None,
    Option(
        help=f"{_MODELS} [default: combined; ray for dynamic maps, and if the network is not installed or does not "
        "suit the grid; planar for planar lasers and sonars]"
    ),
]
Deskew = Annotated[bool, Option("--deskew", help="Undo the ego motion during a scan, by the times of its points.")]
RadarReliability = Annotated[
    float, Option(help="Reliability of radars used with a lidar, 0 to 1; does not affect Doppler.", min=0, max=1)
]
Rule = Annotated[
    str | None, Option(help=f"Rule: {', '.join(MAP_RULES)}. [default: {REVISE}, and {SMOOTH} for planar lasers]")
]
Dynamic = Annotated[bool, Option("--dynamic", help="Separate moving from static, with velocities: --rule dynamic.")]
Particles = Annotated[int | None, Option(help="Number of particles of a dynamic map. [default: 200000]")]
HalfLife = Annotated[
    float | None,
    Option(help="Half-life of belief [s], or inf; in dynamic maps of static. [default: 2; bayes, planar lasers: inf]"),
]
Continue = Annotated[File, Option("--continue", help="Continue a saved map (.npz with its full state; .tif, ...).")]
Window = Annotated[
    str | None,
    Option(help="rolling: follows the vehicle. fixed: covers the drive. [default: rolling; planar lasers: fixed]"),
]
SideOfCell = Annotated[float | None, Option("--resolution", help="Cell side [m]. [default: 0.16; planar lasers: 0.05]")]
Out = Annotated[
    File,
    Option(
        "--out",
        help="Map: .npz, .yaml (map_server), .tif, .nc, .zarr, .png (masses as colours), or .mcap, .db3, .bag with the "
        "map and pose after each scan; its folder is created. [default: map.npz]",
    ),
]
Message = Annotated[
    str | None,
    Option(help="Message of logs: occupancy-grid, or with masses grid-map, foxglove-grid. [default: occupancy-grid]"),
]
Picture = Annotated[File, Option(help="Last scan: points, measurement, map, conflict (.png). [default: map.png]")]
Page = Annotated[File, Option(help="Page for a browser (.html): map, conflict, causes of unknown cells, zoom, values.")]
EachDrive = Annotated[
    bool, Option("--each-drive", help="Fuse every drive of all datasets, each into a subfolder of the outputs' folder.")
]
MovieFile = Annotated[File, Option(help="Film of the drive in real time: .gif, .webp or .png (animated).")]


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

    With --dynamic, the map holds belief in static and dynamic, and velocities: colours show the heading of moving
    objects, arrows their path in 1 s. --out keeps them in .npz, .tif, .nc, .zarr, and in logs with grid-map or
    foxglove-grid.

    Frames: points are in the sensor frame (x forward, y left), measurement grids around the levelled sensor. A pose
    takes its scan to the map, which keeps the axes of the poses; picture and film use the vehicle's axes. With --axes,
    poses and points share the axes of the files (except poses of --save-poses). Poses are matched to scans by frame
    number (the last number in a scan's name), else by stamp (interpolated), else by order. Datasets with poses need
    no further ones.

    Scans of planar lasers give the map of a building: cells of 0.05 m, a window that covers all echoes, no forgetting.

    Damaged scans, scans without a pose, and scans after a jump of pose or stamp are skipped with a message, and the
    exit code is 2. After three jumps in a row the map so far is saved as NAME.before-jump-1.npz, and a new map begins.
    Ctrl-C or an error during the mapping writes the partial result.

    With --continue, the drive continues a map in the frame of its poses. The map ages until the first scan, if the scan
    is later than the map. The result is the map of all scans if rule, half-life and models are unchanged.

    With --each-drive, --workers fuse one drive each. A drive's folder appears when it is complete: the same command
    resumes after Ctrl-C or a kill, and adds new drives. For one map of many drives see `ogm world build`.
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
        raise ValueError("--match and --odometry exclude each other: --match refines given poses")
    outputs = Outputs(out_path, picture, movie, save_poses, page)
    outputs.prepare(scans)
    if message == "costmap":
        raise ValueError("--message costmap is for costs: fuse to a map, then use `ogm costmap`")
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
            raise ValueError("--continue is for one drive: leave out --each-drive; `ogm world build` joins drives")
        _check_many(poses, sequence, outputs)
        weights = describe_model(str(options.ism))[1]
        options = replace(options, odometry=odometry, rate=rate, first=first, weights=weights)
        drives, fuse_one = drives_of(zip(scans, datasets, strict=True)), FuseInto(options, outputs.within(Path()))
        raise typer.Exit(_fuse_each(drives, fuse_one, outputs.base.parent, workers, scheduler))
    if workers > 1 or scheduler is not None:
        raise ValueError("--workers and --scheduler are for --each-drive; one drive is fused scan by scan")
    dataset = pick_drive(datasets[0], sequence)
    dataset = with_known_poses(dataset, poses, calib, odometry, rate, first, match)
    print_sensor(dataset)
    run = fuse_drive(
        dataset,
        outputs,
        replace(options, match=False),
        warn=complain,
        progress=lambda steps: ticked(steps, "mapping", len(dataset)),
    )
    print_facts(run.facts())
    written = (f"{name} {path}" for name, path in outputs.given().items())
    out.print("   ".join(written), markup=False, soft_wrap=True)
    if run.code:
        raise typer.Exit(run.code)


def _checked_rule(rule: str | None, dynamic: bool, particles: int | None) -> str | None:
    """Return the rule by the options, None for the default of the sensor; raise if options exclude each other."""
    chosen = rule or (DYNAMIC if dynamic else None)
    if dynamic and chosen not in (DYNAMIC, NUSS):
        raise ValueError(f"--dynamic needs the rule {DYNAMIC} or {NUSS}: leave out --rule {rule}")
    if particles is not None and chosen not in (DYNAMIC, NUSS):
        raise ValueError("--particles needs --dynamic: give both, or leave out --particles")
    return chosen


def _check_many(poses: Path | None, sequence: str | None, outputs: "Outputs") -> None:
    """Raise a ValueError for options of a single drive, and for outputs in several folders."""
    if poses is not None or sequence is not None:
        raise ValueError("--poses and --sequence are for one drive: leave them out, or leave out --each-drive")
    folders = sorted({str(path.parent) for path in outputs.given().values()})
    if len(folders) > 1:
        raise ValueError(f"with --each-drive all outputs must be in one folder, got {', '.join(folders)}")


def _fuse_each(
    drives: "dict[str, Dataset]", fuse_one: "FuseInto", folder: Path, workers: int, scheduler: str | None
) -> int:
    """Fuse each drive into its own folder, print a summary, and return the exit code."""
    from ogm.workflows import fuse_drives

    code, done, rows = 0, 0, dict[str, Any]()
    made = fuse_drives(drives, fuse_one, folder, workers=workers, scheduler=scheduler)
    try:
        for drive in ticked(made, "fusing drives", len(drives)):
            done += not drive.error
            code = max(code, 2 if drive.error else drive.facts["code"])
            for text in [drive.error] if drive.error else drive.facts["messages"]:
                complain(f"{drive.name}: {text}")
            rows[drive.name] = "nothing is written" if drive.error else f"{drive.facts['scans']}, {drive.facts['path']}"
            rows[drive.name] += ", was finished before" if drive.reused else ""
    except KeyboardInterrupt:
        kept = f"{done} of {len(drives)} drives are finished and kept in {folder}"
        raise KeyboardInterrupt(f"{kept}: repeat the command to resume") from None
    print_facts({name: rows[name] for name in drives})
    out.print(f"written {folder}", markup=False, soft_wrap=True)
    return code

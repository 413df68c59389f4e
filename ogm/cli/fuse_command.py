"""``ogm fuse``: the scans of a drive to one map that remembers and forgets."""

import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import chosen_model, one_line, out, print_facts, report_errors
from ogm.cli.drive import check_pose_options, pick_drive, with_known_poses
from ogm.cli.options import File
from ogm.io.grids import MAP_ENDINGS, GridLog, check_grid_output, write_grid
from ogm.io.logs import LOG_ENDINGS

ENDINGS = {  # of what each option writes
    "--out": MAP_ENDINGS,
    "--picture": (".png",),
    "--movie": (".gif", ".webp", ".png"),
    "--page": (".html",),
    "--save-poses": (".csv", ".txt", ".tum"),
}

ScanPaths = Annotated[list[Path], Argument(help="Files of scans, a folder, a data set, or a log.", metavar="SCANS")]
Poses = Annotated[File, Option(help="Poses of the sensor: KITTI, KITTI-360, TUM (.txt), or what --save-poses wrote.")]
Calibration = Annotated[File, Option(help="KITTI's calib.txt, where the poses are those of its camera.")]
Odometry = Annotated[str | None, Option(help="Estimate the poses from the scans: kiss-icp or small-gicp.")]
SavePoses = Annotated[File, Option(help="Write the poses of the scans that were mapped (.csv, or .txt for TUM).")]
Rate = Annotated[float, Option(help="Rate of the scans [Hz], where neither they nor the poses have stamps.")]
Drive = Annotated[str | None, Option(help="Drive of a data set: its name or number. [default: the first]")]
First = Annotated[int | None, Option(help="Map the first so many scans only. [default: all]")]
_MODELS = (
    "Sensor model: ray, height-band, lite, combined, weights that `ogm train` wrote, or the .json of `ogm calibrate`; "
    "of radars: radar, deep-radar; of both: ray+radar, lite+deep-radar, ..."
)
Model = Annotated[str, Option(help=_MODELS)]
UsualModel = Annotated[
    str | None,
    Option(help=f"{_MODELS} [default: combined; ray where the network is not installed or does not suit the grid]"),
]
Deskew = Annotated[bool, Option("--deskew", help="Undo the ego motion during a scan, by the times of its points.")]
RadarReliability = Annotated[
    float,
    Option(
        help="Of radars beside a lidar, 0 to 1: their masses are discounted by it, their Doppler is not.", min=0, max=1
    ),
]
Rule = Annotated[
    str | None,
    Option(
        help="Combine by: cautious, dempster, yager, cumulative, pcr6, averaging, weighted, bayes, dynamic, nuss. "
        "[default: cautious]"
    ),
]
Dynamic = Annotated[
    bool, Option("--dynamic", help="Tell what moves from what stands, with velocities: --rule dynamic, or nuss.")
]
Particles = Annotated[int | None, Option(help="Of a dynamic map: how many carry what moves. [default: 200000]")]
HalfLife = Annotated[
    float | None,
    Option(help="Time in which belief halves [s], or inf; of dynamic maps that in static. [default: 2; bayes: inf]"),
]
Window = Annotated[
    str, Option(help="rolling: follows the vehicle. fixed: covers the drive (--half-life inf keeps it).")
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
Page = Annotated[File, Option(help="Page for a browser: the map and its conflict, zoom, values of each cell (.html).")]
MovieFile = Annotated[File, Option(help="Film of the drive, at its own pace: .gif, .webp or .png (animated).")]


@report_errors
def fuse(
    scans: ScanPaths,
    poses: Poses = None,
    calib: Calibration = None,
    odometry: Odometry = None,
    save_poses: SavePoses = None,
    rate: Rate = 10.0,
    sequence: Drive = None,
    topic: options.Topic = None,
    fixed_frame: options.FixedFrame = None,
    first: First = None,
    sensor: options.Sensor = None,
    ism: UsualModel = None,
    axes: options.Axes = "flu",
    sensor_height: options.SensorHeight = None,
    sensor_position: options.SensorPosition = None,
    intensity_max: options.IntensityMax = None,
    time_unit: options.TimeUnit = None,
    deskew: Deskew = False,
    radar_reliability: RadarReliability = 0.25,
    rule: Rule = None,
    dynamic: Dynamic = False,
    particles: Particles = None,
    half_life: HalfLife = None,
    window: Window = "rolling",
    length: options.Length = None,
    width: options.Width = None,
    resolution: options.Resolution = 0.16,
    out_path: Out = None,
    message: Message = None,
    picture: Picture = None,
    movie: MovieFile = None,
    page: Page = None,
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

    A scan that is damaged, has no pose, or whose pose or stamp jumps is skipped with a message, and the exit code is 2.
    After three jumps in a row the map so far is saved as NAME.before-jump-1.npz and begins anew. Ctrl-C, or an error
    half-way through the mapping, writes what there is.
    """
    from ogm.cli.fuse_run import FusionRun, check_rule
    from ogm.datasets import open_dataset
    from ogm.evaluation.models import sensor_models
    from ogm.fusion import covering_window, make_mapper, rolling_window
    from ogm.fusion import fuse as fused
    from ogm.grid import GridSpec
    from ogm.movie import open_movie
    from ogm.viewer import write_view

    if out_path is None and picture is None and movie is None and page is None:
        out_path, picture = Path("map.npz"), Path("map.png")
    check_pose_options(poses, calib, odometry, save_poses, first)
    outputs = {"--out": out_path, "--picture": picture, "--movie": movie, "--save-poses": save_poses, "--page": page}
    _prepare_outputs(outputs, scans)
    if message is not None:
        check_grid_output(out_path or "map.npz", message=message)  # type: ignore[arg-type]
    spec = GridSpec.centered(length, width, resolution)
    ism = chosen_model(ism, spec)
    model = sensor_models(ism, spec)
    rule, count = check_rule(rule, dynamic, particles)
    make_mapper(rule, spec, half_life, window, count)  # type: ignore[arg-type]  # refuses what is none, before any work
    reading = {"axes": axes, "intensity_max": intensity_max, "time_unit": time_unit}
    split = "sequences" if (scans[0] / "zarr.json").exists() else None
    placed = {
        "sensor_height": sensor_height,
        "sensor_position": sensor_position,
        "topic": topic or (),
        "frame": fixed_frame,
        "sensors": sensor or (),
    }
    dataset = open_dataset(scans, **reading, **placed, split=split)  # type: ignore[arg-type]
    dataset = pick_drive(dataset, sequence, sensor_height)
    if deskew and not dataset.motion_distorted:
        raise ValueError("leave out --deskew: the points of this data set are not (or not all) distorted by motion")
    dataset = with_known_poses(dataset, poses, calib, odometry, rate, first)
    known = [ref.T_map_sensor for ref in dataset.refs if ref.T_map_sensor is not None]
    cells = rolling_window(spec) if window == "rolling" else covering_window(spec, np.array(known))
    mapper = make_mapper(rule, cells, half_life, window, count)  # type: ignore[arg-type]

    base = out_path or picture or movie or page or Path("map.npz")
    run = FusionRun(dataset, mapper, spec, (Path(ism).stem, rule), base)
    times = (dataset.trajectory or True) if deskew else False
    radars = dataset.facts.get("radars", {})
    beside = "lidar" in (sensor or ()) and radars
    reliability = {"": 1.0} | dict.fromkeys(radars, radar_reliability) if beside else 1.0
    steps = fused(dataset, model, mapper, deskew=times, reliability=reliability, on_error=run.report)
    titles = ("points by height", *run.titles)
    is_log = out_path is not None and out_path.suffix.lower() in LOG_ENDINGS
    log = GridLog(out_path, message or "occupancy-grid") if is_log else nullcontext()  # type: ignore[arg-type]
    with open_movie(movie, spec, titles, run.ground_z) if movie else nullcontext() as film, log as maps:
        code = run.map_all(steps, film, maps)
        if run.last is None:
            raise (typer.Exit(code) if code == 130 else ValueError("no scan could be mapped; nothing is written"))
        if out_path is not None and not is_log:
            write_grid(out_path, run.placed)
        if save_poses is not None:
            run.save_poses(save_poses)
        if picture is not None:
            run.save_picture(picture)
        if page is not None:
            write_view(page, run.map, getattr(mapper, "conflict", None), title=f"map of {dataset.name}")
    print_facts(run.facts())
    written = zip(("map", "picture", "movie", "poses", "page"), outputs.values(), strict=True)
    out.print("   ".join(f"{name} {path}" for name, path in written if path), markup=False, soft_wrap=True)
    if code:
        raise typer.Exit(code)


def _prepare_outputs(wanted: dict[str, Path | None], inputs: list[Path]) -> None:
    """Make the folders of all outputs, and see that they can be written, before hours of work."""
    used: dict[Path, str] = {}
    for option, path in wanted.items():
        if path is None:
            continue
        if path.suffix.lower() not in ENDINGS[option]:
            raise ValueError(f"{option} writes {' or '.join(ENDINGS[option])}, got {path}")
        if option == "--out":
            check_grid_output(path)
        if path.is_dir() and path.suffix.lower() != ".zarr":
            raise ValueError(f"{option} {path} is a folder; give a file name")
        if path.resolve() in (one.resolve() for one in inputs):
            raise ValueError(f"{option} would take the place of {path}, which is read; give another name")
        other = used.setdefault(path.resolve(), option)
        if other != option:
            raise ValueError(f"{other} and {option} would both write {path}; give two names")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            raise OSError(f"{option} cannot write into {path.parent}: {one_line(error)}") from error

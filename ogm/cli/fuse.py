"""``ogm fuse``: the scans of a drive to one map that remembers and forgets."""

import math
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import track

from ogm.cli.console import one_line, out, print_facts, report_errors, stderr
from ogm.cli.options import IntensityMax, TimeUnit, parsed_axes
from ogm.cli.rules import BAYES, RULES, mapper_of, rolling

if TYPE_CHECKING:
    from ogm.cli.drive import Drive
    from ogm.cli.route import Route
    from ogm.grid import GridSpec
    from ogm.io import Axes
    from ogm.scan import Mount

METHODS = ("kiss-icp", "small-gicp")
WINDOWS = ("rolling", "fixed")
MOST_CELLS = 2**24  # of a fixed window: 655 m x 655 m at 0.16 m


@report_errors
def fuse(
    scans: Annotated[
        list[Path],
        typer.Argument(
            help="Scans, or a folder of them, or a data set that `ogm simulate` made.", metavar="SCANS"
        ),
    ],
    poses: Annotated[
        Path | None,
        typer.Option(help="Poses of the sensor: KITTI, KITTI-360 or TUM (.txt), or what --save-poses wrote."),
    ] = None,
    calib: Annotated[
        Path | None, typer.Option(help="KITTI's calib.txt, where the poses are those of its camera.")
    ] = None,
    odometry: Annotated[
        str | None, typer.Option(help="Estimate the poses from the scans: kiss-icp or small-gicp.")
    ] = None,
    save_poses: Annotated[
        Path | None,
        typer.Option(help="Write the poses of the scans that were mapped (.csv, or .txt for TUM)."),
    ] = None,
    rate: Annotated[
        float, typer.Option(help="Scans per second [Hz], where neither scans nor poses have stamps.")
    ] = 10.0,
    sequence: Annotated[int | None, typer.Option(help="Which sequence of a data set. [default: 0]")] = None,
    first: Annotated[
        int | None, typer.Option(help="Map the first so many scans only. [default: all]")
    ] = None,
    ism: Annotated[
        str, typer.Option(help="Sensor model: ray, height-band, lite, or weights that `ogm train` wrote.")
    ] = "ray",
    axes: Annotated[
        str,
        typer.Option(help="Axes of the files: flu (x forward, y left), kitti, nuscenes, ..., or +y,-x,+z."),
    ] = "flu",
    sensor_height: Annotated[
        float | None,
        typer.Option(help="Sensor above ground [m]; by default estimated from the first scans."),
    ] = None,
    intensity_max: IntensityMax = None,
    time_unit: TimeUnit = None,
    deskew: Annotated[
        bool, typer.Option("--deskew", help="Undo the own motion during a scan, by the times of its points.")
    ] = False,
    rule: Annotated[
        str, typer.Option(help=f"How scans are combined: {', '.join(RULES)}, or {BAYES} (log-odds).")
    ] = "cautious",
    half_life: Annotated[
        float | None,
        typer.Option(help="Time in which belief halves [s], or inf. [default: 2; bayes: inf]"),
    ] = None,
    window: Annotated[
        str,
        typer.Option(
            help="rolling: the map follows the vehicle. "
            "fixed: it covers the whole drive (with --half-life inf all is kept)."
        ),
    ] = "rolling",
    length: Annotated[float, typer.Option(help="Extent of a scan's grid along x [m].")] = 81.92,
    width: Annotated[float, typer.Option(help="Extent of a scan's grid along y [m].")] = 56.32,
    resolution: Annotated[float, typer.Option(help="Side of a cell [m].")] = 0.16,
    out_path: Annotated[Path | None, typer.Option("--out", help="Map (.npz). [default: map.npz]")] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Picture of the last scan: points, measurement, map, conflict (.png). [default: map.png]"
        ),
    ] = None,
    movie: Annotated[
        Path | None, typer.Option(help="Film of the drive, at its own pace: .gif, .webp or .png (animated).")
    ] = None,
) -> None:
    """Fuse the scans of a drive into one map.

    Frames: points and measurement grids lie around the sensor (x forward, y left). A pose takes its scan to the map,
    whose axes stay those of the poses; picture and film look along the vehicle. With --axes, poses are taken to be
    those of the files' own axes, as the points are (not what --save-poses wrote). Poses belong to scans by frame number
    (the last number in a scan's name), else by stamp (interpolated), else by order.

    A scan that is damaged, has no pose, or whose pose or stamp jumps is skipped with a complaint, and the exit code
    is 2. After three jumps in a row the map so far is saved as NAME.before-jump-1.npz and begins anew. Ctrl-C, or an
    error half-way through the mapping, writes what there is.
    """
    from ogm.cli.drive import drive_of
    from ogm.cli.mapping import Run, map_all
    from ogm.evaluation.models import load_model
    from ogm.grid import GridSpec

    if out_path is None and picture is None and movie is None:
        out_path, picture = Path("map.npz"), Path("map.png")
    _check_choices(rule, window, odometry, poses, calib, save_poses, half_life)
    _check_outputs(out_path, picture, movie, save_poses)
    spec = GridSpec.centered(length=length, width=width, resolution=resolution)
    drive = drive_of(scans, sequence, parsed_axes(axes), intensity_max, time_unit)
    if odometry is not None:
        drive = drive.first(first)
    if deskew and not drive.bent:
        raise ValueError(
            "--deskew: the points of this data set are not (or not all) bent by the own motion; leave it out"
        )
    height = _height(drive, sensor_height)
    mount = Mount(height) if drive.mount is None else Mount(height, drive.mount)
    model = load_model(ism, spec, mount)
    route = _route(drive, poses, calib, odometry, rate, parsed_axes(axes))
    out.print(f"poses: {route.how}", markup=False, soft_wrap=True)
    drive, route = drive.first(first), route.first(first)
    mapper = mapper_of(rule, _window(window, spec, route), half_life, window)  # type: ignore[arg-type]

    base = out_path or picture or movie or Path("map.npz")
    run = Run(drive, route, model, mapper, spec, height, (ism, rule), deskew, base)
    with ExitStack() as stack:
        film = None
        if movie is not None:
            from ogm.cli.movie import movie as opened

            film = stack.enter_context(opened(movie, spec, ("points by height", *run.titles), -height))
        code = map_all(run, film)
        if run.last is None:
            raise (
                typer.Exit(code) if code == 130 else ValueError("no scan could be mapped; nothing is written")
            )
        if out_path is not None:
            mapper.grid.save(out_path)
        if save_poses is not None:
            run.save_poses(save_poses)
        if picture is not None:
            run.save_picture(picture)
    print_facts(run.facts())
    names = {"map": out_path, "picture": picture, "movie": movie, "poses": save_poses}
    written = [f"{name} {path}" for name, path in names.items() if path is not None]
    out.print("   ".join(written), markup=False, soft_wrap=True)
    if code:
        raise typer.Exit(code)


def _check_choices(
    rule: str,
    window: str,
    odometry: str | None,
    poses: Path | None,
    calib: Path | None,
    save_poses: Path | None,
    half_life: float | None,
) -> None:
    """Refuse names that are no choices, and options that make no sense together, before any work."""
    for option, given, choices in (
        ("--rule", rule, (*RULES, BAYES)),
        ("--window", window, WINDOWS),
        ("--odometry", odometry, (None, *METHODS)),
    ):
        if given not in choices:
            raise ValueError(f"{option} must be one of {', '.join(filter(None, choices))}, got {given}")
    if poses is not None and odometry is not None:
        raise ValueError("--poses and --odometry exclude each other; give one")
    if calib is not None and poses is None:
        raise ValueError("--calib belongs to --poses, which is missing")
    for path in filter(None, (poses, calib)):
        if save_poses is not None and save_poses.resolve() == path.resolve():
            raise ValueError(f"--save-poses would overwrite {path}; give another name")
    if half_life is not None and not half_life > 0:
        raise ValueError(f"--half-life must be greater than 0 s, got {half_life}; inf forgets nothing")


def _check_outputs(
    out_path: Path | None, picture: Path | None, film: Path | None, poses: Path | None
) -> None:
    """See that every output can be written, before hours of work."""
    wanted = {
        "--out": (out_path, (".npz",)),
        "--picture": (picture, (".png",)),
        "--save-poses": (poses, (".csv", ".txt", ".tum")),
    }
    if film is not None:
        from ogm.cli.movie import check_movie

        check_movie(film)
        wanted["--movie"] = film, (film.suffix.lower(),)
    seen: dict[Path, str] = {}
    for option, (path, endings) in wanted.items():
        if path is None:
            continue
        if path.suffix.lower() not in endings:
            raise ValueError(f"{option} writes {' or '.join(endings)}, got {path}")
        if path.is_dir():
            raise ValueError(f"{option} {path} is a folder; give a file name")
        if not path.parent.is_dir():
            raise FileNotFoundError(
                f"there is no folder {path.parent} for {option} {path.name}; create it first"
            )
        other = seen.setdefault(path.resolve(), option)
        if other != option:
            raise ValueError(f"{other} and {option} would both write {path}; give two names")
        try:
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            raise OSError(f"{option} cannot write into {path.parent}: {one_line(error)}") from error


def _height(drive: "Drive", given: float | None) -> float:
    """Return the sensor's height above ground [m]: as told, as recorded, or estimated."""
    from ogm.cli.drive import estimated_height

    if drive.mount is not None:
        if given is not None:
            raise ValueError("the data set knows its sensor's height; leave out --sensor-height")
        return float(drive.mount[2, 3])
    if given is not None:
        return given
    height, count = estimated_height(drive)
    said = "the first scan" if count == 1 else f"the first scans (median of {count})"
    out.print(f"sensor height {height:.2f} m, estimated from {said}; --sensor-height sets it", soft_wrap=True)
    return height


def _route(
    drive: "Drive", poses: Path | None, calib: Path | None, odometry: str | None, rate: float, axes: "Axes"
) -> "Route":
    """Return where and when every scan was taken, from wherever the options say."""
    from ogm.cli.route import estimate_trajectory, matched, to_flu
    from ogm.io import read_calibration, read_poses

    if odometry is not None:
        return estimate_trajectory(drive, odometry, rate, _ticked)
    if drive.poses is not None:
        if poses is not None:
            raise ValueError(
                "the data set knows its poses; leave out --poses (or estimate some with --odometry)"
            )
        return matched(drive, drive.poses, "the data set", rate, _ticked)
    if poses is None:
        raise ValueError(
            "where were the scans taken? Give --poses FILE (KITTI, KITTI-360, TUM), or estimate the poses with "
            "--odometry kiss-icp"
        )
    try:
        read = read_poses(poses, T_camera_sensor=None if calib is None else read_calibration(calib))
    except ValueError as error:
        if calib is None and "T_camera_sensor" in str(error):
            raise ValueError(f"{error} (on the command line: --calib calib.txt)") from error
        raise
    return matched(drive, to_flu(read, axes), poses.name, rate, _ticked)


def _ticked(numbers: "Iterable[int]", what: str) -> "Iterable[int]":
    return track(list(numbers), what, console=stderr, transient=True)


def _window(kind: str, spec: "GridSpec", route: "Route") -> "GridSpec":
    """Return the cells of the map: of a rolling window, or of one that holds the grids of all scans."""
    from ogm.grid import GridSpec

    if kind == "rolling":
        return rolling(spec)
    step, reach = spec.resolution, math.hypot(spec.length, spec.width) / 2
    if not route.known.any():
        raise ValueError(
            "none of the scans has a pose, so a fixed window has no area; see how poses are matched above"
        )
    xy = route.poses[route.known][:, :2, 3]
    low = [math.floor((one - reach) / step) for one in xy.min(axis=0)]
    high = [math.ceil((one + reach) / step) for one in xy.max(axis=0)]
    nx, ny = (b - a for a, b in zip(low, high, strict=True))
    if nx * ny > MOST_CELLS:
        raise ValueError(
            f"--window fixed would need {nx} x {ny} cells for a drive over {nx * step:.0f} m x {ny * step:.0f} m, at "
            f"most {MOST_CELLS} are allowed; use --window rolling, or a coarser --resolution"
        )
    return GridSpec(step, (nx, ny), (low[0] * step, low[1] * step))

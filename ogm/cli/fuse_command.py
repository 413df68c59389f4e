"""``ogm fuse``: the scans of a drive to one map that remembers and forgets."""

import math
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.progress import track

from ogm.cli.console import one_line, out, print_facts, report_errors, stderr
from ogm.cli.options import IntensityMax, TimeUnit, parsed_axes

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.fusion import FusionStep, Mapper
    from ogm.grid import EvidentialGrid, GridSpec
    from ogm.movie import Movie
    from ogm.plot import Panel
    from ogm.scan import Frame

ENDINGS = {"--out": (".npz",), "--picture": (".png",), "--save-poses": (".csv", ".txt", ".tum")}

ScanPaths = Annotated[
    list[Path], typer.Argument(help="Scans, a folder of them, or a data set with drives.", metavar="SCANS")
]
PosesFile = Annotated[
    Path | None, typer.Option(help="Poses of the sensor: KITTI, KITTI-360 or TUM (.txt), or what --save-poses wrote.")
]
Calibration = Annotated[Path | None, typer.Option(help="KITTI's calib.txt, where the poses are those of its camera.")]
Odometry = Annotated[str | None, typer.Option(help="Estimate the poses from the scans: kiss-icp or small-gicp.")]
SavePoses = Annotated[
    Path | None, typer.Option(help="Write the poses of the scans that were mapped (.csv, or .txt for TUM).")
]
Rate = Annotated[float, typer.Option(help="Scans per second [Hz], where neither scans nor poses have stamps.")]
SequenceName = Annotated[
    str | None, typer.Option(help="Which drive of a data set: its name or number. [default: the first]")
]
First = Annotated[int | None, typer.Option(help="Map the first so many scans only. [default: all]")]
Model = Annotated[str, typer.Option(help="Sensor model: ray, height-band, lite, or weights that `ogm train` wrote.")]
AxesName = Annotated[
    str, typer.Option(help="Axes of the files: flu (x forward, y left), kitti, nuscenes, ..., or +y,-x,+z.")
]
Height = Annotated[
    float | None, typer.Option(help="Sensor above ground [m]; by default stated by the data, or estimated.")
]
Position = Annotated[
    tuple[float, float, float] | None,
    typer.Option(help="x y z of the sensor [m], for points in the vehicle frame.", metavar="X Y Z"),
]
Deskew = Annotated[
    bool, typer.Option("--deskew", help="Undo the ego motion during a scan, by the times of its points.")
]
Rule = Annotated[
    str,
    typer.Option(
        help="How scans are combined: cautious, dempster, yager, cumulative, pcr6, averaging, weighted, or bayes "
        "(log-odds)."
    ),
]
HalfLife = Annotated[
    float | None, typer.Option(help="Time in which belief halves [s], or inf. [default: 2; bayes: inf]")
]
WindowName = Annotated[
    str,
    typer.Option(
        help="rolling: the map follows the vehicle. fixed: it covers the whole drive (with --half-life inf all is "
        "kept)."
    ),
]
Length = Annotated[float | None, typer.Option(help="Extent of a scan's grid along x [m]. [default: about 81.92]")]
Width = Annotated[float | None, typer.Option(help="Extent of a scan's grid along y [m]. [default: about 56.32]")]
Resolution = Annotated[float, typer.Option(help="Side of a cell [m].")]
Out = Annotated[
    Path | None, typer.Option("--out", help="Map (.npz); its folder is made if need be. [default: map.npz]")
]
Picture = Annotated[
    Path | None,
    typer.Option(help="Picture of the last scan: points, measurement, map, conflict (.png). [default: map.png]"),
]
MovieFile = Annotated[
    Path | None, typer.Option(help="Film of the drive, at its own pace: .gif, .webp or .png (animated).")
]


@report_errors
def fuse(
    scans: ScanPaths,
    poses: PosesFile = None,
    calib: Calibration = None,
    odometry: Odometry = None,
    save_poses: SavePoses = None,
    rate: Rate = 10.0,
    sequence: SequenceName = None,
    first: First = None,
    ism: Model = "ray",
    axes: AxesName = "flu",
    sensor_height: Height = None,
    sensor_position: Position = None,
    intensity_max: IntensityMax = None,
    time_unit: TimeUnit = None,
    deskew: Deskew = False,
    rule: Rule = "cautious",
    half_life: HalfLife = None,
    window: WindowName = "rolling",
    length: Length = None,
    width: Width = None,
    resolution: Resolution = 0.16,
    out_path: Out = None,
    picture: Picture = None,
    movie: MovieFile = None,
) -> None:
    """Fuse the scans of a drive into one map.

    Frames: points lie around the sensor (x forward, y left), measurement grids around the levelled sensor. A pose takes
    its scan to the map, whose axes stay those of the poses; picture and film are along the vehicle's axes. With --axes,
    poses have the files' own axes, as the points have (not what --save-poses wrote). Poses belong to scans by frame
    number (the last number in a scan's name), else by stamp (interpolated), else by order. Data sets that know their
    poses need none.

    A scan that is damaged, has no pose, or whose pose or stamp jumps is skipped with a message, and the exit code is 2.
    After three jumps in a row the map so far is saved as NAME.before-jump-1.npz and begins anew. Ctrl-C, or an error
    half-way through the mapping, writes what there is.
    """
    from ogm.datasets import open_dataset
    from ogm.evaluation.models import model_factory
    from ogm.fusion import covering_window, make_mapper, rolling_window
    from ogm.fusion import fuse as fused
    from ogm.grid import GridSpec
    from ogm.movie import open_movie
    from ogm.scan import PerMount

    if out_path is None and picture is None and movie is None:
        out_path, picture = Path("map.npz"), Path("map.png")
    _check_poses(poses, calib, odometry, save_poses, first)
    _prepare_outputs({"--out": out_path, "--picture": picture, "--movie": movie, "--save-poses": save_poses})
    spec = GridSpec.centered(length, width, resolution)
    model = PerMount(model_factory(ism, spec))
    make_mapper(rule, spec, half_life, window)  # type: ignore[arg-type]  # refuses what is no choice, before any work
    dataset = open_dataset(
        scans,
        axes=parsed_axes(axes),
        intensity_max=intensity_max,
        time_unit=time_unit,
        sensor_height=sensor_height,
        sensor_position=sensor_position,
        split="sequences" if (scans[0] / "zarr.json").exists() else None,
    )
    dataset = _drive(dataset, sequence, sensor_height)
    if deskew and not dataset.motion_distorted:
        raise ValueError(
            "--deskew: the points of this data set are not (or not all) distorted by the ego motion; leave it out"
        )
    dataset = _posed(dataset, poses, calib, odometry, rate, first)
    known = [ref.T_map_sensor for ref in dataset.refs if ref.T_map_sensor is not None]
    cells = rolling_window(spec) if window == "rolling" else covering_window(spec, np.array(known))
    mapper = make_mapper(rule, cells, half_life, window)  # type: ignore[arg-type]

    run = _Run(dataset, mapper, spec, (Path(ism).stem, rule), out_path or picture or movie or Path("map.npz"))
    times = (dataset.trajectory or True) if deskew else False
    steps = fused(dataset, model, mapper, deskew=times, on_error=run.report)
    titles = ("points by height", *run.titles)
    with open_movie(movie, spec, titles, run.ground_z) if movie else nullcontext() as film:
        code = run.map_all(steps, film)
        if run.last is None:
            raise (typer.Exit(code) if code == 130 else ValueError("no scan could be mapped; nothing is written"))
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


def _check_poses(
    poses: Path | None, calib: Path | None, odometry: str | None, save_poses: Path | None, first: int | None
) -> None:
    """Refuse options of poses that exclude each other."""
    if poses is not None and odometry is not None:
        raise ValueError("--poses and --odometry exclude each other; give one")
    if calib is not None and poses is None:
        raise ValueError("--calib belongs to --poses, which is missing")
    if first is not None and first < 1:
        raise ValueError(f"--first must be at least 1, got {first}")
    for path in filter(None, (poses, calib)):
        if save_poses is not None and save_poses.resolve() == path.resolve():
            raise ValueError(f"--save-poses would overwrite {path}; give another name")


def _prepare_outputs(wanted: dict[str, Path | None]) -> None:
    """Make the folders of all outputs, and see that they can be written, before hours of work."""
    from ogm.movie import check_movie

    used: dict[Path, str] = {}
    for option, path in wanted.items():
        if path is None:
            continue
        if option == "--movie":
            check_movie(path)
        elif path.suffix.lower() not in ENDINGS[option]:
            raise ValueError(f"{option} writes {' or '.join(ENDINGS[option])}, got {path}")
        if path.is_dir():
            raise ValueError(f"{option} {path} is a folder; give a file name")
        other = used.setdefault(path.resolve(), option)
        if other != option:
            raise ValueError(f"{other} and {option} would both write {path}; give two names")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        except OSError as error:
            raise OSError(f"{option} cannot write into {path.parent}: {one_line(error)}") from error


def _drive(dataset: "Dataset", sequence: str | None, sensor_height: float | None) -> "Dataset":
    """Return one drive of a data set, and print the height of its sensor."""
    drives = dataset.sequences
    if drives:
        named = (sequence, f"sequence {sequence}") if sequence is not None else (next(iter(drives)),)
        name = next((one for one in named if one in drives), None)
        if name is None and sequence is not None and sequence.isdecimal() and int(sequence) < len(drives):
            name = list(drives)[int(sequence)]
        if name is None:
            raise ValueError(f"--sequence must be one of {', '.join(drives)}, got {sequence}")
        if sequence is None and len(drives) > 1:
            out.print(f"drive: {name}, the first of {len(drives)}; --sequence picks another", markup=False)
        dataset = dataset.select(drives[name])
    elif sequence is not None:
        raise ValueError(f"--sequence picks one of several drives, of which {dataset.name} has none")
    height, layout = dataset[0].mount.sensor_height, dataset.reader.layout
    if sensor_height is None and layout.mount is None:
        how = "stated by the data set" if layout.sensor_height else "estimated from up to five scans"
        out.print(f"sensor height {height:.2f} m, {how}; --sensor-height sets it", soft_wrap=True)
    return dataset


def _posed(
    dataset: "Dataset", poses: Path | None, calib: Path | None, odometry: str | None, rate: float, first: int | None
) -> "Dataset":
    """Return the first scans of a drive with their poses: its own, those of a file, or estimated ones."""
    from ogm.datasets import with_odometry, with_poses

    def ticked(numbers: Iterable[int]) -> Iterable[int]:
        return track(list(numbers), odometry or "reading stamps", console=stderr, transient=True)

    if odometry is not None:
        dataset = with_odometry(dataset[:first], odometry, rate, ticked)
    elif poses is not None:
        dataset = with_poses(dataset, poses, calib, rate, ticked)
    known = sum(ref.T_map_sensor is not None for ref in dataset.refs)
    if not known:
        raise ValueError(
            "where were the scans taken? Give --poses FILE (KITTI, KITTI-360, TUM), or estimate the poses with "
            "--odometry kiss-icp"
        )
    how = dataset.facts.get("poses") or f"{known} of {len(dataset)} scans, of the data set"
    out.print(f"poses: {how}", markup=False, soft_wrap=True)
    return dataset[:first]


@dataclass
class _Run:
    """What has been mapped so far."""

    dataset: "Dataset"
    mapper: "Mapper"
    spec: "GridSpec"  # of picture and film, around the vehicle
    names: tuple[str, str]  # of sensor model and rule
    base: Path  # the main output: maps before a restart are saved beside it
    last: "FusionStep | None" = None
    taken: list[int] = field(default_factory=list)  # numbers of the frames that were mapped
    failed: int = 0
    restarts: int = 0
    path: float = 0.0  # [m]
    speed: float = math.nan  # [m/s]
    seconds: list[tuple[float, float]] = field(default_factory=list)  # of model and mapper

    @property
    def ground_z(self) -> float:
        """Height of the ground in the frame of the points [m]."""
        mount = self.dataset[0].mount
        return -mount.sensor_height if mount.points_in == "sensor" else mount.ground_point[2]

    @property
    def titles(self) -> tuple[str, str, str]:
        """Titles of measurement, map and conflict."""
        from ogm.fusion import EvidentialMapper

        model, rule = self.names
        half_life = self.mapper.half_life
        first = half_life if isinstance(half_life, float) else half_life[0]
        fading = "" if math.isinf(first) else f", half-life {first:g} s"
        other = "conflict" if isinstance(self.mapper, EvidentialMapper) else "map, probability"
        return f"measurement ({model})", f"map ({rule}{fading})", other

    def map_all(self, steps: "Iterator[FusionStep]", film: "Movie | None") -> int:
        """Map all scans; return the exit code: 0, 2 after skipped scans or an error, 130 after Ctrl-C."""
        steps = track(steps, "mapping", len(self.dataset), console=stderr, transient=True)  # type: ignore
        try:
            for k, step in enumerate(steps):
                if step.grid is None:
                    continue
                self.note(k, step)
                if film is not None:
                    panels, line = self.panels()
                    film.add(step.frame.scan.points, panels, line, float(step.frame.stamp or 0.0))
        except KeyboardInterrupt:
            stderr.print(f"ogm: interrupted after {len(self.taken)} scans; what there is gets written")
            return 130
        except Exception as error:  # whatever it is, the map so far must not be lost
            stderr.print(
                f"ogm: {one_line(error)}: stopped after {len(self.taken)} scans; what there is gets written",
                markup=False,
            )
            return 2
        return 2 if self.failed else 0

    def report(self, frame: "Frame", error: Exception) -> None:
        """Print why a scan is skipped."""
        self.failed += 1
        stderr.print(f"ogm: {frame.name} is skipped: {one_line(error)}", markup=False)

    def note(self, k: int, step: "FusionStep") -> None:
        """Take down what was mapped, and save the map that a restart would lose."""
        self.speed = math.nan
        if step.previous_map is not None:
            self.restarts += 1
            path = self.base.with_name(f"{self.base.stem}.before-jump-{self.restarts}.npz")
            step.previous_map.save(path)
            stderr.print(
                f"ogm: {step.frame.name}: {step.restart}, the third in a row: the map so far is saved as {path}, a new "
                "one begins here",
                markup=False,
            )
        elif self.last is not None:
            here, before = step.frame, self.last.frame
            metres = math.dist(here.T_map_sensor[:2, 3], before.T_map_sensor[:2, 3])  # type: ignore[index]
            seconds = (here.stamp or 0.0) - (before.stamp or 0.0)
            self.path += metres
            self.speed = metres / seconds if seconds > 0 else math.nan
        self.taken.append(k)
        self.seconds.append(step.seconds)
        self.last = step

    def panels(self) -> "tuple[tuple[Panel, Panel, Panel], str]":
        """Draw the last measurement, the map around the vehicle and its conflict; return also the line above them."""
        from ogm import plot
        from ogm.fusion import EvidentialMapper

        assert self.last is not None
        assert self.last.grid is not None
        view = self.mapper.view(self.spec)
        first, second, third = self.titles
        if isinstance(self.mapper, EvidentialMapper):
            other = plot.conflict_panel(self.mapper.conflict_view(self.spec), third)
        else:
            other = plot.probability_panel(view, third)
        speed = "" if math.isnan(self.speed) else f"{3.6 * self.speed:.0f} km/h"
        total, k = str(len(self.dataset)), self.taken[-1]
        line = (
            f"{k + 1:{len(total)}} of {total}   {_shortened(self.last.frame.name)}   {self.elapsed:.1f} s   "
            f"{speed:>8}   map: {_shares(view)}"
        )
        return (plot.mass_panel(self.last.grid, first), plot.mass_panel(view, second), other), line

    @property
    def elapsed(self) -> float:
        """Time from the first to the last scan that was mapped [s]."""
        first, last = (self.dataset.refs[k].stamp for k in (self.taken[0], self.taken[-1]))
        return (last or 0.0) - (first or 0.0)

    def save_picture(self, path: Path) -> None:
        """Draw the last scan and the map around it."""
        from ogm import plot

        assert self.last is not None
        title = f"{_shortened(self.last.frame.name)}, {self.elapsed:.1f} s"
        cloud = plot.points_panel(self.last.frame.scan.points, self.spec, title, self.ground_z)
        plot.save_picture(path, cloud, *self.panels()[0])

    def save_poses(self, path: Path) -> None:
        """Write the poses of the scans that were mapped."""
        from ogm.datasets import frame_numbers
        from ogm.io import write_poses
        from ogm.pose import Trajectory

        refs = self.dataset.refs
        stamps, first = np.unique([refs[k].stamp for k in self.taken], return_index=True)
        rows = np.array(self.taken)[first]
        numbers = frame_numbers([ref.name for ref in refs])
        wanted = numbers[rows] if numbers is not None and path.suffix.lower() == ".csv" else None
        write_poses(path, Trajectory(stamps, np.array([refs[k].T_map_sensor for k in rows])), wanted)

    def facts(self) -> dict[str, str]:
        """Return what was done, in words."""
        model, mapper = (1e3 * median(one) for one in zip(*self.seconds, strict=True))
        spec = self.mapper.spec
        facts = {
            "scans": f"{len(self.taken)} mapped, {self.failed} skipped",
            "time": f"{self.elapsed:.1f} s",
            "path": f"{self.path:.1f} m",
            self.names[0]: f"{model:.1f} ms/scan",
            "mapper": f"{mapper:.1f} ms/scan",
            "map": f"{spec.shape[0]} x {spec.shape[1]} cells of {spec.resolution:g} m: {_shares(self.mapper.grid)}",
        }
        if self.restarts:
            facts["restarts"] = f"{self.restarts}, after jumps of the pose"
        return facts


def _shares(grid: "EvidentialGrid") -> str:
    """Return the mean masses of a grid in words."""
    parts = (("free", grid.free), ("occupied", grid.occupied), ("unknown", grid.unknown))
    return ", ".join(f"{name} {100 * float(mass.mean()):4.1f} %" for name, mass in parts)


def _shortened(name: str, width: int = 28) -> str:
    """Return a name of at most `width` characters; names of one drive differ at their end."""
    return name if len(name) <= width else f"...{name[3 - width :]}"

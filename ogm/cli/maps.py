"""``ogm demo`` and ``ogm map``: scans to evidential grids."""

import math
import statistics
import time
from importlib.resources import as_file, files
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import track
from rich.table import Table
from rich.text import Text

from ogm.cli.console import one_line, out, report_errors, stderr
from ogm.cli.options import IntensityMax, TimeUnit, parsed_axes

if TYPE_CHECKING:
    from ogm.grid import EvidentialGrid, GridSpec
    from ogm.scan import InverseSensorModel, Mount, Scan

# The shipped scan: Velodyne's raw frame has y forward, x right; height [m] from its own ground returns.
DEMO_AXES, DEMO_HEIGHT = ("+y", "-x", "+z"), 1.98


ENDINGS = (".bin", ".pcd", ".ply", ".las", ".laz", ".npy", ".feather")  # of scans
RAY, HEIGHT_BAND, RELEASED, LITE = "ray", "height-band", "height-band-released", "lite"


def sensor_model(name: str, spec: "GridSpec", mount: "Mount") -> "InverseSensorModel":
    """Return a sensor model by its name on the command line, or by the path of its weights.

    Parameters
    ----------
    name : str
    spec : GridSpec
        The cells to fill.
    mount : Mount

    Raises
    ------
    ValueError
        If there is no such model, or it cannot fill the grid.
    """
    from ogm.geometric import HeightBandISM, RayISM

    if name == RELEASED:
        from ogm.grid import GridSpec

        if mount.origin.any() or spec.shape[0] % 2 or spec.shape[1] % 2:
            raise ValueError(
                "height-band-released wants points in the sensor's frame and an even number of cells"
            )
        return HeightBandISM.as_released(
            GridSpec(2 * spec.resolution, (spec.shape[0] // 2, spec.shape[1] // 2), spec.origin)
        )
    if name == RAY:
        return RayISM(spec, mount)
    if name == HEIGHT_BAND:
        return HeightBandISM(spec, mount)
    if name != LITE and not Path(name).exists():
        raise ValueError(
            f"there is no sensor model {name!r}: give {RAY}, {HEIGHT_BAND}, {RELEASED}, {LITE}, or weights that "
            "`ogm train` wrote (a file or a run's folder)"
        )
    from ogm.deep import DeepISM

    return DeepISM.load(name, spec=spec, mount=mount)


def _table(title: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="", box=None, pad_edge=False)
    for name in ("", "points", "free", "occupied", "unknown", "ms/scan"):
        table.add_column(name, justify="left" if name == "" else "right")
    return table


def _row(table: Table, name: str, count: int, grid: "EvidentialGrid", seconds: float) -> None:
    shares = (f"{100 * float(share.mean()):.1f} %" for share in (grid.free, grid.occupied, grid.unknown))
    table.add_row(Text(name.encode("utf-8", "replace").decode()), f"{count}", *shares, f"{1e3 * seconds:.1f}")


def _timed(ism: "InverseSensorModel", scan: "Scan", repeats: int = 1) -> tuple["EvidentialGrid", float]:
    """Map a scan and say how long it took: the median of some repeats."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        grid = ism(scan)
        seconds.append(time.perf_counter() - start)
    return grid, statistics.median(seconds)


@report_errors
def demo(
    out_folder: Annotated[
        Path, typer.Option("--out", help="Folder for ogm-demo.png and ogm-demo.npz.")
    ] = Path("."),
) -> None:
    """Map the shipped road scan (Velodyne VLS-128) and draw it: points, two geometric models, the learned one."""
    from ogm import Mount, plot, read_scan
    from ogm.grid import GridSpec

    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        scan = read_scan(path, axes=DEMO_AXES)
    spec = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
    table = _table(f"One scan on {spec.shape[0]} x {spec.shape[1]} cells of {spec.resolution} m")
    grids = {}
    models = {HEIGHT_BAND: "height band (paper's baseline)", RAY: "RayISM"}
    if find_spec("torch") and find_spec("safetensors"):
        models[LITE] = "deep (lite)"
    else:
        stderr.print('the learned model is left out: `pip install "ogm-toolkit[deep]"` adds it', markup=False)
    for name, title in models.items():
        ism = sensor_model(name, spec, Mount(DEMO_HEIGHT))
        with out.status("compiling kernels (once per environment) ..."):
            ism(scan)
        grids[title], seconds = _timed(ism, scan, repeats=9)
        _row(table, name, len(scan.points), grids[title], seconds)
    cloud = plot.points_panel(scan.points, spec, f"{len(scan.points)} points", -DEMO_HEIGHT)
    out_folder.mkdir(parents=True, exist_ok=True)
    picture, archive = out_folder / "ogm-demo.png", out_folder / "ogm-demo.npz"
    plot.save_picture(picture, cloud, *grids.values(), titles=["", *grids])
    grids["RayISM"].save(archive)
    out.print(table)
    out.print(f"picture {picture}   grid {archive}", markup=False)


@report_errors
def map_(
    scans: Annotated[
        list[Path], typer.Argument(help="Scans: .pcd .bin .pcd.bin .ply .las .laz .npy .feather (.xz, .gz)")
    ],
    ism: Annotated[
        str,
        typer.Option(
            help="Sensor model: ray, height-band, height-band-released, lite, or weights that `ogm train` wrote."
        ),
    ] = RAY,
    axes: Annotated[
        str,
        typer.Option(help="Axes of the file: flu (x forward, y left), kitti, nuscenes, ..., or +y,-x,+z."),
    ] = "flu",
    sensor_height: Annotated[
        float | None, typer.Option(help="Sensor above ground [m]; by default estimated from the scan.")
    ] = None,
    sensor_position: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="x y z of the sensor [m], for points that come in the vehicle's frame.", metavar="X Y Z"
        ),
    ] = None,
    intensity_max: IntensityMax = None,
    time_unit: TimeUnit = None,
    out_path: Annotated[
        Path | None,
        typer.Option("--out", help="Grid file (.npz), or a folder. [default: ./NAME.npz]"),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture (.png), or a folder. [default: ./NAME.png]")
    ] = None,
    length: Annotated[float, typer.Option(help="Extent of the grid along x [m].")] = 81.92,
    width: Annotated[float, typer.Option(help="Extent of the grid along y [m].")] = 56.32,
    resolution: Annotated[float, typer.Option(help="Side of a cell [m].")] = 0.16,
) -> None:
    """Map scans to evidential grids, one each, and draw them."""
    from ogm import plot, read_scan
    from ogm.grid import GridSpec

    spec = GridSpec.centered(length=length, width=width, resolution=resolution)
    names = [stem(path) for path in scans]
    if len(set(names)) < len(names):
        raise ValueError("two scans share a name, and so would their outputs; map them one after the other")
    if ism == RELEASED and sensor_height is not None:
        raise ValueError("height-band-released has a mount of 1.61 m built in; leave out --sensor-height")
    if out_path is None and picture is None:
        out_path, picture = Path(), Path()
    grids = _outputs(out_path, names, ".npz", "--out")
    pictures = _outputs(picture, names, ".png", "--picture")
    table, failed = _table(f"{spec.shape[0]} x {spec.shape[1]} cells of {spec.resolution} m, {ism}"), []
    warm, last = False, math.nan
    for path, name, grid_path, picture_path in track(
        list(zip(scans, names, grids, pictures, strict=True)),
        "mapping",
        console=stderr,
        disable=len(scans) == 1,
        transient=True,
    ):
        try:
            scan = read_scan(path, axes=parsed_axes(axes), intensity_max=intensity_max, time_unit=time_unit)
            height = 1.61 if ism == RELEASED else _height(scan.points, sensor_height, sensor_position)
            if height != last:
                model = sensor_model(ism, spec, _mount(height, sensor_position))
                last = height
            if not warm:
                model(scan)  # compiles, or loads what was compiled before
                warm = True
            grid, seconds = _timed(model, scan)
            if grid_path is not None:
                grid.save(grid_path)
            if picture_path is not None:
                cloud = plot.points_panel(scan.points, grid.spec, path.name)
                plot.save_picture(picture_path, cloud, grid, titles=["", ism])
            _row(table, name, len(scan.points), grid, seconds)
        except (ValueError, TypeError, OSError) as error:
            if len(scans) == 1:
                raise
            failed.append(f"{path}: {one_line(error)}")
    if table.row_count:
        out.print(table, markup=False)
    for line in failed:
        stderr.print(f"ogm: {line}", markup=False)
    if failed:
        raise typer.Exit(2)


def _outputs(path: Path | None, names: list[str], suffix: str, option: str) -> list[Path | None]:
    """Say where each output goes: into a folder, made if need be, or, of a single scan, to a file."""
    if path is None:
        return [None] * len(names)
    if path.suffix.lower() == suffix and not path.is_dir():
        if len(names) > 1:
            raise ValueError(f"{option} {path} is one file for {len(names)} scans; give a folder")
        return [path]
    if path.suffix and not path.is_dir():
        raise ValueError(
            f"{option} writes {suffix} files, got {path}; give a name that ends in {suffix}, or a folder"
        )
    path.mkdir(parents=True, exist_ok=True)
    return [path / f"{name}{suffix}" for name in names]


def _height(points: object, given: float | None, position: tuple[float, float, float] | None) -> float:
    """Return the sensor's height above ground: as told, or from the scan's own ground returns."""
    from ogm.io import estimate_sensor_height

    if given is not None:
        return given
    below = estimate_sensor_height(points)  # type: ignore[arg-type]
    if below is None:
        raise ValueError(
            "the scan shows too little ground to tell the sensor's height; give --sensor-height [m]"
        )
    height = below + (position[2] if position else 0.0)
    stderr.print(f"sensor height {height:.2f} m, estimated from the scan (--sensor-height sets it)")
    return height


def _mount(height: float, position: tuple[float, float, float] | None) -> "Mount":
    """Return how a sensor is mounted whose points come in the vehicle frame, if its position is given."""
    from ogm.pose import pose
    from ogm.scan import Mount

    return Mount(height) if position is None else Mount(height, pose(*position), points_in="vehicle")


def stem(path: Path) -> str:
    """Return a scan's name without the endings that say its format."""
    name = path.name
    if name in ENDINGS:
        return name
    for ending in (".xz", ".gz", *ENDINGS):
        name = name.removesuffix(ending)
    return name

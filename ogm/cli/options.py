"""Options of several commands."""

from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Option


def parsed_axes(text: str) -> str | tuple[str, ...]:
    """Return the name of axes, or three axes separated by commas as a tuple."""
    return tuple(text.split(",")) if "," in text else text


def check_first(first: int | None) -> None:
    """Raise a ValueError for a number of scans below 1."""
    if first is not None and first < 1:
        raise ValueError(f"--first must be at least 1, got {first}")


File = Path | None
Axes = Annotated[
    Any, Option(parser=parsed_axes, metavar="<str>", help="Axes: flu (x forward, y left), kitti, ..., or +y,-x,+z.")
]
FolderAxes = Annotated[str, Option(help="Axes of a folder of scans: flu, kitti, nuscenes, ..., or +y,-x,+z.")]
TruthSources = Annotated[
    str | None,
    Option(help="Sources of truth: boxes, classes, map, aggregated. [default: all]", metavar="SOURCE[,SOURCE]..."),
]
Kerbs = Annotated[
    Literal["ignore", "occupied", "unknown", "free"],
    Option(help="State of obstacles up to 0.15 m in the truth of simulated data; ignore leaves them out."),
]
IntensityMax = Annotated[float | None, Option(help="Intensity that is scaled to 1. [default: by the format]")]
TimeUnit = Annotated[float | None, Option(help="Unit of time [s]. [default: 1e-9 for whole numbers, else 1]")]
Length = Annotated[float | None, Option(help="Extent of a scan's grid along x [m]. [default: about 81.92]")]
Width = Annotated[float | None, Option(help="Extent of a scan's grid along y [m]. [default: about 56.32]")]
Resolution = Annotated[float, Option(help="Side of a cell [m].")]
Topic = Annotated[
    list[str] | None,
    Option(help="Topic of a lidar in a log; may be repeated. [default: the only topic with scans]", metavar="TOPIC"),
]
Sensor = Annotated[
    list[str] | None,
    Option(
        "--sensor",
        help="Sensor of a simulated dataset with radars: lidar, radar, or the name of a radar; may be repeated. "
        "[default: lidar]",
        metavar="SENSOR",
    ),
]
FixedFrame = Annotated[str | None, Option("--frame", help="Fixed frame of a log. [default: map, odom, world, root]")]
First = Annotated[int | None, Option(help="Use the first N scans only. [default: all]", metavar="N")]
InscribedRadius = Annotated[float, Option(help="Radius of the largest circle within the footprint [m].")]
CostScaling = Annotated[float, Option(help="Decrease of costs with distance, cost_scaling_factor of nav2 [1/m].")]
Workers = Annotated[int, Option(help="Number of processes on this machine.", min=1)]
Scheduler = Annotated[str | None, Option(help="Use a Dask cluster instead: tcp://host:port.")]

"""Options that several commands take."""

from pathlib import Path
from typing import Annotated, Any

from typer import Option


def parsed_axes(text: str) -> str | tuple[str, ...]:
    """Return the name of some axes, or the three that were given."""
    return tuple(text.split(",")) if "," in text else text


def check_first(first: int | None) -> None:
    """Refuse a number of scans below 1."""
    if first is not None and first < 1:
        raise ValueError(f"--first must be at least 1, got {first}")


File = Path | None
Axes = Annotated[
    Any,
    Option(
        parser=parsed_axes,
        metavar="<str>",
        help="Axes of the files: flu (x forward, y left), kitti, nuscenes, ..., or +y,-x,+z.",
    ),
]
FolderAxes = Annotated[str, Option(help="Axes of a folder of scans: flu, kitti, nuscenes, ..., or +y,-x,+z.")]
TruthSources = Annotated[
    str | None,
    Option(
        help="What the truth of a recording is made from, with commas between: boxes, classes, map, aggregated. "
        "[default: all there is]",
        metavar="WHAT[,WHAT]...",
    ),
]
IntensityMax = Annotated[float | None, Option(help="The file's intensity that means 1; by default the format's.")]
TimeUnit = Annotated[float | None, Option(help="Unit of time [s]. [default: 1e-9 of whole numbers, else 1]")]
Length = Annotated[float | None, Option(help="Extent of a scan's grid along x [m]. [default: about 81.92]")]
Width = Annotated[float | None, Option(help="Extent of a scan's grid along y [m]. [default: about 56.32]")]
Resolution = Annotated[float, Option(help="Side of a cell [m].")]
Topic = Annotated[
    list[str] | None,
    Option(help="Of a log: topic of a lidar; may be repeated. [default: the only one]", metavar="TOPIC"),
]
Sensor = Annotated[
    list[str] | None,
    Option(
        "--sensor",
        help="Of a simulated data set with radars: lidar, radar, or the name of a radar; may be repeated. "
        "[default: lidar]",
        metavar="SENSOR",
    ),
]
FixedFrame = Annotated[str | None, Option("--frame", help="Of a log: fixed frame. [default: map, odom, world, root]")]
First = Annotated[int | None, Option(help="Use the first N scans only. [default: all]", metavar="N")]
InscribedRadius = Annotated[float, Option(help="Radius of the greatest circle in the footprint [m].")]
CostScaling = Annotated[float, Option(help="Decrease of costs with distance, cost_scaling_factor of nav2 [1/m].")]
Workers = Annotated[int, Option(help="Processes of this machine.", min=1)]
Scheduler = Annotated[str | None, Option(help="Use a Dask cluster instead: tcp://host:port.")]

"""Options that several commands take."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ogm.grid import EvidentialGrid


def parsed_axes(text: str) -> str | tuple[str, ...]:
    """Return the name of some axes, or the three that were given."""
    return tuple(text.split(",")) if "," in text else text


def check_first(first: int | None) -> None:
    """Refuse a number of scans below 1."""
    if first is not None and first < 1:
        raise ValueError(f"--first must be at least 1, got {first}")


def cost_function(
    inflation_radius: float | None, inscribed_radius: float | None, cost_scaling: float | None, unknown: str | None
) -> "Callable[[EvidentialGrid], NDArray[np.uint8]] | None":
    """Return the function that makes the costs of a map by the options of costs, or None where there are none."""
    numbers = {"inscribed_radius": inscribed_radius, "cost_scaling": cost_scaling, "unknown": unknown}
    given: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
    if inflation_radius is None:
        if given:
            raise ValueError("costs need --inflation-radius [m]: obstacles cost nothing beyond it")
        return None
    from ogm.planning import costmap

    return partial(costmap, **{"inscribed_radius": 0.0, "inflation_radius": inflation_radius, **given})


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
InflationRadius = Annotated[
    float | None,
    Option(help="Add a layer cost, as nav2's inflation layer has it: distance up to which obstacles cost [m].", min=0),
]
InscribedRadius = Annotated[
    float | None, Option(help="Of costs: radius of the greatest circle in the footprint [m]. [default: 0]", min=0)
]
CostScaling = Annotated[float | None, Option(help="Of costs: cost_scaling_factor of nav2 [1/m]. [default: 10]", min=0)]
CostUnknown = Annotated[
    str | None,
    Option(
        "--cost-unknown",
        help="Of costs: unknown cells are unknown, inflated, obstacle or free. [default: unknown]",
        metavar="WHAT",
    ),
]
Workers = Annotated[int, Option(help="Processes of this machine.", min=1)]
Scheduler = Annotated[str | None, Option(help="Use a Dask cluster instead: tcp://host:port.")]

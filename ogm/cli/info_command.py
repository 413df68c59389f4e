"""``ogm info``: print the contents of a file or folder."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from ogm.cli.console import print_facts, report_errors
from ogm.cli.options import FixedFrame, IntensityMax, TimeUnit, parsed_axes


@report_errors
def info(
    path: Annotated[Path, Argument(help="Any file or folder that ogm reads or writes.", metavar="PATH")],
    axes: Annotated[str, Option(help="Axes of the file: flu, kitti, nuscenes, ..., or +y,-x,+z.")] = "flu",
    intensity_max: IntensityMax = None,
    time_unit: TimeUnit = None,
    fixed_frame: FixedFrame = None,
) -> None:
    """Print the contents of a file or folder: scan, dataset, log (also missing data), grid, map, model or report."""
    from ogm.workflows import describe_path

    print_facts(
        describe_path(path, axes=parsed_axes(axes), intensity_max=intensity_max, time_unit=time_unit, frame=fixed_frame)
    )

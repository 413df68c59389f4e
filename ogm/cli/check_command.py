"""``ogm check``: problems of a log that would spoil its map, with their remedies."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import out, report_errors, ticked
from ogm.cli.sensor_options import SensorOptions, sensor_options


@report_errors
@sensor_options
def check(
    log: Annotated[Path, Argument(help="Log (.mcap .db3 .bag), capture, or folder of scans.", metavar="LOG")],
    write: Annotated[
        Path | None, Option(help="Write the estimated sensor setup (.yaml), for --sensors.", metavar="FILE")
    ] = None,
    topic: options.Topic = None,
    fixed_frame: options.FixedFrame = None,
    axes: options.Axes = "flu",
    sensors: SensorOptions = SensorOptions(),  # noqa: B008  it is immutable
    intensity_max: options.IntensityMax = None,
    time_unit: options.TimeUnit = None,
) -> None:
    """List problems that would spoil a map, the worst first, each with the option or command that fixes it.

    All scans are read once. The exit code is 2 if a problem makes the map wrong. --write saves height, tilt, ego
    footprint and greatest range in a file for the option --sensors of `ogm map`, `fuse`, `serve`, `evaluate` and
    `world build`.
    """
    from ogm.datasets import write_setups
    from ogm.workflows import check_log

    if write is not None and write.suffix not in (".yaml", ".yml"):
        raise ValueError(f"--write must end in .yaml, got {write}")
    reading = {"axes": axes, "frame": fixed_frame, "intensity_max": intensity_max, "time_unit": time_unit}
    checks = check_log(
        log, topic=topic or (), progress=lambda numbers: ticked(numbers, "reading"), **reading, **sensors._asdict()
    )
    for drive in checks:
        if len(checks) > 1:
            out.print(drive.name, markup=False)
        for finding in drive.findings:
            way = f"\n{'':11}-> {finding.remedy}" if finding.remedy else ""
            line = f"{finding.severity:9}  {finding.kind}: {finding.text}{way}"
            out.print(line, markup=False, soft_wrap=True)
    if write is not None:
        write_setups(write, [drive.setup for drive in checks])
        out.print(f"written {write}", markup=False, soft_wrap=True)
    if any(finding.severity == "wrong map" for drive in checks for finding in drive.findings):
        raise typer.Exit(2)

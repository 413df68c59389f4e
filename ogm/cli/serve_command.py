"""``ogm serve``: map a drive in real time, or scans from a socket, and serve the map to Foxglove and others."""

import logging
import socket
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import chosen_model, complain, first_call, out, report_errors
from ogm.cli.drive import check_pose_options, pick_drive, print_sensor, with_known_poses
from ogm.cli.fuse_command import Calibration, Drive, HalfLife, Odometry, Poses, Rule, UsualModel
from ogm.cli.sensor_options import SensorOptions, sensor_options
from ogm.evidence.map_rules import REVISE
from ogm.extras import import_extra
from ogm.storage.files import error_text

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.scan import Frame

SCAN_RATE = 10.0  # [Hz] rate of scans without stamps

ScanPaths = Annotated[list[Path] | None, Argument(help="Scan files, a folder, a dataset, or a log.", metavar="SCANS")]
Listen = Annotated[str | None, Option(help="Receive scans and poses by TCP; see docs/live.md.", metavar="[HOST:]PORT")]
Rate = Annotated[float | None, Option(help="Speed of playback: 2 plays twice as fast. [default: 1]")]
Duration = Annotated[float | None, Option(help="Stop after this time [s]. [default: at the end, or Ctrl-C]")]
Port = Annotated[int, Option(help="Port of the Foxglove WebSocket; 0 takes any free port.")]
Host = Annotated[str, Option(help="Address of the server; any other than loopback exposes the map to the network.")]
InflationRadius = Annotated[
    float | None, Option(help="Add the field cost to /map: distance beyond which obstacles cost nothing [m].")
]
Layers = Annotated[str | None, Option(help="Further layer to serve: cause, the causes of unknown cells, as /cause.")]
Every = Annotated[float, Option(help="Interval between printed counts and latencies [s].")]


@report_errors
@sensor_options
def serve(
    scans: ScanPaths = None,
    listen: Listen = None,
    rate: Rate = None,
    duration: Duration = None,
    host: Host = "127.0.0.1",
    port: Port = 8765,
    report_every: Every = 5.0,
    poses: Poses = None,
    calib: Calibration = None,
    odometry: Odometry = None,
    sequence: Drive = None,
    topic: options.Topic = None,
    fixed_frame: options.FixedFrame = None,
    first: options.First = None,
    ism: UsualModel = None,
    axes: options.Axes = "flu",
    sensors: SensorOptions = SensorOptions(),  # noqa: B008  it is immutable
    intensity_max: options.IntensityMax = None,
    time_unit: options.TimeUnit = None,
    rule: Rule = None,
    half_life: HalfLife = None,
    inflation_radius: InflationRadius = None,
    inscribed_radius: options.InscribedRadius = 0.0,
    cost_scaling: options.CostScaling = 10.0,
    layers: Layers = None,
    length: options.Length = None,
    width: options.Width = None,
    resolution: options.Resolution = 0.16,
) -> None:
    """Map a drive while it plays, and show the map live.

    Viewers with a Foxglove WebSocket (Foxglove, Lichtblick) connect to the printed address. Topics are the map with
    all its masses (/map), the scans (/points) and the poses (/tf). The map never falls behind: if mapping is slower
    than the scans, the newest scan is mapped next, and the scans between are dropped and counted. Latency is the time
    from the arrival of a scan to the transfer of its map to the server. Ctrl-C stops.

    --listen receives scans with poses from a driver instead of a recording, in the sensor's frame, and needs
    --sensor-height.
    """
    from ogm.datasets import open_dataset
    from ogm.datasets.sensor_setup import setup_of, within_limits
    from ogm.fusion import EvidentialMapper, make_mapper, rolling_window
    from ogm.fusion.factory import adding_rule_warning
    from ogm.grid import GridSpec
    from ogm.live import FoxglovePublisher, receive_frames, warm_up
    from ogm.live import serve as served
    from ogm.models.layers import ExplainedISM
    from ogm.models.named import describe_model, load_model, with_radar
    from ogm.planning import costmap
    from ogm.plot.panels import CAUSE_LAYER
    from ogm.scan import Mount
    from ogm.workflows.checks import gravest

    if (scans is None) == (listen is None):
        raise ValueError("give either SCANS to play, or --listen to receive scans of a driver")
    import_extra("foxglove", "live")  # before kernels are compiled
    if inflation_radius is None and (inscribed_radius, cost_scaling) != (0.0, 10.0):
        raise ValueError("--inscribed-radius and --cost-scaling need --inflation-radius [m]: give it, too")
    costs = None
    if inflation_radius is not None:
        costs = partial(
            costmap, inscribed_radius=inscribed_radius, inflation_radius=inflation_radius, cost_scaling=cost_scaling
        )
    spec, stop = GridSpec.centered(length, width, resolution), Event()
    ism = chosen_model(ism, spec, rule or "")
    model = load_model(with_radar(ism), spec)
    mapper = make_mapper(rule or REVISE, rolling_window(spec), half_life)
    if layers is not None:
        if layers != CAUSE_LAYER or not isinstance(mapper, EvidentialMapper):
            raise ValueError(f"--layers takes cause, for evidential maps, got {layers} with --rule {rule or REVISE}")
        model = ExplainedISM(model)
    if warning := adding_rule_warning(rule or REVISE):
        _print(warning)
    frames: Iterable[Frame]
    with ExitStack() as stack:
        if scans is not None:
            check_pose_options(poses, calib, odometry, None, first)
            reading = {"axes": axes, "intensity_max": intensity_max, "time_unit": time_unit}
            placed = sensors._asdict()
            log = {"topic": topic or (), "frame": fixed_frame}
            dataset = open_dataset(scans, **reading, **placed, **log, default_split="sequences")  # type: ignore[arg-type]
            dataset = with_known_poses(pick_drive(dataset, sequence), poses, calib, odometry, SCAN_RATE, first)
            print_sensor(dataset)
            for finding in gravest(dataset, ism):
                _print(finding)
            frames, example, speed = dataset, _example(dataset), 1.0 if rate is None else rate
        else:
            setup, height = setup_of(sensors.setups, ""), sensors.sensor_height
            if (height := setup.sensor_height if height is None else height) is None or rate is not None:
                raise ValueError("--listen needs --sensor-height [m], and excludes --rate")
            listener = stack.enter_context(_listener(str(listen)))
            mount = Mount(height, ego_footprint=setup.ego_footprint)  # type: ignore[arg-type]
            frames = within_limits(receive_frames(listener, mount, stop=stop, on_end=_print), setup)
            example, speed = None, None
            _print("receiving scans at {}:{}".format(*listener.getsockname()))
        if isinstance(ism, str) and ism.endswith(".json"):
            _print(describe_model(ism)[0])
        with first_call():
            warm_up(model, mapper, example)
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # a disconnected viewer is no error
        publisher = stack.enter_context(FoxglovePublisher(host, port, costs=costs))
        beside = "" if layers is None else ", /cause, /cause_legend"
        out.print(f"serving /map{beside}, /points and /tf at {publisher.url}; Ctrl-C stops")
        report = served(
            frames,
            model,
            mapper,
            publisher,
            rate=speed,
            duration=duration,
            stop=stop,
            on_error=lambda frame, error: _print(f"{frame.name} is skipped: {error_text(error)}"),
            on_report=_print,
            report_every=report_every,
        )
    out.print(str(report), soft_wrap=True)
    if report.failed:
        raise typer.Exit(2)


def _example(dataset: "Dataset") -> "Frame | None":
    """Return a readable frame with a pose, to compile the kernels with; None if the first five have none."""
    for n in [n for n, ref in enumerate(dataset.refs) if ref.T_map_sensor is not None][:5]:
        frame = dataset[n]
        with suppress(ValueError, TypeError, OSError):
            if len(frame.scan) and frame.mount:
                return frame
    return None


def _print(line: object) -> None:
    """Print a line about the run to stderr."""
    complain(str(line))


def _listener(place: str) -> socket.socket:
    """Return a socket listening at ``[HOST:]PORT``."""
    host, _, port = place.rpartition(":")
    if not port.isdecimal() or int(port) >= 2**16:
        raise ValueError(f"--listen must be PORT or HOST:PORT, from 0 (any free port) to 65535, got {place}")
    try:
        return socket.create_server((host or "127.0.0.1", int(port)))
    except OSError as error:
        raise OSError(f"--listen cannot listen at {place}: {error_text(error)}") from error

"""Sensor options of `ogm map`, `fuse`, `serve`, `evaluate` and `world build`."""

import functools
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Option

if TYPE_CHECKING:
    from ogm.datasets import SensorSetup

_OPTIONS: dict[str, Any] = {  # name: type with its option
    "sensors_file": Annotated[
        Path | None,
        Option("--sensors", help="Sensor setup of the vehicle, from `ogm check --write` (.yaml).", metavar="FILE"),
    ],
    "sensor_height": Annotated[float | None, Option(help="Height above ground [m]. [default: stated, or estimated]")],
    "sensor_position": Annotated[
        tuple[float, float, float] | None,
        Option(help="Position x y z of the sensor [m], for points in the vehicle frame.", metavar="X Y Z"),
    ],
    "origin": Annotated[
        tuple[float, float, float] | None,
        Option(
            help="Position x y z of the sensor, for files in map coordinates (UTM) [m]. Poses in the same coordinates "
            "replace it.",
            metavar="X Y Z",
        ),
    ],
    "ego_footprint": Annotated[
        tuple[float, float, float, float] | None,
        Option(
            help="Rectangle of the ego vehicle around its sensor, or with several sensors in base_link [m]: returns in "
            "it are dropped; 0 0 0 0 keeps all. [default: -2.5 2.5 -1.1 1.1]",
            metavar="X_MIN X_MAX Y_MIN Y_MAX",
        ),
    ],
    "min_range": Annotated[float | None, Option(help="Drop points nearer than this range [m].")],
    "max_range": Annotated[float | None, Option(help="Drop points beyond this range [m].")],
    "max_range_no_echo": Annotated[
        bool | None,
        Option("--max-range-no-echo", help="Treat points at or beyond --max-range as no echo.", show_default=False),
    ],
    "leave_out": Annotated[
        list[str] | None,
        Option(
            help="Leave out a sector of view, FROM:TO to the left of x [deg]; may be repeated: --leave-out=150:210.",
            metavar="FROM:TO",
        ),
    ],
    "depth_scale": Annotated[
        float | None,
        Option(help="Pixel value of depth images at 1 m: 1000 for millimetres, 5000 for TUM, 1 for metres."),
    ],
}


class SensorOptions(NamedTuple):
    """Values of the sensor options."""

    sensor_height: float | None = None
    sensor_position: tuple[float, float, float] | None = None
    origin: tuple[float, float, float] | None = None
    setups: "tuple[SensorSetup, ...]" = ()


def sensor_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the sensor options to a command in place of its parameter `sensors`, which receives their values."""
    signature = inspect.signature(command)
    parameters: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        names = _OPTIONS if parameter.name == "sensors" else {}
        parameters += [parameter.replace(name=name, annotation=kind, default=None) for name, kind in names.items()]
        parameters += [] if names else [parameter]

    @functools.wraps(command)
    def run(**arguments: Any) -> None:
        given = {name: arguments.pop(name) for name in _OPTIONS}
        command(**arguments, sensors=_parsed(**given))

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # typer reads it
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters} | {"return": None}
    return run


def _parsed(
    sensors_file: Path | None,
    sensor_height: float | None,
    sensor_position: tuple[float, float, float] | None,
    origin: tuple[float, float, float] | None,
    leave_out: list[str] | None,
    **limits: Any,
) -> SensorOptions:
    from ogm.datasets import SensorSetup, read_setups
    from ogm.datasets.sensor_setup import merged

    sectors = tuple(_sector(text) for text in leave_out or ()) or None
    setups = (SensorSetup(),) if sensors_file is None else read_setups(sensors_file)
    return SensorOptions(sensor_height, sensor_position, origin, merged(setups, leave_out=sectors, **limits))


def _sector(text: str) -> tuple[float, float]:
    start, _, end = text.partition(":")
    try:
        return math.radians(float(start)), math.radians(float(end))
    except ValueError:
        raise ValueError(f"--leave-out must be FROM:TO [deg], such as 150:210, got {text!r}") from None

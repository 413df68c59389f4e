"""Sensor models by name: geometric ones, also fitted, the network that ogm ships, both combined, own weights, radar.

>>> from ogm import GridSpec, Mount
>>> from ogm.models.named import MODELS, load_model
>>> "combined" in MODELS
True
>>> load_model("ray", GridSpec.centered(), Mount(sensor_height=1.8)).spec.shape
(512, 352)
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ogm.grid import GridSpec
from ogm.models.combined import CombinedISM, FreeGate, StateReliability
from ogm.models.fitted import Calibration, model_class
from ogm.models.radar import DEEP_RADAR, RADAR, RADAR_MODELS, radar_factory
from ogm.scan import InverseSensorModel, Mount, PerMount

__all__ = [
    "COMBINATION", "COMBINED", "HEIGHT_BAND", "LITE", "MODELS", "RADAR", "RAY", "RELEASED", "NamedModels",
    "default_model", "describe_model", "load_model", "model_factory",
    "sensor_models", "short_names",
]  # fmt: skip

Factory = Callable[[Mount], InverseSensorModel]
GEOMETRIC = RAY, HEIGHT_BAND, RELEASED = "ray", "height-band", "height-band-released"
LITE = "lite"
COMBINED = "combined"
COMBINATION: dict[str, Any] = {  # of `ray` and `lite`, fitted to simulated validation towns, see docs/deep.md
    "reliability": (StateReliability(free=1.0, occupied=0.5), StateReliability(free=0.79, occupied=1.0)),
    "free_gates": (FreeGate(share=0.0, low=0.63, high=0.65), FreeGate(share=0.75, low=0.0, high=0.23)),
}
MODELS = {  # name: description
    RAY: "Rays and local ground (RayISM).",
    HEIGHT_BAND: "The paper's geometric model as its text describes it (HeightBandISM).",
    RELEASED: "The paper's geometric model as its released code has it: 0.32 m cells, evidence 1 at most, mounted "
    "at 1.61 m.",
    LITE: "The network that ogm ships (DeepISM), trained on simulated scans.",
    COMBINED: "ray and lite, combined cell by cell (CombinedISM).",
    **RADAR_MODELS,
}


NETWORK_CELL, NETWORK_MULTIPLE = 0.16, 16  # [m] side of the cells of `lite`, and what the sides of its grids divide by


def default_model(spec: GridSpec) -> tuple[str, str]:
    """Return the name of the model to use where none is given, and why it is not `combined`.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill.

    Returns
    -------
    name : str
        ``"combined"``, or ``"ray"`` where the network cannot run.
    reason : str
        What `combined` lacks; empty if nothing.
    """
    if find_spec("onnxruntime") is None:
        return RAY, 'without the learned model, which `pip install "ogm-toolkit[deep]"` adds'
    if spec.resolution != NETWORK_CELL or any(n % NETWORK_MULTIPLE for n in spec.shape):
        need = f"cells of {NETWORK_CELL:g} m, their number along x and y a multiple of {NETWORK_MULTIPLE}"
        return RAY, f"the learned model needs {need}"
    return COMBINED, ""


def load_model(name: str, spec: GridSpec, mount: Mount, *, drop_ego_returns: bool = False) -> InverseSensorModel:
    """Return a sensor model by its name, for one mount.

    Parameters
    ----------
    name : str
        A name in `MODELS`, the path of parameters that ``ogm calibrate`` wrote (``.json``), or that of weights that
        ``ogm train`` or ``ogm export`` wrote: a ``.safetensors`` file, a run's folder, or an ``.onnx`` file.
    spec : GridSpec
        The grid to fill. ``height-band-released`` fills cells of twice the side, on the same area.
    mount : Mount
        Where the sensor is mounted. ``height-band-released`` has its own height built in.
    drop_ego_returns : bool
        Of ``height-band``: ignore returns from the ego footprint, as all other models but the released one do.

    Raises
    ------
    ValueError
        If there is no such model, or it cannot fill the grid.
    FileNotFoundError
        If there are no such weights.
    """
    return model_factory(name, spec, drop_ego_returns=drop_ego_returns)(mount)


def model_factory(name: str, spec: GridSpec, *, drop_ego_returns: bool = False) -> Factory:
    """Return a function ``mount -> model`` for `ogm.scan.PerMount`; weights are read once.

    Parameters and errors as of `load_model`; what depends on the mount is checked when the function is called.
    """
    if name == RELEASED:
        return _released(spec)
    if name in RADAR_MODELS:
        of_radar = radar_factory(name, spec)
        return lambda mount: of_radar(mount, "")
    if name == COMBINED:
        makers = [model_factory(part, spec) for part in (RAY, LITE)]
        return lambda mount: CombinedISM([make(mount) for make in makers], **COMBINATION)
    if name in GEOMETRIC or _is_fitted(name):
        parameters: dict[str, Any] = {}
        if _is_fitted(name):
            fitted = Calibration.load(name)
            name, parameters = fitted.model, dict(fitted.parameters)
        if name == HEIGHT_BAND:
            parameters["drop_ego_returns"] = drop_ego_returns
        return lambda mount: model_class(name)(spec, mount, **parameters)
    if name != LITE and not Path(name).exists() and Path(name).suffix not in (".safetensors", ".onnx"):
        raise ValueError(
            f"there is no sensor model {name!r}: give {', '.join(MODELS)}, parameters that `ogm calibrate` wrote "
            "(.json), weights that `ogm train` wrote (a file or a run's folder), or what `ogm export` wrote (.onnx)"
        )
    from ogm.deep import DeepISM
    from ogm.deep.engines import load_engine

    engine = load_engine(name)
    return lambda mount: DeepISM(engine, spec, mount)


@dataclass(frozen=True)
class NamedModels:
    """A function that makes `sensor_models`, for other processes: it is pickled as the name and the grid.

    Parameters
    ----------
    name : str
    spec : GridSpec
    """

    name: str
    spec: GridSpec

    def __call__(self) -> PerMount:
        """Return the models, which are ready for any mount."""
        return sensor_models(self.name, self.spec)


def sensor_models(name: str, spec: GridSpec, *, drop_ego_returns: bool = False) -> PerMount:
    """Return models for every mount, of lidars and of radars.

    Parameters
    ----------
    name : str
        A name of `load_model` for lidars, and perhaps ``+`` and a model of radars, as in ``ray+radar``. By default
        ``radar`` is that of scans with `Scan.rcs`. ``radar`` or ``deep-radar`` alone take all scans for a radar's.
    spec, drop_ego_returns
        As of `load_model`.

    Raises
    ------
    ValueError, FileNotFoundError
        As of `load_model`.
    """
    lidar, _, radar = name.partition("+")
    of_radar = radar_factory(lidar if lidar in RADAR_MODELS and not radar else radar or RADAR, spec)
    again = partial(sensor_models, name, spec, drop_ego_returns=drop_ego_returns)
    if lidar in RADAR_MODELS:
        return _Named(lambda mount: of_radar(mount, ""), of_radar, again)
    return _Named(model_factory(lidar, spec, drop_ego_returns=drop_ego_returns), of_radar, again)


class _Named(PerMount):
    """What `sensor_models` returns: it is pickled as the call that made it."""

    def __init__(self, factory: Factory, radar: Callable[[Mount, str], InverseSensorModel], again: Any) -> None:
        super().__init__(factory, radar)
        self._again = again

    def __reduce__(self) -> tuple[Any, ...]:
        return self._again, ()


def _is_fitted(name: str) -> bool:
    return Path(name).suffix == ".json"


def _released(spec: GridSpec) -> Factory:
    """Return the factory of the released model: one model for all mounts."""
    from ogm.geometric import HeightBandISM

    nx, ny = spec.shape
    if nx % 2 or ny % 2:
        raise ValueError(f"{RELEASED} needs an even number of cells along x and y, got {nx} x {ny}")
    model = HeightBandISM.as_released(GridSpec(2 * spec.resolution, (nx // 2, ny // 2), spec.origin))

    def for_mount(mount: Mount) -> InverseSensorModel:
        if mount.points_in == "vehicle" or mount.origin[:2].any():
            raise ValueError(f"{RELEASED} needs points in the sensor frame and a grid around the sensor")
        return model

    return for_mount


def describe_model(name: str) -> tuple[str, dict[str, str] | None]:
    """Return one sentence about a model by its name, and file name and SHA-256 of what it was read from, if it was."""
    if "+" in name:
        several = [describe_model(part) for part in name.split("+")]
        return " ".join(one for one, _ in several), several[0][1]
    if name in (*GEOMETRIC, RADAR):
        return MODELS[name], None
    if name == DEEP_RADAR:
        data = (files("ogm") / "data" / "radar.onnx").read_bytes()
        return MODELS[name], {"file": "radar.onnx", "sha256": hashlib.sha256(data).hexdigest()}
    if _is_fitted(name):
        one, path = Calibration.load(name), Path(name)
        numbers = ", ".join(f"{key} {value:g}" for key, value in one.parameters.items())
        facts = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        return f"{MODELS[one.model].rstrip('.')}, with {numbers or 'its defaults'}.", facts
    from ogm.deep.engines import weights_of

    with weights_of(LITE if name == COMBINED else name) as path:
        facts = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return MODELS.get(name, "A network (DeepISM) by its weights."), facts


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return a short name for every model: weights go by their run or their file where that is unique.

    Returns
    -------
    dict of str to str
        Short name to the name or path that was given, in the same order.

    Raises
    ------
    ValueError
        If a model is given twice.
    """
    result: dict[str, str] = {}
    for name in names:
        path = Path(name)
        short = path.name.removesuffix(".safetensors")
        short = path.parent.name or short if short == "best" else short
        if name in MODELS or "+" in name or short in result:
            short = name
        if short in result:
            raise ValueError(f"{name} is given twice; give each model once")
        result[short] = name
    return result

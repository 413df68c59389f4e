"""Sensor models by name: geometric, fitted, the shipped network, combined, trained weights, radar.

>>> from ogm import GridSpec, Mount
>>> from ogm.models.named import MODELS, load_model
>>> "combined" in MODELS
True
>>> load_model("ray", GridSpec.centered(), Mount(sensor_height=1.8)).spec.shape
(512, 352)
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.evidence.map_rules import DYNAMIC, NUSS
from ogm.extras import install_line
from ogm.grid import EvidentialGrid, GridSpec
from ogm.models.bounded import BoundedISM
from ogm.models.combined import CombinedISM, FreeGate, StateReliability
from ogm.models.depth import depth_model
from ogm.models.fitted import Calibration, model_class
from ogm.models.radar import RADAR, RadarBySensor
from ogm.pose import tilt_of
from ogm.scan import InverseSensorModel, Mount, Scan, as_scan
from ogm.storage.files import OgmError

GEOMETRIC = RAY, HEIGHT_BAND, PLANAR, DEPTH, RELEASED = "ray", "height-band", "planar", "depth", "height-band-released"
LITE = "lite"
COMBINED = "combined"
COMBINATION: dict[str, Any] = {  # for `ray` and `lite`, fitted to simulated validation towns, see docs/deep.md
    "reliability": (StateReliability(free=1.0, occupied=0.8), StateReliability(free=0.79, occupied=1.0)),
    "free_gates": (FreeGate(share=0.0, low=0.63, high=0.65), FreeGate(share=0.75, low=0.0, high=0.23)),
}
MODELS = {  # name: description
    RAY: "Rays and local ground (RayISM).",
    HEIGHT_BAND: "The paper's geometric model as described in its text (HeightBandISM).",
    PLANAR: "Beams of a planar laser or a sonar (PlanarISM): free only in their plane.",
    DEPTH: "Rays of a depth camera (RayISM): obstacles may be hidden between rays.",
    RELEASED: "The paper's geometric model as in its released code: 0.32 m cells, evidence up to 1, mounted at 1.61 m.",
    LITE: "The shipped network (DeepISM), trained on simulated scans.",
    COMBINED: "ray and lite, combined cell by cell (CombinedISM).",
    RADAR: "Detections of a radar: occupied ellipses, free sectors (RadarISM).",
}


_MAX_TILT = math.radians(3)  # tilt of a sensor that the released code may neglect
NETWORK_CELL, NETWORK_MULTIPLE = 0.16, 16  # [m] side of cells of `lite`; its grids have multiples of 16 cells


def default_model(spec: GridSpec, rule: str = "") -> tuple[str, str]:
    """Return the name of the default model, and the reason if `combined` cannot run.

    Parameters
    ----------
    spec : GridSpec
        Cells of the grids.
    rule : str
        Rule of the map, see `ogm.fusion.make_mapper`.

    Returns
    -------
    name : str
        ``"combined"``, or ``"ray"`` if the network cannot run, and for dynamic maps: edges in grids of the network vary
        from scan to scan, which resembles motion (docs/dynamic.md). For scans of other kinds see `for_all_kinds`.
    reason : str
        Reason why `combined` cannot run; else empty.
    """
    if rule in (DYNAMIC, NUSS):
        return RAY, ""
    if find_spec("onnxruntime") is None:
        return RAY, f"without the learned model, which `{install_line('deep')}` installs"
    if spec.resolution != NETWORK_CELL or any(n % NETWORK_MULTIPLE for n in spec.shape):
        need = f"cells of {NETWORK_CELL:g} m, their number along x and y a multiple of {NETWORK_MULTIPLE}"
        return RAY, f"the learned model needs {need}"
    return COMBINED, ""


def load_model(
    name: str, spec: GridSpec, mount: Mount | None = None, *, drop_ego_returns: bool = False, device: Any = "cpu"
) -> InverseSensorModel:
    """Return a sensor model by name.

    The model is picklable for other processes.

    Parameters
    ----------
    name : str
        A name in `MODELS`; the path of parameters of ``ogm calibrate`` (``.json``); or the path of weights of
        ``ogm train`` or ``ogm export``: a ``.safetensors`` file, a run's folder, or an ``.onnx`` file. Names joined by
        ``+``, such as ``ray+planar+depth``, are for sensors of several kinds: see `ModelsByKind`.
    spec : GridSpec
        Cells of the grids. ``height-band-released`` has cells of twice the side on the same area.
    mount : Mount, optional
        Mount of the sensor; by default `Scan.mount`. ``height-band-released`` has a fixed height.
    drop_ego_returns : bool
        Whether ``height-band`` ignores returns from the ego footprint, as all other models except the released do.
    device : str or torch.device
        Device of the network for lidars, ``"cpu"``, or ``"cuda"`` with torch.

    Raises
    ------
    ValueError
        If the name is unknown, the model cannot fill the grid, or it has no network for `device`.
    FileNotFoundError
        If the weights do not exist.
    """
    if "+" in name:
        first, *others = name.split("+")
        beside = {_kind_of(part): load_model(part, spec, mount) for part in others}
        return ModelsByKind(load_model(first, spec, mount, drop_ego_returns=drop_ego_returns, device=device), beside)
    if not _is_fitted(name):
        return _load(name, {}, spec, mount, drop_ego_returns, device)
    fitted = Calibration.load(name)
    model = _load(fitted.model, dict(fitted.parameters), spec, mount, drop_ego_returns, device)
    if fitted.guarantee is None:
        return model
    now = (describe_model(fitted.model)[1] or {}).get("sha256", "")
    if now != fitted.guarantee.sha256:
        raise OgmError(
            f"{name} holds for {fitted.model} with weights of SHA-256 {fitted.guarantee.sha256[:12]}, got {now[:12]}: "
            "repeat `ogm calibrate --guarantee`"
        )
    return BoundedISM(model, fitted.guarantee, fitted.model)


def _load(
    name: str, parameters: dict[str, Any], spec: GridSpec, mount: Mount | None, drop_ego_returns: bool, device: Any
) -> InverseSensorModel:
    """Return a model that is no calibration; only geometric models with parameters take `parameters`."""
    if str(device) != "cpu" and name in (*GEOMETRIC, RADAR):
        raise ValueError(f"{name} runs on the CPU only, got device={str(device)!r}: leave device out or load a network")
    if name == RADAR:
        return RadarBySensor(spec, mount)
    if name == RELEASED:
        return ReleasedISM(spec, mount)
    if name == DEPTH:
        return depth_model(spec, mount)
    if name == COMBINED:
        from ogm.deep.runtimes import default_threads
        from ogm.geometric import RayISM

        rays = RayISM(spec, mount, threads=min(default_threads(), 2))
        return CombinedISM([rays, load_model(LITE, spec, mount, device=device)], **COMBINATION)
    if name in GEOMETRIC:
        if name == HEIGHT_BAND:
            parameters["drop_ego_returns"] = drop_ego_returns
        model: InverseSensorModel = model_class(name)(spec, mount, **parameters)
        return model
    if name != LITE and not Path(name).exists() and Path(name).suffix not in (".safetensors", ".onnx"):
        raise ValueError(
            f"there is no sensor model {name!r}: give {', '.join(MODELS)}, parameters of `ogm calibrate` (.json), "
            "weights of `ogm train` (a file or a run's folder) or of `ogm export` (.onnx)"
        )
    from ogm.deep import DeepISM
    from ogm.deep.engines import load_engine

    return DeepISM(load_engine(name, device=device), spec, mount)


def with_radar(name: str) -> str:
    """Return the name of a model for all sensors of a vehicle, with ``+radar`` added to a lidar's model."""
    return name if RADAR in name.split("+") else f"{name}+{RADAR}"


def for_all_kinds(name: str) -> str:
    """Return the name of a model with the models of planar lasers, sonars and depth cameras added."""
    return f"{name}+{PLANAR}+{DEPTH}"


def part_for(name: str, scan: Scan) -> str:
    """Return the part of a model's name that maps a scan, such as ``"planar"`` in ``"ray+planar"``."""
    first, *others = name.split("+")
    return {_kind_of(part): part for part in others}.get(_kind(scan), first)


def title_of(name: str, scan: Scan, mount: Mount) -> str:
    """Return the title of a grid: the model of the scan, and for a planar model the height of its free cells.

    Parameters
    ----------
    name : str
        Name of the model.
    scan : Scan
    mount : Mount
    """
    from ogm.geometric import plane_text

    part = part_for(name, scan)
    return ", ".join(filter(None, (part, plane_text(scan, mount) if part == PLANAR else "")))


def _kind_of(name: str) -> str:
    """Return the kind of scans of an additional model."""
    if name not in (PLANAR, DEPTH, RADAR):
        raise ValueError(f"a model after + must be one of {PLANAR}, {DEPTH}, {RADAR}, got {name!r}")
    return name


def _kind(scan: Scan) -> str:
    return RADAR if scan.rcs is not None else PLANAR if scan.kind == "cone" else scan.kind


@dataclass(frozen=True, eq=False)
class ModelsByKind:
    """Sensor models of a vehicle with sensors of several kinds.

    Parameters
    ----------
    first : InverseSensorModel
        Model of all scans without a model in `others`.
    others : dict of str to InverseSensorModel
        Models by kind: ``"radar"`` for scans with `Scan.rcs`, ``"planar"`` for planar lasers and sonars, ``"depth"``.
    """

    first: InverseSensorModel
    others: Mapping[str, InverseSensorModel]

    @property
    def spec(self) -> GridSpec:
        """Cells of the first model's grids."""
        return self.first.spec

    def part(self, scan: Scan) -> InverseSensorModel:
        """Return the model for the kind of a scan."""
        return self.others.get(_kind(scan), self.first)

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Return the grid of a scan, by the model for its kind."""
        scan = as_scan(scan)
        return self.part(scan)(scan)


class ReleasedISM:
    """The paper's geometric model as in its released code, see `HeightBandISM.as_released`.

    Parameters
    ----------
    spec : GridSpec
        Cells with half the side of the model's cells, on the same area.
    mount : Mount, optional
        Only its position is used: the sensor must be at the origin of the points.

    Raises
    ------
    ValueError
        If a number of cells is odd, or points or grid are not around the sensor.
    """

    def __init__(self, spec: GridSpec, mount: Mount | None = None) -> None:
        from ogm.geometric import HeightBandISM

        nx, ny = spec.shape
        if nx % 2 or ny % 2:
            raise ValueError(f"{RELEASED} needs an even number of cells along x and y, got {nx} x {ny}")
        self.model = HeightBandISM.as_released(GridSpec(2 * spec.resolution, (nx // 2, ny // 2), spec.origin))
        self.mount = mount
        self._check(mount)

    @property
    def spec(self) -> GridSpec:
        """Cells of the model's grids."""
        return self.model.spec

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Return the grid of a scan."""
        scan = as_scan(scan)
        self._check(self.mount or scan.mount)
        return self.model(scan)

    def _check(self, mount: Mount | None) -> None:
        if mount is None:
            return
        if mount.points_in == "vehicle" or mount.origin[:2].any() or tilt_of(mount.T_vehicle_sensor) > _MAX_TILT:
            raise ValueError(f"{RELEASED} needs points in the frame of a level sensor and a grid around the sensor")


def _is_fitted(name: str) -> bool:
    return Path(name).suffix == ".json"


def describe_model(name: str) -> tuple[str, dict[str, str] | None]:
    """Return a one-sentence description of a named model, and file name and SHA-256 of its file, else None."""
    if "+" in name:
        parts = [describe_model(part) for part in name.split("+")]
        return " ".join(description for description, _ in parts), parts[0][1]
    if name in (*GEOMETRIC, RADAR):
        return MODELS[name], None
    if _is_fitted(name):
        fitted, path = Calibration.load(name), Path(name)
        numbers = ", ".join(f"{key} {value:g}" for key, value in fitted.parameters.items())
        facts = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        text = f"{describe_model(fitted.model)[0].rstrip('.')}, with {numbers or 'its defaults'}"
        return f"{text}{f'; {fitted.guarantee}' if fitted.guarantee else ''}.", facts
    from ogm.deep.engines import weights_of

    with weights_of(LITE if name == COMBINED else name) as path:
        facts = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return MODELS.get(name, "A network (DeepISM) by its weights."), facts


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return a short name for every model: for weights the name of their run or file, if it is unique.

    Returns
    -------
    dict of str to str
        Given name or path by short name, in the given order.

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

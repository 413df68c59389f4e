"""Sensor models by name: the geometric ones, the network that ogm ships, and weights that ``ogm train`` wrote."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from ogm.grid import GridSpec
from ogm.scan import InverseSensorModel, Mount

__all__ = ["LITE", "MODELS", "RELEASED", "describe_model", "load_model", "model_factory", "short_names"]

Factory = Callable[[Mount], InverseSensorModel]
GEOMETRIC = RAY, HEIGHT_BAND, RELEASED = "ray", "height-band", "height-band-released"
LITE = "lite"
MODELS = {  # name: description
    RAY: "Rays and local ground (RayISM).",
    HEIGHT_BAND: "The paper's geometric model as its text describes it (HeightBandISM).",
    RELEASED: "The paper's geometric model as its released code has it: 0.32 m cells, evidence 1 at most, mounted "
    "at 1.61 m.",
    LITE: "The network that ogm ships (DeepISM), trained on simulated scans.",
}


def load_model(name: str, spec: GridSpec, mount: Mount, *, drop_ego_returns: bool = False) -> InverseSensorModel:
    """Return a sensor model by its name, for one mount.

    Parameters
    ----------
    name : str
        A name in `MODELS`, or the path of weights that ``ogm train`` wrote: a ``.safetensors`` file or a run's folder.
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
    if name in GEOMETRIC:
        from ogm.geometric import HeightBandISM, RayISM

        if name == RELEASED:
            return _released(spec)
        if name == RAY:
            return lambda mount: RayISM(spec, mount)
        return lambda mount: HeightBandISM(spec, mount, drop_ego_returns=drop_ego_returns)
    if name != LITE and not Path(name).exists() and Path(name).suffix != ".safetensors":
        raise ValueError(
            f"there is no sensor model {name!r}: give {', '.join(MODELS)}, or weights that `ogm train` wrote (a file "
            "or a run's folder)"
        )
    from ogm.deep.checkpoint import load_network
    from ogm.deep.ism import DeepISM, weights_of

    with weights_of(name) as path:
        network, description = load_network(path)
    return lambda mount: DeepISM(network, spec, mount, description=description)


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
    """Return one sentence about a model by its name, and file name and SHA-256 of its weights, if it has some."""
    if name in GEOMETRIC:
        return MODELS[name], None
    from ogm.deep.ism import weights_of

    with weights_of(name) as path:
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
        if name in MODELS or short in result:
            short = name
        if short in result:
            raise ValueError(f"{name} is given twice; give each model once")
        result[short] = name
    return result

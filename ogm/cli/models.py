"""Sensor models by the names that ``ogm evaluate`` has for them, each made for however a sample's sensor is mounted."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.metrics import ModelFor
from ogm.scan import InverseSensorModel, Mount

__all__ = ["GEOMETRIC", "describe_model", "models_of", "weights_facts"]

GEOMETRIC = ("height-band", "height-band-released", "ray")


def models_of(names: Sequence[str], spec: GridSpec) -> dict[str, InverseSensorModel | ModelFor]:
    """Return models by their names: those of the command line, or paths of weights.

    Parameters
    ----------
    names : sequence of str
    spec : GridSpec
        The cells to fill.

    Raises
    ------
    ValueError
        If a name is unknown or given twice.
    FileNotFoundError
        If there are no such weights.
    """
    models: dict[str, InverseSensorModel | ModelFor] = {}
    for name in names:
        path = Path(name)  # of a run, best.safetensors and so on go by the run's name
        shown = path.name.removesuffix(".safetensors")
        shown = path.parent.name if shown == "best" and path.parent.name else shown
        shown = name if name in GEOMETRIC else shown
        if shown in models:
            shown = name  # two runs have each a best.safetensors
        if shown in models:
            raise ValueError(f"{name} is given twice; give each model once")
        models[shown] = _geometric(name, spec) if name in GEOMETRIC else _deep(name, spec)
    return models


def weights_facts(name: str) -> dict[str, str] | None:
    """Return the name and the SHA-256 of the weights that a name means; None for a geometric model."""
    if name in GEOMETRIC:
        return None
    from ogm.deep.ism import weights_of

    with weights_of(name) as path:
        return {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def describe_model(name: str) -> str:
    """Say what a model is."""
    known = {
        "height-band": "The paper's geometric model as its text has it (HeightBandISM).",
        "height-band-released": "The paper's geometric model as its released code has it: 0.32 m cells, evidence 1 "
        "at most, mounted at 1.61 m.",
        "ray": "Rays and local ground (RayISM).",
        "lite": "The network that ogm ships (DeepISM), trained on simulated scans.",
    }
    return known.get(name, "A network (DeepISM) by its weights.")


def _geometric(name: str, spec: GridSpec) -> InverseSensorModel | ModelFor:
    from ogm.geometric import HeightBandISM, RayISM

    if name == "height-band-released":  # its mount is built in, its cells are twice as wide
        nx, ny = spec.shape
        return HeightBandISM.as_released(GridSpec(2 * spec.resolution, (nx // 2, ny // 2), spec.origin))
    if name == "ray":
        return lambda T: RayISM(spec, Mount(T[2, 3], T))
    return lambda T: HeightBandISM(spec, Mount(T[2, 3], T), drop_ego_returns=True)


def _deep(name: str, spec: GridSpec) -> ModelFor:
    if name.isidentifier() and not Path(name).exists() and name != "lite":
        raise ValueError(
            f"there is no model {name!r}; there are {', '.join(GEOMETRIC)}, lite, and weights by their path"
        )
    from ogm.deep.checkpoint import load_network
    from ogm.deep.ism import DeepISM, weights_of

    with weights_of(name) as path:
        network, description = load_network(path)

    def of(T: NDArray[np.float64]) -> InverseSensorModel:
        return DeepISM(network, spec, Mount(T[2, 3], T), description=description)

    return of

"""Further layers of a scan by name, such as heights and causes of unknown cells.

>>> import numpy as np
>>> from ogm import GridSpec, Mount, Scan, load_model
>>> from ogm.models.layers import map_layers
>>> x, y = np.mgrid[3:12:0.1, -4:4:0.1].reshape(2, -1)
>>> scan = Scan(np.column_stack([x, y, 0.05 * x - 1.8]).astype(np.float32))   # a road that climbs by 5 %
>>> ism = load_model("ray", GridSpec.centered(24.0, 16.0, 0.5), Mount(sensor_height=1.8))
>>> grid, layers = map_layers(ism, scan, ["ground_height"])
>>> round(float(layers["ground_height"][layers.spec.index(8.0, 1.0)]), 2)
-1.39
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.geometric import PlanarISM, RadarISM
from ogm.geometric.causes import SectorTrace, unknown_causes
from ogm.geometric.heights import HEIGHT_LAYERS, height_layers, traversability
from ogm.geometric.ray import RayISM, RayTrace
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.models.bounded import BoundedISM
from ogm.models.combined import CombinedISM
from ogm.models.named import ModelsByKind
from ogm.models.radar import RadarBySensor
from ogm.planning import costmap, distance_to_obstacles
from ogm.scan import InverseSensorModel, Scan, as_scan

LayerFunction = Callable[[Any], Mapping[str, NDArray[np.float32]]]
"""Returns layers of one scan, (nx, ny) each, from its trace; `RayTrace.grid` has the masses of the whole model."""

COST_REACH = 2.0  # [m] from the inscribed radius, up to which obstacles cause costs
COST_SCALING = 2.0  # [1/m] costs halve every 0.35 m


def planning_layers(trace: RayTrace | SectorTrace) -> dict[str, NDArray[np.float32]]:
    """Return the distance to the nearest obstacle [m], and costs for the ego footprint, NaN where unknown."""
    inscribed = min(map(abs, trace.mount.ego_footprint))
    costs = costmap(trace.grid, inscribed, inscribed + COST_REACH, COST_SCALING).astype(np.float32)
    return {"distance": distance_to_obstacles(trace.grid, "free"), "cost": np.where(costs > 254, np.nan, costs)}


def cause_layer(trace: RayTrace | SectorTrace) -> dict[str, NDArray[np.float32]]:
    """Return the layer of causes of unknown cells, codes of `ogm.UnknownCause`."""
    return {"cause": unknown_causes(trace).astype(np.float32)}


def terrain_layers(trace: RayTrace) -> dict[str, NDArray[np.float32]]:
    """Return the layers of heights, see `ogm.geometric.height_layers`, and traversability for `VehicleLimits()`."""
    layers = height_layers(trace)
    return {**layers.layers, "traversability": traversability(layers, trace.grid)}


LAYERS: Mapping[str, LayerFunction] = {
    **dict.fromkeys((*HEIGHT_LAYERS, "traversability"), terrain_layers),
    **dict.fromkeys(("distance", "cost"), planning_layers),
    "cause": cause_layer,
}
"""Function of each layer of `map_layers` by name; a function may return several layers."""


def map_layers(model: InverseSensorModel, scan: Scan, names: Sequence[str]) -> tuple[EvidentialGrid, LayeredGrid]:
    """Map one scan to masses and to named layers.

    Parameters
    ----------
    model : InverseSensorModel
        `RayISM`, or a combination with one; for the layer ``cause`` also `PlanarISM` and `RadarISM`.
    scan : Scan
    names : sequence of str
        Names in `LAYERS`.

    Returns
    -------
    grid : EvidentialGrid
        Grid of the model.
    layers : LayeredGrid
        Layers on the same cells.

    Raises
    ------
    ValueError
        If a name is unknown, or the model has no rays.
    """
    check_layers(names)
    trace = _trace(model, scan)
    if trace is None:
        name = type(model).__name__
        raise ValueError(f"layers need a model with rays (RayISM), got {name}: use the model ray or combined")
    if isinstance(trace, SectorTrace) and (of_ground := [name for name in names if LAYERS[name] is terrain_layers]):
        raise ValueError(
            f"the layer {of_ground[0]!r} needs scans with ground, got a planar laser, sonar or radar: leave it out"
        )
    made: dict[LayerFunction, Mapping[str, NDArray[np.float32]]] = {}
    for name in names:
        if LAYERS[name] not in made:
            made[LAYERS[name]] = LAYERS[name](trace)
    return trace.grid, LayeredGrid(trace.grid.spec, {name: made[LAYERS[name]][name] for name in names})


def check_layers(names: Sequence[str]) -> None:
    """Raise a ValueError if a name is not in `LAYERS`."""
    unknown = [name for name in names if name not in LAYERS]
    if unknown:
        raise ValueError(f"layers must be of {', '.join(LAYERS)}, got {unknown[0]!r}")


@dataclass(frozen=True, eq=False)
class ExplainedISM:
    """Sensor model with causes of unknown cells in its grids, `EvidentialGrid.cause`, and in maps of them.

    Parameters
    ----------
    model : InverseSensorModel
        `RayISM`, `PlanarISM`, `RadarISM`, or a combination with `RayISM`; grids of other models have no causes.

    Examples
    --------
    >>> mapper = EvidentialMapper(rolling_window(ism.spec))                 # doctest: +SKIP
    >>> for step in fuse(frames, ExplainedISM(ism), mapper):               # doctest: +SKIP
    ...     print(mapper.cause["cause"])
    """

    model: InverseSensorModel

    @property
    def spec(self) -> GridSpec:
        """Cells of the model's grids."""
        return self.model.spec

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Return the grid of a scan, with causes."""
        trace = _trace(self.model, scan := as_scan(scan))
        return self.model(scan) if trace is None else trace.grid.with_cause(unknown_causes(trace))


def _trace(model: InverseSensorModel, scan: Scan) -> RayTrace | SectorTrace | None:
    """Return the rays or beams of a scan with the masses of the whole model; None for models without rays."""
    while isinstance(model, ModelsByKind | RadarBySensor):
        model = model.part(scan)
    if isinstance(model, BoundedISM):
        traced = _trace(model.model, scan)
        return traced and traced._replace(grid=model.bounded(traced.grid))
    if isinstance(model, RayISM | PlanarISM | RadarISM):
        return model.trace(scan)
    if isinstance(model, CombinedISM):
        for k, part in enumerate(model.models):
            if isinstance(part, RayISM):
                trace = part.trace(scan)
                return trace._replace(grid=model(scan, {k: trace.mass}))
    return None

"""What ``ogm evaluate`` judges: sensor models, maps that fuse their scans over time, and grids that others made."""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ogm.cli.models import describe_model, models_of, weights_facts
from ogm.cli.source import Frame, Item, grids_in, shown_name
from ogm.fusion import BAYES, BinaryBayesMapper, EvidentialMapper, PoseJump, warp
from ogm.fusion import make_mapper as mapper_of
from ogm.fusion import rolling_window as rolling
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids import read_grid
from ogm.metrics import ModelFor, Mounted, resample_to
from ogm.scan import InverseSensorModel, Mount, as_scan

if TYPE_CHECKING:
    from ogm.fusion.resample import ResampleMethod as Resampling

__all__ = ["Map", "Methods", "SingleScanMethod", "PrecomputedGrids", "fused", "methods_of"]


class SingleScanMethod(NamedTuple):
    """A sensor model, each scan by itself."""

    model: InverseSensorModel | ModelFor
    description: str
    weights: dict[str, str] | None = None


class Map(NamedTuple):
    """A map that fuses the grids of a sensor model over time."""

    scans: str  # name of the model's method
    make: Callable[[], EvidentialMapper | BinaryBayesMapper]
    description: str


class PrecomputedGrids(NamedTuple):
    """Grids that were made elsewhere, by the names of their frames."""

    files: dict[str, Path]
    description: str


class Methods:
    """Methods at work on frame after frame; maps are begun anew with every sequence.

    Parameters
    ----------
    given : dict of str to Scans, Map or Stored
    spec : GridSpec
        The cells that are judged.
    resampling : {"area", "nearest", "cautious"}, optional
        How stored grids of other cells come onto those; by default they are refused, unless their cells are
        repeated whole.
    """

    def __init__(
        self,
        given: dict[str, SingleScanMethod | Map | PrecomputedGrids],
        spec: GridSpec,
        resampling: "Resampling | None" = None,
    ) -> None:
        if not given:
            raise ValueError("no methods to judge: give --ism NAME, or --grids FOLDER")
        self.given, self.spec, self.resampling = given, spec, resampling
        self.remember = any(isinstance(one, Map) for one in given.values())
        self._models = {
            name: Mounted(one.model) for name, one in given.items() if isinstance(one, SingleScanMethod)
        }
        self._maps: dict[str, EvidentialMapper | BinaryBayesMapper] = {}
        self._sequence: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of all methods, in order."""
        return tuple(self.given)

    @property
    def files(self) -> tuple[Path, ...]:
        """All grids that were made elsewhere."""
        return tuple(
            path
            for one in self.given.values()
            if isinstance(one, PrecomputedGrids)
            for path in one.files.values()
        )

    def facts(self) -> dict[str, Any]:
        """Say what each method is, as JSON can hold it."""
        return {
            name: {
                "description": one.description,
                "weights": one.weights if isinstance(one, SingleScanMethod) else None,
            }
            for name, one in self.given.items()
        }

    def check(self, frames: Sequence[Frame]) -> None:
        """See that there is a grid for every frame that is judged, and a sequence for every map.

        Raises
        ------
        ValueError
            Naming frames that do not pair.
        """
        names = [frame.name for frame in frames]
        if self.remember and not all(frame.sequence for frame in frames):
            raise ValueError(
                "--fused wants frames that follow each other: a drive with poses, or a data set's --split sequences "
                "(`ogm simulate --sequences`)"
            )
        for method, one in self.given.items():
            if isinstance(one, PrecomputedGrids):
                missing = [name for name in names if name not in one.files]
                if missing:
                    more = sorted(set(one.files) - set(names))
                    there = f"; it has {len(more)} of other names, {more[0]} first" if more else ""
                    raise ValueError(
                        f"{method}: frames do not pair, there is no grid for {missing[0]} and {len(missing) - 1} "
                        f"more of {len(names)} frames{there}. Grids go by their frames' names"
                    )

    def show(self, frame: Frame, item: Item) -> dict[str, EvidentialGrid]:
        """Let the maps take a frame in, in the order of its sequence; return what the models say of the scan.

        Raises
        ------
        ValueError
            If there are models but no points, or maps but no pose or stamp.
        """
        if frame.sequence != self._sequence or not frame.sequence:
            self._maps = {name: one.make() for name, one in self.given.items() if isinstance(one, Map)}
            self._sequence = frame.sequence
        scans: dict[str, EvidentialGrid] = {}
        for name, model in self._models.items():
            if item.points is None:
                raise ValueError(f"{name} wants points, and there are none here; give --grids FOLDER alone")
            scans[name] = model(item)(as_scan(item.points))
        for name, mapper in self._maps.items():
            one = self.given[name]
            if isinstance(one, Map):
                _update(mapper, scans[one.scans], frame, item)
        return scans

    def grids(self, frame: Frame, item: Item) -> dict[str, EvidentialGrid]:
        """Return what every method says of a frame, on the cells that are judged; maps take it in, see `show`."""
        scans = self.show(frame, item)
        result: dict[str, EvidentialGrid] = {}
        for name, one in self.given.items():
            if isinstance(one, SingleScanMethod):
                result[name] = resample_to(scans[name], self.spec)
            elif isinstance(one, Map):
                result[name] = self._maps[name].view(self.spec)
            else:
                result[name] = self._read(name, one.files[frame.name])
        return result

    def _read(self, name: str, path: Path) -> EvidentialGrid:
        grid = read_grid(path, self.spec)
        try:
            return resample_to(grid, self.spec)
        except ValueError as error:
            if self.resampling is None:
                raise ValueError(f"{name}: {path.name}: {error}; or resample it: --resample area") from error
            return warp(grid, self.spec, np.eye(4), self.resampling)


def _update(
    mapper: EvidentialMapper | BinaryBayesMapper, grid: EvidentialGrid, frame: Frame, item: Item
) -> None:
    """Fuse a scan's grid; at a jump of the pose the map begins anew."""
    if item.T_map_sensor is None or frame.stamp is None:
        raise ValueError(
            f"{frame.name} has no pose or no stamp, so that it cannot be fused; leave out --fused"
        )
    T = item.T_map_sensor
    if item.T_vehicle_sensor is not None:
        T = T @ Mount(1.0, item.T_vehicle_sensor).T_sensor_level
    try:
        mapper.update(grid, T, stamp=frame.stamp)
    except PoseJump as jump:
        logging.getLogger(__name__).warning("%s: %s; the maps begin anew", frame.name, jump)
        mapper.reset()
        mapper.update(grid, T, stamp=frame.stamp)


def methods_of(
    isms: Sequence[str], rules: Sequence[str], folders: Sequence[Path], spec: GridSpec
) -> dict[str, SingleScanMethod | Map | PrecomputedGrids]:
    """Return methods by what the command line names: models, each with its maps, then folders of grids.

    Raises
    ------
    ValueError
        If a name is unknown, or given twice.
    FileNotFoundError
        If there are no such weights, or no such folder.
    """
    models = models_of(isms, spec) if isms else {}
    result: dict[str, SingleScanMethod | Map | PrecomputedGrids] = {}
    for (name, model), given in zip(models.items(), isms, strict=True):
        result[name] = SingleScanMethod(model, describe_model(given), weights_facts(given))
    for name in models:
        for rule in rules:
            result |= fused(name, rule, spec)
    for folder in folders:
        if not folder.is_dir():
            raise FileNotFoundError(f"there is no folder {folder}; --grids wants one of grids")
        name = shown_name(folder)
        name = name if name not in result else str(folder)
        if name in result:
            raise ValueError(f"{folder} is given twice; give each folder once")
        files = grids_in(folder)
        if not files:
            raise ValueError(f"{folder} holds no grids (.npz, .npy, .png); see `ogm map --out FOLDER`")
        result[name] = PrecomputedGrids(
            files, f"Grids of the folder {shown_name(folder)}, {len(files)} files."
        )
    return result


def fused(name: str, rule: str, spec: GridSpec, half_life: float | None = None) -> dict[str, Map]:
    """Return the map that fuses a model's scans by a rule, under its name."""
    window = rolling(spec)
    mapper = mapper_of(rule, window, half_life)  # refuses unknown rules before any work
    memory = mapper.half_life if isinstance(mapper.half_life, float) else mapper.half_life[0]
    kind = "log-odds (BinaryBayesMapper)" if rule == BAYES else f"the {rule} rule (EvidentialMapper)"
    fading = "never forgets" if np.isinf(memory) else f"half-life {memory:g} s"
    description = f"The scans of {name} fused over time by {kind}, {fading}."
    return {f"{name} + {rule}": Map(name, lambda: mapper_of(rule, window, half_life), description)}

"""Methods that are evaluated: sensor models, maps that fuse their grids over time, and precomputed grids."""

import inspect
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.truth_grids import grid_files
from ogm.dynamic_grid import DynamicGrid
from ogm.evidence.map_rules import BAYES, DYNAMIC, NUSS
from ogm.fusion import DynamicMapper, Mapper, make_mapper, resample_to, rolling_window, update_map
from ogm.fusion.resample import ResampleMethod
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids.files import read_grid
from ogm.models.named import describe_model, load_model, short_names, with_radar
from ogm.scan import Frame, InverseSensorModel

DETECTION = 0.5  # mass above which a scan shows a cell as occupied


@dataclass(eq=False)
class SingleScanMethod:
    """A sensor model; each scan is mapped by itself.

    Parameters
    ----------
    model : InverseSensorModel
    description : str
        One sentence, for the report.
    weights : dict, optional
        File name and SHA-256 of the model's weights.
    """

    model: InverseSensorModel
    description: str = ""
    weights: Mapping[str, str] | None = None

    @classmethod
    def named(cls, name: str, spec: GridSpec) -> "SingleScanMethod":
        """Return the method of a model by its name, see `ogm.models.load_model`, which maps scans of radars too."""
        model = load_model(with_radar(name), spec, drop_ego_returns=True)
        return cls(model, *describe_model(name))

    def grid(self, frame: Frame, spec: GridSpec, measured: EvidentialGrid | None) -> EvidentialGrid:
        """Return the measurement grid of a frame on the evaluated cells."""
        assert measured is not None
        return resample_to(measured, spec, None)

    def state(self) -> str:
        """Return what the results depend on besides the description."""
        return _object_state(self.model)


@dataclass(eq=False)
class FusedMethod:
    """A map that fuses the grids of a sensor model over time; every sequence begins with a new map.

    Parameters
    ----------
    model : InverseSensorModel
        Give the same object as to a `SingleScanMethod`, and each scan is mapped once for both.
    new_mapper : function
        Makes the mapper of a sequence.
    description : str
        One sentence, for the report.
    """

    model: InverseSensorModel
    new_mapper: Callable[[], Mapper]
    description: str = ""
    _mapper: Mapper = field(init=False, repr=False)

    @classmethod
    def by_rule(cls, name: str, model: InverseSensorModel, rule: str, spec: GridSpec) -> "FusedMethod":
        """Return a rolling map that fuses by a rule.

        Parameters
        ----------
        name : str
            Of the model, for the description.
        model : InverseSensorModel
        rule : str
            A name in `ogm.fusion.RULES`, ``"bayes"``, ``"dynamic"`` or ``"nuss"``.
        spec : GridSpec
            The cells of the model's grids.
        """
        window = rolling_window(spec)
        mapper = make_mapper(rule, window)  # refuses unknown rules before any work
        if isinstance(mapper, DynamicMapper):
            kind = {DYNAMIC: "a dynamic map", NUSS: "Nuss' filter"}[rule]
            detail = f"{mapper.particles:,} particles"
        else:
            kind = "log-odds (BinaryBayesMapper)" if rule == BAYES else f"the {rule} rule (EvidentialMapper)"
            memory = np.min(mapper.half_life)
            detail = "no decay" if np.isinf(memory) else f"half-life {memory:g} s"
        description = f"The scans of {name} fused over time by {kind}, {detail}."
        return cls(model, partial(make_mapper, rule, window), description)

    def check(self, name: str, frames: Sequence[Frame]) -> None:
        """Refuse frames that a map cannot fuse; `name` is that of the method."""
        for frame in frames:
            if not frame.sequence or frame.T_map_sensor is None or frame.stamp is None:
                raise ValueError(
                    f"{name} fuses frames that follow each other, with poses and stamps, but {frame.name} "
                    f"{'has none' if frame.sequence else 'stands alone'}: give a drive with poses, or the split "
                    "`sequences` of a simulated data set"
                )

    def reset(self) -> None:
        """Begin a new map."""
        self._mapper = self.new_mapper()

    def update(self, frame: Frame, measured: EvidentialGrid) -> None:
        """Fuse the measurement grid of a frame into the map; after a jump of the pose a new map begins."""
        self.check("a map", [frame])
        if update_map(self._mapper, measured, frame) is not None:
            logging.getLogger(__name__).warning("%s: the pose jumps; a new map begins", frame.name)

    def grid(self, frame: Frame, spec: GridSpec, measured: EvidentialGrid | None) -> EvidentialGrid:
        """Return the map around the frame that was fused last."""
        return self._mapper.view(spec)

    @property
    def is_dynamic(self) -> bool:
        """Whether the map knows motion."""
        return isinstance(self._mapper, DynamicMapper)

    def dynamic_grid(self, spec: GridSpec) -> DynamicGrid:
        """Return the dynamic map around the frame that was fused last."""
        assert isinstance(self._mapper, DynamicMapper)
        return self._mapper.dynamic_view(spec)

    def predicted(self, seconds: float) -> DynamicGrid:
        """Return the dynamic map, in map coordinates, some time [s] after the frame that was fused last."""
        assert isinstance(self._mapper, DynamicMapper)
        return self._mapper.predicted(seconds)

    def state(self) -> str:
        """Return what the results depend on besides the description."""
        return _object_state(self.model) + _object_state(self.new_mapper())


@dataclass(eq=False)
class PrecomputedGrids:
    """Grids from files, by the names of their frames.

    Parameters
    ----------
    files : dict of str to Path
        Frame name to grid file (.npz, .npy, .png).
    description : str
        One sentence, for the report.
    resampling : {"area", "nearest", "cautious"}, optional
        How grids with other cells are resampled to the evaluated ones; by default they are refused, unless their
        cells are repeated whole.
    """

    files: Mapping[str, Path]
    description: str = ""
    resampling: ResampleMethod | None = None

    @classmethod
    def in_folder(cls, folder: Path, resampling: ResampleMethod | None = None) -> "PrecomputedGrids":
        """Return the grids of a folder.

        Raises
        ------
        FileNotFoundError
            If there is no such folder.
        ValueError
            If it holds no grids, or two of one frame.
        """
        if not folder.is_dir():
            raise FileNotFoundError(f"there is no folder {folder}; precomputed grids come in a folder")
        files = grid_files(folder.absolute())  # for other processes
        if not files:
            raise ValueError(f"{folder} holds no grids (.npz, .npy, .png); see `ogm map --out FOLDER`")
        return cls(files, f"Grids of the folder {folder.resolve().name}, {len(files)} files.", resampling)

    def check(self, name: str, frames: Sequence[Frame]) -> None:
        """Refuse frames without a grid of their name; `name` is that of the method."""
        names = [frame.name for frame in frames]
        missing = [one for one in names if one not in self.files]
        if missing:
            more = sorted(set(self.files) - set(names))
            others = f"; it has {len(more)} with other names, first {more[0]}" if more else ""
            raise ValueError(
                f"{name}: there is no grid for {missing[0]} and {len(missing) - 1} more of {len(frames)} "
                f"frames{others}. Grids have the names of their frames"
            )

    def grid(self, frame: Frame, spec: GridSpec, measured: EvidentialGrid | None = None) -> EvidentialGrid:
        """Read the grid of a frame, on the evaluated cells."""
        path = self.files[frame.name]
        grid = read_grid(path, spec)
        try:
            return resample_to(grid, spec, self.resampling)
        except ValueError as error:
            raise ValueError(f"{path}: {error}; `resample=area` resamples them") from error

    def state(self) -> str:
        """Return what the results depend on besides the description and the files."""
        return str(self.resampling)


Method = SingleScanMethod | FusedMethod | PrecomputedGrids


def as_methods(given: Mapping[str, Any] | Sequence[str], spec: GridSpec) -> dict[str, Method]:
    """Return methods by name: a model's name and any callable with ``.spec`` become single-scan methods.

    A sequence of models' names has short names of them.

    Raises
    ------
    TypeError
        If one is neither.
    """
    if not given:
        raise ValueError("no methods to evaluate: give at least one by its name")
    if not isinstance(given, Mapping):
        if isinstance(given, str) or not all(isinstance(name, str) for name in given):
            raise TypeError(f"methods must be a dict, name to method, or a list of models' names, got {given!r}")
        given = short_names(given)
    result: dict[str, Method] = {}
    for name, one in given.items():
        if isinstance(one, Method):
            result[name] = one
        elif isinstance(one, str):
            result[name] = SingleScanMethod.named(one, spec)
        elif callable(one) and hasattr(one, "spec"):
            result[name] = SingleScanMethod(one, f"A sensor model in Python ({type(one).__name__}).")
        else:
            raise TypeError(f"{name} must be a callable with a .spec, a model's name or a method, got {one!r}")
    return result


class MethodRunner:
    """Runs methods on frame after frame; each scan is mapped once per model.

    Parameters
    ----------
    methods : dict of str to method
    spec : GridSpec
        The evaluated cells.
    """

    def __init__(self, methods: Mapping[str, Method], spec: GridSpec) -> None:
        self.methods, self.spec = methods, spec
        self.fused = [one for one in methods.values() if isinstance(one, FusedMethod)]
        self._sequence: str | None = None
        self._frame: Frame | None = None
        self._measured: dict[int, EvidentialGrid] = {}  # of the last frame, by the id of the model

    def update(self, frame: Frame, *, evaluated: bool = True) -> None:
        """Map the scan of a frame, the next of its sequence, once by every model, and fuse it into the maps.

        Parameters
        ----------
        frame : Frame
        evaluated : bool
            Whether `grids` will be asked for; else only the models of maps are run.
        """
        if frame.sequence != self._sequence or not frame.sequence:
            self._sequence = frame.sequence
            for method in self.fused:
                method.reset()
        self._frame = frame
        models = {id(one.model): one.model for one in (self._single if evaluated else []) + self.fused}
        self._measured = {key: model(frame.scan) for key, model in models.items()}
        for method in self.fused:
            method.update(frame, self._measured[id(method.model)])

    def grids(self) -> dict[str, EvidentialGrid]:
        """Return the grid of every method for the frame of the last `update`, on the evaluated cells."""
        assert self._frame is not None
        return {name: one.grid(self._frame, self.spec, self._of(one)) for name, one in self.methods.items()}

    @property
    def dynamic(self) -> dict[int, FusedMethod]:
        """Methods that make dynamic grids, by their places."""
        methods = enumerate(self.methods.values())
        return {k: method for k, method in methods if isinstance(method, FusedMethod) and method.is_dynamic}

    def dynamic_grids(self) -> dict[int, tuple[DynamicGrid, NDArray[np.bool_]]]:
        """Return the dynamic grids of the last frame, by the places of their methods.

        Each with the cells that the scan shows as occupied: a mass of more than 1/2.
        """
        measured = {k: resample_to(self._measured[id(one.model)], self.spec, None) for k, one in self.dynamic.items()}
        return {k: (one.dynamic_grid(self.spec), measured[k].occupied > DETECTION) for k, one in self.dynamic.items()}

    @property
    def _single(self) -> list[SingleScanMethod]:
        return [one for one in self.methods.values() if isinstance(one, SingleScanMethod)]

    def _of(self, method: Method) -> EvidentialGrid | None:
        """Return the measurement grid of a method's model; None if it has no model."""
        return None if isinstance(method, PrecomputedGrids) else self._measured[id(method.model)]


def _object_state(one: Any) -> str:
    """Return an object's repr without addresses, and a hash of the source file of its class or function."""
    home = one if inspect.isroutine(one) else type(one)
    try:
        source = Path(inspect.getfile(home)).read_bytes()
    except (OSError, TypeError):  # a notebook, or no Python
        source = repr(home).encode()
    return re.sub(r" at 0x[0-9a-f]+", "", repr(one)) + sha256(source).hexdigest()

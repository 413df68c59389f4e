"""Methods of an evaluation: sensor models, maps that fuse their grids over time, and precomputed grids."""

import inspect
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
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
from ogm.scan import Frame, InverseSensorModel, run_model

DETECTION = 0.5  # mass of occupied above which a cell is occupied in a scan


@dataclass(eq=False)
class SingleScanMethod:
    """A sensor model applied to single scans.

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
        """Return the method for the name of a model, see `ogm.models.load_model`; it also maps scans of radars."""
        model = load_model(with_radar(name), spec, drop_ego_returns=True)
        return cls(model, *describe_model(name))

    def grid(self, frame: Frame, spec: GridSpec, measured: EvidentialGrid | None) -> EvidentialGrid:
        """Return the measurement grid of a frame, resampled to the evaluated cells."""
        assert measured is not None
        return resample_to(measured, spec, None)

    def state(self) -> str:
        """Return a text that changes with the results, to be stored with the description."""
        return _object_state(self.model)


@dataclass(eq=False)
class FusedMethod:
    """A map that fuses the grids of a sensor model over time, with a new map for every sequence.

    Parameters
    ----------
    model : InverseSensorModel
        If it is also the object of a `SingleScanMethod`, each scan is mapped once for both.
    new_mapper : function
        Returns a new mapper for a sequence.
    description : str
        One sentence, for the report.
    """

    model: InverseSensorModel
    new_mapper: Callable[[], Mapper]
    description: str = ""
    _mapper: Mapper = field(init=False, repr=False)

    @classmethod
    def by_rule(cls, name: str, model: InverseSensorModel, rule: str, spec: GridSpec) -> "FusedMethod":
        """Return the method of a rolling map with a combination rule.

        Parameters
        ----------
        name : str
            Name of the model, for the description.
        model : InverseSensorModel
        rule : str
            A name in `ogm.fusion.RULES`, ``"bayes"``, ``"dynamic"`` or ``"nuss"``.
        spec : GridSpec
            Cells of the model's grids.
        """
        window = rolling_window(spec)
        mapper = make_mapper(rule, window)  # raises for unknown rules before any work
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
        """Raise a ValueError for frames that a map cannot fuse; `name` is the name of the method."""
        for frame in frames:
            if not frame.sequence or frame.T_map_sensor is None or frame.stamp is None:
                missing = "no pose or stamp" if frame.sequence else "no sequence"
                raise ValueError(
                    f"{name} fuses sequences of frames with poses and stamps, but {frame.name} has {missing}: give a "
                    "drive with poses, or the split `sequences` of a simulated dataset"
                )

    def reset(self) -> None:
        """Begin a new map."""
        self._mapper = self.new_mapper()

    def update(self, frame: Frame, measured: EvidentialGrid) -> None:
        """Fuse the measurement grid of a frame into the map; a jump of the pose starts a new map."""
        self.check("a map", [frame])
        if update_map(self._mapper, measured, frame) is not None:
            logging.getLogger(__name__).warning("%s: the pose jumps; a new map begins", frame.name)

    def grid(self, frame: Frame, spec: GridSpec, measured: EvidentialGrid | None) -> EvidentialGrid:
        """Return the map around the last fused frame."""
        return self._mapper.view(spec)

    @property
    def is_dynamic(self) -> bool:
        """Whether the map is dynamic."""
        return isinstance(self._mapper, DynamicMapper)

    def dynamic_grid(self, spec: GridSpec) -> DynamicGrid:
        """Return the dynamic map around the last fused frame."""
        assert isinstance(self._mapper, DynamicMapper)
        return self._mapper.dynamic_view(spec)

    def predicted(self, seconds: float) -> DynamicGrid:
        """Return the prediction of the dynamic map, in map coordinates, `seconds` after the last fused frame."""
        assert isinstance(self._mapper, DynamicMapper)
        return self._mapper.predicted(seconds)

    def state(self) -> str:
        """Return a text that changes with the results, to be stored with the description."""
        return _object_state(self.model) + _object_state(self.new_mapper())


@dataclass(eq=False)
class PrecomputedGrids:
    """Grids from files, one per frame.

    Parameters
    ----------
    files : dict of str to Path
        Grid file (.npz, .npy, .png) by the name of the frame.
    description : str
        One sentence, for the report.
    resampling : {"area", "nearest", "cautious"}, optional
        Method to resample grids with other cells; by default an error, except for cells that consist of whole
        evaluated cells.
    """

    files: Mapping[str, Path]
    description: str = ""
    resampling: ResampleMethod | None = None

    @classmethod
    def in_folder(cls, folder: Path, resampling: ResampleMethod | None = None) -> "PrecomputedGrids":
        """Return the method for the grids in a folder.

        Raises
        ------
        FileNotFoundError
            If the folder does not exist.
        ValueError
            If it contains no grids, or two grids of the same frame.
        """
        if not folder.is_dir():
            raise FileNotFoundError(f"there is no folder {folder}; give a folder of precomputed grids")
        files = grid_files(folder.absolute())  # for other processes
        if not files:
            raise ValueError(f"{folder} contains no grids (.npz, .npy, .png); `ogm map --out FOLDER` writes them")
        return cls(files, f"Grids of the folder {folder.resolve().name}, {len(files)} files.", resampling)

    def check(self, name: str, frames: Sequence[Frame]) -> None:
        """Raise a ValueError for frames without a grid; `name` is the name of the method."""
        names = [frame.name for frame in frames]
        missing = [frame for frame in names if frame not in self.files]
        if missing:
            more = sorted(set(self.files) - set(names))
            others = f"; {len(more)} grids have other names, the first {more[0]}" if more else ""
            raise ValueError(
                f"{name}: there is no grid for {missing[0]} and {len(missing) - 1} more of {len(frames)} "
                f"frames{others}. Name grids after their frames"
            )

    def grid(self, frame: Frame, spec: GridSpec, measured: EvidentialGrid | None = None) -> EvidentialGrid:
        """Read the grid of a frame, on the evaluated cells."""
        path = self.files[frame.name]
        grid = read_grid(path, spec)
        try:
            return resample_to(grid, spec, self.resampling)
        except ValueError as error:
            raise ValueError(f"{path}: {error}; or give `resample=area`") from error

    def state(self) -> str:
        """Return the resampling, to be stored with the description and the files."""
        return str(self.resampling)


Method = SingleScanMethod | FusedMethod | PrecomputedGrids


def as_methods(given: Mapping[str, Any] | Sequence[str], spec: GridSpec) -> dict[str, Method]:
    """Return methods by name: names of models and callables with ``.spec`` become single-scan methods.

    Methods of a list of models get short names.

    Raises
    ------
    TypeError
        If a value is no method, name or callable.
    """
    if not given:
        raise ValueError("there are no methods to evaluate: give at least one by name")
    if not isinstance(given, Mapping):
        if isinstance(given, str) or not all(isinstance(name, str) for name in given):
            raise TypeError(f"methods must be a dict from name to method, or a list of names of models, got {given!r}")
        given = short_names(given)
    result: dict[str, Method] = {}
    for name, method in given.items():
        if isinstance(method, Method):
            result[name] = method
        elif isinstance(method, str):
            result[name] = SingleScanMethod.named(method, spec)
        elif callable(method) and hasattr(method, "spec"):
            result[name] = SingleScanMethod(method, f"A sensor model in Python ({type(method).__name__}).")
        else:
            raise TypeError(f"{name} must be a callable with a .spec, a model's name or a method, got {method!r}")
    return result


class MethodRunner:
    """Application of methods to successive frames; each scan is mapped once per model.

    Parameters
    ----------
    methods : dict of str to method
    spec : GridSpec
        Evaluated cells.
    """

    def __init__(self, methods: Mapping[str, Method], spec: GridSpec) -> None:
        self.methods, self.spec = methods, spec
        self.fused = [method for method in methods.values() if isinstance(method, FusedMethod)]
        self._sequence: str | None = None
        self._frame: Frame | None = None
        self._measured: dict[int, EvidentialGrid] = {}  # of the last frame, by the id of the model

    def update(self, frame: Frame, *, evaluated: bool = True) -> None:
        """Map the scan of a frame by every model, and fuse it into the maps.

        Parameters
        ----------
        frame : Frame
            The next frame of its sequence.
        evaluated : bool
            Whether `grids` is needed for this frame; else only the models of maps are run.
        """
        if frame.sequence != self._sequence or not frame.sequence:
            self._sequence = frame.sequence
            for method in self.fused:
                method.reset()
        self._frame = frame
        models = {id(method.model): method.model for method in (self._single if evaluated else []) + self.fused}
        self._measured = {key: run_model(model, frame) for key, model in models.items()}
        for method in self.fused:
            method.update(frame, self._measured[id(method.model)])

    def grids(self) -> dict[str, EvidentialGrid]:
        """Return the grid of every method for the frame of the last `update`, on the evaluated cells."""
        assert self._frame is not None
        return {name: method.grid(self._frame, self.spec, self._of(method)) for name, method in self.methods.items()}

    @property
    def dynamic(self) -> dict[int, FusedMethod]:
        """Methods with dynamic grids, by index."""
        methods = enumerate(self.methods.values())
        return {k: method for k, method in methods if isinstance(method, FusedMethod) and method.is_dynamic}

    def dynamic_grids(self) -> dict[int, tuple[DynamicGrid, NDArray[np.bool_]]]:
        """Return dynamic grid and cells occupied in the scan (mass above 1/2) of the last frame, by index of method."""
        found = {}
        for k, method in self.dynamic.items():
            measured = resample_to(self._measured[id(method.model)], self.spec, None)
            found[k] = method.dynamic_grid(self.spec), measured.occupied > DETECTION
        return found

    @property
    def _single(self) -> list[SingleScanMethod]:
        return [method for method in self.methods.values() if isinstance(method, SingleScanMethod)]

    def _of(self, method: Method) -> EvidentialGrid | None:
        """Return the measurement grid of a method's model; None for methods without a model."""
        return None if isinstance(method, PrecomputedGrids) else self._measured[id(method.model)]


def _object_state(value: Any) -> str:
    """Return an object's repr without addresses, or its attributes, and a hash of its source."""
    definition = value if inspect.isroutine(value) else type(value)
    parts = [definition, *vars(definition).values()] if isinstance(definition, type) else [definition]
    codes = [part.__code__ for part in parts if hasattr(part, "__code__")]
    source = repr([definition, *((code.co_code, code.co_names, code.co_consts) for code in codes)])
    with suppress(OSError, TypeError):  # a notebook, a console, or compiled code
        source += Path(inspect.getfile(definition)).read_bytes().hex()
    text = repr(value)
    if hasattr(value, "__dict__") and not any("__repr__" in vars(base) for base in type(value).__mro__[:-1]):
        text += repr(vars(value))
    text, source = (re.sub(r" at 0x[0-9a-f]+", "", part) for part in (text, source))
    return text + sha256(source.encode()).hexdigest()

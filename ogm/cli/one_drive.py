"""What ``ogm fuse`` does with a drive, here or in another process."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import typer

from ogm.cli.drive import posed
from ogm.cli.fuse_run import FusionRun
from ogm.datasets import Dataset
from ogm.fusion import covering_window, fuse, make_mapper, rolling_window
from ogm.grid import GridSpec
from ogm.io.grids import GridLog, write_grid
from ogm.io.logs import LOG_ENDINGS
from ogm.models.named import load_model, with_radar
from ogm.plot.movie import open_movie
from ogm.plot.viewer import write_view
from ogm.scan import InverseSensorModel

__all__ = ["FuseInto", "FuseOptions", "Outputs", "fuse_drive", "load_models"]


@lru_cache(1)
def load_models(name: str, spec: GridSpec) -> InverseSensorModel:
    """Return the model of a name for all sensors; that of the last name is kept."""
    return load_model(with_radar(name), spec)


@dataclass(frozen=True)
class Outputs:
    """Files that are written; None for none."""

    map: Path | None = None
    picture: Path | None = None
    movie: Path | None = None
    poses: Path | None = None
    page: Path | None = None

    def within(self, folder: Path) -> "Outputs":
        """Return files of the same names in another folder."""
        return Outputs(**{name: path and folder / path.name for name, path in asdict(self).items()})

    @property
    def base(self) -> Path:
        """The main one."""
        return self.map or self.picture or self.movie or self.page or Path("map.npz")


@dataclass(frozen=True)
class FuseOptions:
    """How a drive is fused: the options of the command.

    Parameters
    ----------
    ism : str
    spec : GridSpec
        Of measurement grids, picture and film.
    rule : str
    half_life : float, optional
    window : {"rolling", "fixed"}
    particles : int
    deskew : bool
    radar_reliability : float
    sensors : tuple of str
    message : str, optional
        Of maps in logs.
    odometry : str, optional
        By which each of many drives gets its poses.
    rate : float
        [Hz].
    first : int, optional
        Scans of each of many drives.
    weights : dict, optional
        Of the model: results of others are not taken for its own.
    """

    ism: str
    spec: GridSpec
    rule: str
    half_life: float | None
    window: str
    particles: int
    deskew: bool
    radar_reliability: float
    sensors: tuple[str, ...]
    message: str | None
    odometry: str | None = None
    rate: float = 10.0
    first: int | None = None
    weights: Mapping[str, str] | None = None


def fuse_drive(
    dataset: Dataset, options: FuseOptions, outputs: Outputs, tell: Callable[[str], object] | None = None
) -> tuple[FusionRun, int]:
    """Fuse a drive whose poses are known, and write the outputs; return the run and the exit code.

    Raises
    ------
    ValueError
        If no scan could be mapped.
    typer.Exit
        If it was interrupted before.
    """
    o, spec = options, options.spec
    if o.deskew and not dataset.motion_distorted:
        raise ValueError("leave out --deskew: the points of this data set are not (or not all) distorted by motion")
    known = [ref.T_map_sensor for ref in dataset.refs if ref.T_map_sensor is not None]
    cells = rolling_window(spec) if o.window == "rolling" else covering_window(spec, np.array(known))
    mapper = make_mapper(o.rule, cells, o.half_life, o.window, o.particles)  # type: ignore[arg-type]
    run = FusionRun(dataset, mapper, spec, (Path(o.ism).stem, o.rule), outputs.base, tell)
    times = (dataset.trajectory or True) if o.deskew else False
    radars = dataset.facts.get("radars", {})
    beside = "lidar" in o.sensors and radars
    reliability = {"": 1.0} | dict.fromkeys(radars, o.radar_reliability) if beside else 1.0
    steps = fuse(dataset, load_models(o.ism, spec), mapper, deskew=times, reliability=reliability, on_error=run.report)
    is_log = outputs.map is not None and outputs.map.suffix.lower() in LOG_ENDINGS
    log = GridLog(outputs.map, o.message or "occupancy-grid") if is_log else nullcontext()  # type: ignore[arg-type]
    titles = ("points by height", *run.titles)
    film = open_movie(outputs.movie, spec, titles, run.ground_z) if outputs.movie else nullcontext()
    with film as movie, log as maps:
        code = run.map_all(steps, movie, maps)
        if run.last is None:
            raise (typer.Exit(code) if code == 130 else ValueError("no scan could be mapped; nothing is written"))
        if outputs.map is not None and not is_log:
            write_grid(outputs.map, run.placed)
        if outputs.poses is not None:
            run.save_poses(outputs.poses)
        if outputs.picture is not None:
            run.save_picture(outputs.picture)
        if outputs.page is not None:
            write_view(outputs.page, run.map, getattr(mapper, "conflict", None), title=f"map of {dataset.name}")
    return run, code


@dataclass(frozen=True)
class FuseInto:
    """Fuse one of many drives into a folder; for `ogm.fusion.fuse_drives`."""

    options: FuseOptions
    outputs: Outputs

    def __call__(self, frames: Any, folder: Path) -> Mapping[str, Any]:
        """Return what was done, the messages about scans, and the exit code."""
        o, messages = self.options, list[str]()
        dataset, how = posed(frames, o.odometry, o.rate, o.first)
        run, code = fuse_drive(dataset, o, self.outputs.within(folder), messages.append)
        if code == 130:  # not finished: what there is would look as if it were
            raise KeyboardInterrupt
        return {**run.facts(), "poses": how, "messages": messages, "code": code}

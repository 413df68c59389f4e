"""Fusing one drive to files: map, picture, film, page, poses. ``ogm fuse`` calls `fuse_drive`."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ogm.datasets import Dataset, with_matching, with_odometry
from ogm.fusion import (
    DynamicMapper,
    EvidentialMapper,
    FusionStep,
    covering_window,
    echo_window,
    fuse,
    make_mapper,
    rolling_window,
)
from ogm.fusion.factory import adding_rule_warning, continued_window
from ogm.fusion.pipeline import grid_pose
from ogm.fusion.update_gate import MAX_GAP
from ogm.grid import GridSpec, LayeredGrid
from ogm.io.grids.files import write_grid
from ogm.io.grids.logged import GridLog
from ogm.io.grids.placed import PlacedGrid
from ogm.io.logs import LOG_ENDINGS
from ogm.models.compilation import compiled_ahead
from ogm.models.layers import ExplainedISM
from ogm.plot.movie import open_movie
from ogm.plot.viewer import write_view
from ogm.workflows.buildings import has_doubtful_clock, is_planar, map_defaults
from ogm.workflows.checks import gravest
from ogm.workflows.fuse_options import FuseOptions, Outputs
from ogm.workflows.fusion_run import FusionRun

_log = logging.getLogger(__name__)


def fuse_drive(
    dataset: Dataset,
    outputs: Outputs = Outputs(),  # noqa: B008  it is frozen
    options: FuseOptions | None = None,
    *,
    warn: Callable[[str], object] = _log.warning,
    progress: Callable[[Iterator[FusionStep]], Iterable[FusionStep]] = iter,
) -> FusionRun:
    """Fuse a drive into a map, and write the outputs.

    Damaged scans, scans without a pose, and scans after a jump of pose or stamp are skipped. An interrupt or an error
    during the mapping ends it early; the partial result is written.

    Parameters
    ----------
    dataset : Dataset
        One drive.
    outputs : Outputs
        Files to write; their folders are created.
    options : FuseOptions, optional
        By default from `map_defaults`.
    warn : function
        Called with messages about the rule, scans, and an early end; by default they are logged.
    progress : function
        Iterates over the steps, and may draw a progress bar.

    Returns
    -------
    FusionRun
        Mapper and facts. `FusionRun.code` is not 0 if scans were skipped or the mapping ended early.

    Raises
    ------
    ValueError
        If the drive has no poses, no scan could be mapped, or no scan has evidence on the grid.
    KeyboardInterrupt
        If it was interrupted before the first mapped scan.
    """
    outputs.prepare()
    o = options or _default_options(dataset)
    dataset = posed(dataset, o.odometry, o.rate, o.first, match=o.match)[0]
    if o.deskew and not dataset.motion_distorted:
        raise ValueError("`deskew` needs points distorted by motion in all scans of the dataset: leave it out")
    if (warning := adding_rule_warning(o.rule)) and o.rule != map_defaults(dataset).rule:
        warn(warning)
    for finding in gravest(dataset, str(o.ism)):
        warn(finding)
    known = [ref.T_map_sensor for ref in dataset.refs if ref.T_map_sensor is not None]
    if o.window == "rolling":
        cells = rolling_window(o.spec)
        extent = float(np.ptp(np.array(known)[:, :2, 3], axis=0).max(initial=0.0)) if known else 0.0
        if outputs.map is not None and outputs.map.suffix == ".yaml" and extent > cells.length / 2:
            warn(
                f"the map is a window of {cells.length:.0f} m around the vehicle, and the drive {extent:.0f} m long: "
                "`--window fixed --half-life inf` keeps all of it"
            )
    elif is_planar(dataset):
        cells = echo_window(dataset, o.spec)
    else:
        cells = covering_window(o.spec, np.array(known))
    saved = _followed(o.saved, dataset, warn)
    start = None
    if saved is not None:
        first = next(k for k, ref in enumerate(dataset.refs) if ref.T_map_sensor is not None)
        cells, start = continued_window(cells, saved, o.window), grid_pose(dataset[first])
    speed = math.inf if is_planar(dataset) and has_doubtful_clock(dataset) else 70.0  # [m/s] beyond which a pose jumps
    mapper = make_mapper(o.rule, cells, o.half_life, o.window, o.particles, speed, saved, start)  # type: ignore[arg-type]
    run = FusionRun(dataset, mapper, o.spec, (Path(str(o.ism)).stem, o.rule), outputs.base, warn)
    times = (dataset.trajectory or True) if o.deskew else False
    radars = dataset.facts.get("radars", {})
    beside = "lidar" in o.sensors and radars
    reliability = {"": 1.0} | dict.fromkeys(radars, o.radar_reliability) if beside else 1.0
    model = o.load_model()
    if outputs.page is not None and isinstance(mapper, EvidentialMapper):
        model = ExplainedISM(model)  # the page shows causes of unknown cells
    steps = fuse(dataset, model, mapper, deskew=times, reliability=reliability, on_error=run.skip, read_ahead=True)
    is_log = outputs.map is not None and outputs.map.suffix.lower() in LOG_ENDINGS
    log = GridLog(outputs.map, o.message or "occupancy-grid") if is_log else nullcontext()  # type: ignore[arg-type]
    titles = ("points by height", *run.titles)
    film = open_movie(outputs.movie, o.spec, titles, run.ground_z) if outputs.movie else nullcontext()
    job = "dynamic map" if isinstance(mapper, DynamicMapper) else "map"
    with film as movie, log as maps, compiled_ahead("scan", job):
        run.map_all(progress(steps), movie, maps)
        if run.last is None:
            raise (KeyboardInterrupt if run.interrupted else ValueError("no scan could be mapped; nothing is written"))
        run.check_shown()
        for path in outputs.given().values():  # the folder may have been removed
            path.parent.mkdir(parents=True, exist_ok=True)
        if run.large_turns and dataset.motion_distorted and not o.deskew:
            warn(
                f"{len(run.large_turns)} of {len(run.mapped)} scans were taken while turning, by up to "
                f"{math.degrees(max(run.large_turns)):.1f} degrees within a scan, and are not de-skewed: static "
                "objects blur and seem to move; give `deskew`"
            )
        if outputs.map is not None and not is_log:
            layers = run.layers if outputs.map.suffix.lower() == ".npz" else run.conflict
            write_grid(outputs.map, run.placed(layers))
        if outputs.poses is not None:
            run.save_poses(outputs.poses)
        if outputs.picture is not None:
            run.save_picture(outputs.picture)
        if outputs.page is not None:
            title, T = f"map of {dataset.name}", run.T_map_vehicle
            layers = run.conflict
            if isinstance(mapper, EvidentialMapper) and mapper.has_causes:
                layers = LayeredGrid(mapper.spec, {**mapper.conflict.layers, **mapper.cause.layers})
            write_view(outputs.page, run.map, layers, title=title, T_grid_vehicle=T, track=run.track)
    return run


def _followed(saved: PlacedGrid | None, dataset: Dataset, warn: Callable[[str], object]) -> PlacedGrid | None:
    """Return the map to continue, without its stamp if the scans do not follow it in time."""
    stamps = [ref.stamp for ref in dataset.refs if ref.stamp is not None]
    if saved is None or saved.stamp is None or (stamps and 0 <= min(stamps) - saved.stamp <= MAX_GAP):
        return saved
    first = f"the first scan {min(stamps):.3f} s" if stamps else "the scans have none"
    warn(f"the map to continue has the stamp {saved.stamp:.3f} s, {first}: it does not age in between")
    return replace(saved, stamp=None)


def _default_options(dataset: Dataset) -> FuseOptions:
    """Return the options for the sensor of a dataset."""
    resolution, window, half_life, rule = map_defaults(dataset)
    spec = GridSpec.centered(resolution=resolution)
    return FuseOptions(spec=spec, window=window, half_life=half_life, rule=rule)


@dataclass(frozen=True)
class FuseInto:
    """Function that fuses a drive into a folder, for `ogm.workflows.fuse_drives`.

    Parameters
    ----------
    options : FuseOptions
    outputs : Outputs
        File names in the folder of each drive.
    """

    options: FuseOptions
    outputs: Outputs

    def __call__(self, frames: Any, folder: Path) -> Mapping[str, Any]:
        """Return the facts of the run, the messages about scans, and the exit code."""
        o, messages = self.options, list[str]()
        dataset, how = posed(frames, o.odometry, o.rate, o.first, match=o.match)
        run = fuse_drive(
            dataset, self.outputs.within(folder), replace(o, odometry=None, match=False), warn=messages.append
        )
        if run.interrupted:  # the partial result would look finished
            raise KeyboardInterrupt
        return {**run.facts(), "poses": how, "messages": messages, "code": run.code}


def posed(
    dataset: Dataset,
    odometry: str | None = None,
    rate: float = 10.0,
    first: int | None = None,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
    match: bool = False,
) -> tuple[Dataset, str]:
    """Return the first scans of a drive with its own or estimated poses, and the origin of the poses as text.

    Parameters
    ----------
    dataset : Dataset
        One drive.
    odometry : str, optional
        See `ogm.datasets.with_odometry`; by default the drive's own poses are used.
    rate : float
        Rate of scans without stamps [Hz].
    first : int, optional
        Number of scans; by default all.
    progress : function
        Iterates over the numbers of the scans read by odometry and matching.
    match : bool
        Refine the poses, used as odometry, see `ogm.datasets.with_matching`.

    Raises
    ------
    ValueError
        If the drive has no poses.
    """
    if odometry is not None:
        dataset = with_odometry(dataset[:first], odometry, rate, progress)
    known, how = sum(ref.T_map_sensor is not None for ref in dataset.refs), dataset.facts.get("poses")
    if not known:
        raise ValueError(
            f"the scans have no poses{f' ({how})' if how else ''}: give `poses` (KITTI, KITTI-360, TUM), or "
            "`odometry=kiss-icp` to estimate them"
        )
    if match:
        dataset = with_matching(dataset[:first], progress, rate)
        how = dataset.facts["poses"]
    return dataset[:first], how or f"{known} of {len(dataset)} scans, from the dataset"

"""The loop of ``ogm fuse``: scan by scan into the map, what is skipped, and what there is to show of it."""

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from ogm import plot
from ogm.cli.console import one_line, stderr
from ogm.cli.drive import UNREADABLE, Drive
from ogm.cli.route import Route
from ogm.fusion import BinaryBayesMapper, EvidentialMapper, PoseJump
from ogm.fusion.deskew import deskew, extrapolate
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io import write_poses
from ogm.pose import Trajectory
from ogm.scan import InverseSensorModel

if TYPE_CHECKING:
    from ogm.cli.movie import Movie

__all__ = ["Mapper", "Run", "levelled", "map_all"]

Mapper = EvidentialMapper | BinaryBayesMapper
JUMPS = 3  # in a row, after which the map begins anew at the new place
TURN = 0.5  # [s] by which a drive goes on as it ended, for the points of its last turn


class Seen(NamedTuple):
    """The last scan that was mapped."""

    name: str
    points: NDArray[np.float32]
    grid: EvidentialGrid


@dataclass
class Run:
    """What has been mapped so far.

    Parameters
    ----------
    drive : Drive
    route : Route
    model : InverseSensorModel
    mapper : EvidentialMapper or BinaryBayesMapper
    spec : GridSpec
        What picture and film show, around the vehicle.
    height : float
        Of the sensor above ground [m].
    names : (str, str)
        Of the sensor model and of the rule.
    unbend : bool
        De-skew the points.
    base : Path
        The main output: what is saved at a jump goes beside it.
    """

    drive: Drive
    route: Route
    model: InverseSensorModel
    mapper: Mapper
    spec: GridSpec
    height: float
    names: tuple[str, str]
    unbend: bool
    base: Path
    last: Seen | None = None
    taken: list[int] = field(default_factory=list)  # numbers of the scans that were mapped
    failed: int = 0
    jumps: int = 0  # in a row
    begun: int = 0  # scans after which the map began anew
    restarts: int = 0
    way: float = 0.0  # [m]
    speed: float = math.nan  # [m/s]
    seconds: list[tuple[float, float]] = field(default_factory=list)  # that model and mapper took

    def __post_init__(self) -> None:
        self.trajectory = extrapolate(self.route.trajectory, TURN) if self.unbend else self.route.trajectory

    @property
    def titles(self) -> tuple[str, str, str]:
        """What stands above measurement, map and what the map contradicts."""
        model, rule = self.names
        half_life = self.mapper.half_life
        first = half_life if isinstance(half_life, float) else half_life[0]
        fading = "" if math.isinf(first) else f", half-life {first:g} s"
        other = "conflict" if isinstance(self.mapper, EvidentialMapper) else "map, probability"
        return f"measurement ({Path(model).stem})", f"map ({rule}{fading})", other

    def add(self, k: int) -> None:
        """Map a scan, or raise what is wrong with it; then nothing has changed.

        Raises
        ------
        ValueError, TypeError, OSError
            `PoseJump` among them.
        """
        scan = self.drive.read(k)
        if not self.route.known[k]:
            raise ValueError("nothing tells where and when it was taken")
        stamp, T, points = float(self.route.stamps[k]), self.route.poses[k], scan.points
        if self.unbend:
            if scan.time is None:
                raise ValueError("its points have no times; leave out --deskew")
            points = deskew(points, scan.time, self.trajectory, stamp)
        start = time.perf_counter()
        grid = self.model(replace(scan, points=points))
        between = time.perf_counter()
        self._update(grid, T, stamp)
        self.seconds.append((between - start, time.perf_counter() - between))
        self._travel(k)
        self.taken.append(k)
        self.last = Seen(self.drive.names[k], points, grid)

    def _update(self, grid: EvidentialGrid, T: NDArray[np.float64], stamp: float) -> None:
        T_map_grid = T if self.drive.mount is None else T @ levelled(self.drive.mount)
        try:
            self.mapper.update(grid, T_map_grid, stamp=stamp)
        except PoseJump as jump:
            self.jumps += 1
            if self.jumps < JUMPS:
                raise
            self.restarts += 1
            path = self.base.with_name(f"{self.base.stem}.before-jump-{self.restarts}.npz")
            self.mapper.grid.save(path)
            stderr.print(
                f"ogm: {one_line(jump)}; that is the {JUMPS}rd in a row: the map so far is saved as {path}, a new one "
                "begins here",
                markup=False,
            )
            self.mapper.reset()
            self.mapper.update(grid, T_map_grid, stamp=stamp)
            self.begun = len(self.taken)
        self.jumps = 0

    def _travel(self, k: int) -> None:
        """Count the way since the last scan."""
        self.speed = math.nan
        if len(self.taken) > self.begun:
            last = self.taken[-1]
            way = float(np.hypot(*(self.route.poses[k, :2, 3] - self.route.poses[last, :2, 3])))
            seconds = self.route.stamps[k] - self.route.stamps[last]
            self.way += way
            self.speed = way / seconds if seconds > 0 else math.nan

    def shown(self) -> tuple[tuple[plot.Panel, plot.Panel, plot.Panel], str]:
        """Draw the last measurement, the map as the vehicle sees it and what contradicts it; say where that is."""
        k, view = self.taken[-1], self.mapper.view(self.spec)
        first, second, third = self.titles
        if isinstance(self.mapper, EvidentialMapper):
            other = plot.conflict(self.mapper.conflict_view(self.spec), self.spec, third)
        else:
            other = plot.probability(view, third)
        speed = "" if math.isnan(self.speed) else f"{3.6 * self.speed:.0f} km/h"
        total = str(len(self.drive))
        line = (
            f"{k + 1:{len(total)}} of {total}   {_shortened(self.drive.names[k])}   {self.elapsed:.1f} s   "
            f"{speed:>8}   map: {shares(view)}"
        )
        return (plot.masses(self.seen.grid, first), plot.masses(view, second), other), line

    @property
    def seen(self) -> Seen:
        """The last scan that was mapped."""
        if self.last is None:
            raise ValueError("no scan was mapped")
        return self.last

    @property
    def elapsed(self) -> float:
        """Time from the first to the last scan that was mapped [s]."""
        return float(self.route.stamps[self.taken[-1]] - self.route.stamps[self.taken[0]])

    def save_picture(self, path: Path) -> None:
        """Draw the last scan and the map around it."""
        title = f"{_shortened(self.seen.name)}, {self.elapsed:.1f} s"
        cloud = plot.points(self.seen.points, self.spec, title, -self.height)
        plot.save_picture(path, cloud, *self.shown()[0])

    def save_poses(self, path: Path) -> None:
        """Write the poses of the scans that were mapped."""
        stamps, first = np.unique(self.route.stamps[self.taken], return_index=True)
        rows = np.array(self.taken)[first]
        numbers = self.drive.numbers
        wanted = numbers[rows] if numbers is not None and path.suffix.lower() == ".csv" else None
        write_poses(path, Trajectory(stamps, self.route.poses[rows]), wanted)

    def facts(self) -> dict[str, str]:
        """Say what was done, for a person."""
        stamps = self.route.stamps[self.taken]
        model, mapper = (1e3 * median(one) for one in zip(*self.seconds, strict=True))
        spec, grid = self.mapper.spec, self.mapper.grid
        facts = {
            "scans": f"{len(self.taken)} mapped, {self.failed} skipped",
            "time": f"{np.ptp(stamps):.1f} s",
            "path": f"{self.way:.1f} m",
            f"{Path(self.names[0]).stem}": f"{model:.1f} ms/scan",
            "mapper": f"{mapper:.1f} ms/scan",
            "map": f"{spec.shape[0]} x {spec.shape[1]} cells of {spec.resolution:g} m: {shares(grid)}",
        }
        if self.restarts:
            facts["begun anew"] = f"{self.restarts} x, after jumps of the pose"
        return facts


def map_all(run: Run, film: "Movie | None") -> int:
    """Map all scans of a drive.

    Parameters
    ----------
    run : Run
    film : Movie, optional
        Gets a frame per scan.

    Returns
    -------
    int
        The exit code: 0, 2 if scans were skipped or an error ended the loop, 130 if the user did.
    """
    numbers = track(range(len(run.drive)), "mapping", console=stderr, transient=True)
    try:
        for k in numbers:
            try:
                run.add(k)
            except UNREADABLE as error:
                run.failed += 1
                stderr.print(f"ogm: {run.drive.names[k]} is skipped: {one_line(error)}", markup=False)
                continue
            if film is not None:
                film.add(run.seen.points, *run.shown(), float(run.route.stamps[k]))
    except KeyboardInterrupt:
        stderr.print(f"ogm: interrupted after {len(run.taken)} scans; what there is gets written")
        return 130
    except Exception as error:  # whatever it is, the map so far must not be lost
        stderr.print(
            f"ogm: {one_line(error)}: stopped after {len(run.taken)} scans; what there is gets written",
            markup=False,
        )
        return 2
    return 2 if run.failed else 0


def shares(grid: EvidentialGrid) -> str:
    """Put the mean masses of a grid in words."""
    parts = (("free", grid.free), ("occupied", grid.occupied), ("unknown", grid.unknown))
    return ", ".join(f"{name} {100 * float(mass.mean()):4.1f} %" for name, mass in parts)


def levelled(mount: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what takes the levelled frame around the sensor, in which the grids lie, to the sensor's own."""
    T = np.eye(4)
    T[:3, :3] = mount[:3, :3].T
    return T


def _shortened(name: str, most: int = 28) -> str:
    return name if len(name) <= most else f"{name[: most - 15]}...{name[-12:]}"

"""State of fusing one drive, with its pictures, files and report."""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from ogm import plot
from ogm.datasets import Dataset, frame_numbers
from ogm.dynamic_grid import DynamicGrid
from ogm.fusion import BinaryBayesMapper, DynamicMapper, FusionStep, Mapper
from ogm.fusion.pipeline import MAX_TURN, turn_within_scan
from ogm.geometric.inputs import explain_nothing, shows_nothing
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io import GridLog, PlacedGrid, write_poses
from ogm.io.messages import StampedTransform
from ogm.models.named import part_for, title_of
from ogm.plot import Panel
from ogm.plot.movie import Movie
from ogm.plot.moving import moving_groups
from ogm.pose import Trajectory, inverse, pose
from ogm.scan import Boxes, Frame
from ogm.storage.files import DISK_ERRORS, error_text
from ogm.workflows.buildings import first_readable
from ogm.workflows.findings import without_numbers

ARROW_SECONDS = 1.0  # [s] of motion shown by an arrow
_LISTED = 3  # listed scans that are skipped for the same reason


@dataclass
class FusionRun:
    """Progress of fusing a drive.

    Parameters
    ----------
    dataset : Dataset
    mapper : Mapper
    spec : GridSpec
        Cells of picture and film, around the vehicle.
    names : (str, str)
        Names of sensor model and rule.
    base : Path
        Main output; maps before a restart are saved in its folder.
    warn : function
        Called with messages about scans.

    Attributes
    ----------
    last : FusionStep or None
        Last mapped step.
    mapped : list of int
        Numbers of the mapped frames.
    failed : int
        Number of skipped frames.
    stop_reason : str
        Reason of an early end; "" if all frames were read.
    interrupted : bool
        Whether an interrupt is the reason of the end.
    """

    dataset: Dataset
    mapper: Mapper
    spec: GridSpec
    names: tuple[str, str]
    base: Path
    warn: Callable[[str], object]
    last: FusionStep | None = None
    mapped: list[int] = field(default_factory=list)
    track: list[list[float]] = field(default_factory=list)  # x, y of the vehicle in the map [m]
    failed: int = 0
    stop_reason: str = ""
    interrupted: bool = False
    empty_scans: int = 0  # scans without evidence on the grid
    empty_reason: str = ""  # reason for the first of them
    recorded: int = 0  # maps written to a log
    restarts: int = 0
    path: float = 0.0  # [m]
    speed: float = math.nan  # [m/s]
    seconds: list[tuple[float, float]] = field(default_factory=list)  # of model and mapper
    models: dict[str, None] = field(default_factory=dict)  # used parts of the model
    skip_reasons: Counter[str] = field(default_factory=Counter)  # of skipped scans, numbers replaced
    large_turns: list[float] = field(default_factory=list)  # [rad] turns above `MAX_TURN` within scans

    @property
    def ground_z(self) -> float:
        """Height of the ground in the frame of the points [m], by the first frame."""
        mount = self.dataset[0].mount
        return -mount.sensor_height if mount.points_in == "sensor" else mount.ground_point[2]

    @property
    def titles(self) -> tuple[str, str, str]:
        """Titles of the panels: measurement, map and conflict."""
        (model, rule), half_life = self.names, np.ravel(self.mapper.half_life)[0]
        frame = first_readable(self.dataset) if self.last is None else self.last.frame
        model = model if frame is None else title_of(model, frame.scan, frame.mount)
        fading = "" if math.isinf(half_life) else f", half-life {half_life:g} s"
        if isinstance(self.mapper, DynamicMapper):
            fading = f", arrows: {ARROW_SECONDS:g} s"
        other = "conflict" if hasattr(self.mapper, "conflict") else "map, probability"
        return f"measurement ({model})", f"map ({rule}{fading})", other

    @property
    def code(self) -> int:
        """Exit code of a command: 0, 2 after skipped scans or an error, 130 after an interrupt."""
        return 130 if self.interrupted else 2 if self.failed or self.stop_reason else 0

    def map_all(self, steps: Iterable[FusionStep], film: Movie | None, maps: GridLog | None = None) -> None:
        """Map all scans. An interrupt or an error ends the loop; only disk errors of a log are raised."""
        try:
            for k, step in enumerate(steps):
                if step.grid is None:
                    continue
                self.add(k, step)
                if maps is not None:
                    self.record(maps)
                if film is not None:
                    panels, line = self.panels()
                    film.add(step.frame.scan.points, panels, line, float(step.frame.stamp or 0.0))
        except KeyboardInterrupt:
            if maps is not None and self.mapped and not self.recorded:  # a log needs at least one map
                self.record(maps)
            self.interrupted = True
            self.end("interrupted")
        except Exception as error:  # any error: the map so far must not be lost
            if isinstance(error, OSError) and error.errno in DISK_ERRORS:
                raise  # the disk is full or broken for the other outputs, too
            self.end(f"{error_text(error)}: stopped")

    def end(self, reason: str) -> None:
        """Record and report the reason of an early end."""
        self.stop_reason = reason
        kept = f"after {len(self.mapped)} scans; writing the partial result" if self.mapped else "before the first scan"
        self.warn(f"{reason} {kept}")

    def skip(self, frame: Frame, error: Exception) -> None:
        """Count a skipped scan and report the reason."""
        self.failed += 1
        kind = without_numbers(error_text(error).replace(frame.name, ""))
        self.skip_reasons[kind] += 1
        if self.skip_reasons[kind] <= _LISTED:
            more = "; further scans with the same reason are only counted" if self.skip_reasons[kind] == _LISTED else ""
            self.warn(f"{frame.name} is skipped: {error_text(error)}{more}")

    def add(self, k: int, step: FusionStep) -> None:
        """Record a mapped frame, and save the map that a restart would lose."""
        if isinstance(self.mapper, DynamicMapper):
            with suppress(ImportError):  # raised again when objects are drawn
                self.mapper.objects()  # starts the tracking
        self.speed = math.nan
        if step.previous_map is not None:
            self.restarts += 1
            path = self.base.with_name(f"{self.base.stem}.before-jump-{self.restarts}.npz")
            step.previous_map.save(path)
            new_drive = step.restart == "sequence"
            reason = f"{step.frame.sequence} begins" if new_drive else f"{step.restart}, the third in a row"
            self.warn(f"{step.frame.name}: {reason}: the map so far is saved as {path}, a new map begins")
        elif self.last is not None:
            metres = math.dist(step.T_map_grid[:2, 3], self.last.T_map_grid[:2, 3])  # type: ignore[index]
            seconds = (step.frame.stamp or 0.0) - (self.last.frame.stamp or 0.0)
            self.path += metres
            self.speed = metres / seconds if seconds > 0 else math.nan
            turn = turn_within_scan(self.last, step)
            self.large_turns += [turn] if turn > MAX_TURN else []
        if step.grid is not None and shows_nothing(step.frame.scan, step.grid):
            self.empty_reason = self.empty_reason or explain_nothing(step.frame.scan, step.grid.spec, step.frame.mount)
            self.empty_scans += 1
        if step.previous_map is not None:
            self.track.clear()
        self.track.append(step.T_map_grid[:2, 3].tolist())  # type: ignore[index]
        self.mapped.append(k)
        self.seconds.append(step.seconds)
        self.models[part_for(self.names[0], step.frame.scan)] = None
        self.last = step

    def check_shown(self) -> None:
        """Raise a ValueError if no scan has evidence on the grid; report scans without evidence."""
        if self.empty_scans and self.empty_scans == len(self.mapped):
            raise ValueError(f"no scan has evidence on the grid, nothing is written: {self.empty_reason}")
        if self.empty_scans:
            count = f"{self.empty_scans} of {len(self.mapped)} scans"
            self.warn(f"{count} have no evidence on the grid, the first: {self.empty_reason}")

    @property
    def map(self) -> EvidentialGrid | DynamicGrid:
        """The whole map of the mapper."""
        return self.mapper.dynamic_grid if isinstance(self.mapper, DynamicMapper) else self.mapper.grid

    @property
    def conflict(self) -> LayeredGrid | None:
        """Conflict of map and scans, if the mapper stores it."""
        return getattr(self.mapper, "conflict", None)

    @property
    def layers(self) -> LayeredGrid | None:
        """Layers needed to continue the map, in addition to its masses."""
        return getattr(self.mapper, "layers", self.conflict)

    def placed(self, layers: LayeredGrid | None = None) -> PlacedGrid:
        """Return the map with layers, in the frame of the poses, at the height of the ground under the vehicle."""
        assert self.last is not None
        T, mount = self.T_map_vehicle, self.last.frame.mount
        ground_z = float((T @ (*mount.ground_point, 1.0))[2])
        frame = self.dataset.facts.get("frame") or "map"  # logs name the frame of their poses
        return PlacedGrid(self.map, pose(z=ground_z), frame, self.mapper.stamp, layers=layers)

    @property
    def T_map_vehicle(self) -> NDArray[np.float64]:  # noqa: N802
        """Pose of the vehicle at the last scan, (4, 4)."""
        assert self.last is not None
        assert self.last.frame.T_map_sensor is not None
        return self.last.frame.T_map_sensor @ inverse(self.last.frame.mount.T_vehicle_sensor)

    def record(self, maps: GridLog) -> None:
        """Write the map after the last scan and the pose of the vehicle to a log."""
        assert self.last is not None
        layers = None if maps.message == "occupancy-grid" else self.conflict  # occupancy-grid stores no layers
        placed, stamp = self.placed(layers), self.last.frame.stamp or 0.0
        maps.write(placed, [StampedTransform(placed.frame_id, "vehicle", stamp, self.T_map_vehicle)])
        self.recorded += 1

    def panels(self) -> tuple[tuple[Panel, Panel, Panel], str]:
        """Return panels of the last measurement, the map around the vehicle and its conflict, and a line of text."""
        assert self.last is not None
        assert self.last.grid is not None
        view = self.mapper.view(self.spec)
        first, second, third = self.titles
        if isinstance(self.mapper, BinaryBayesMapper):
            other = plot.probability_panel(view, third)
        else:
            other = plot.conflict_panel(self.mapper.conflict_view(self.spec), third)
        if isinstance(self.mapper, DynamicMapper):
            objects = self.objects()
            shown = plot.dynamic_panel(self.mapper.dynamic_view(self.spec), "", ARROW_SECONDS, objects)
            second = f"map ({self.names[1]})" + ("" if objects is None else f", {len(objects)} objects confirmed")
            shown = shown._replace(title=second + (f", arrows: {ARROW_SECONDS:g} s" if len(shown.arrows) else ""))
        else:
            shown = plot.mass_panel(view, second)
        speed = "" if math.isnan(self.speed) else f"{3.6 * self.speed:.0f} km/h"
        total, name = str(len(self.dataset)), _shortened(self.last.frame.name)
        count = f"{self.mapped[-1] + 1:{len(total)}} of {total}"
        line = f"{count}   {name}   {self.elapsed:.1f} s   {speed:>8}   map: {_shares(view)}"
        return (plot.mass_panel(self.last.grid, first), shown, other), line

    def objects(self) -> Boxes | None:
        """Return the moving objects tracked by the map, in the vehicle frame; None for maps without tracking."""
        find = getattr(self.mapper, "objects", None)
        if find is None or self.mapper.T_map_vehicle is None:
            return None
        boxes: Boxes = find().confirmed.boxes
        return boxes.moved(inverse(self.mapper.T_map_vehicle))

    @property
    def elapsed(self) -> float:
        """Time from the first to the last mapped scan [s]."""
        first, last = (self.dataset.refs[k].stamp for k in (self.mapped[0], self.mapped[-1]))
        return (last or 0.0) - (first or 0.0)

    def save_picture(self, path: Path) -> None:
        """Draw the last scan and the map around it."""
        assert self.last is not None
        title = f"{_shortened(self.last.frame.name)}, {self.elapsed:.1f} s"
        cloud = plot.points_panel(self.last.frame.scan.points, self.spec, title, self.ground_z)
        plot.save_picture(path, cloud, *self.panels()[0])

    def save_poses(self, path: Path) -> None:
        """Write the poses of the mapped scans."""
        refs = self.dataset.refs
        stamps, first = np.unique([refs[k].stamp for k in self.mapped], return_index=True)
        rows = np.array(self.mapped)[first]
        numbers = frame_numbers([ref.name for ref in refs])
        wanted = numbers[rows] if numbers is not None and path.suffix.lower() == ".csv" else None
        write_poses(path, Trajectory(stamps, np.array([refs[k].T_map_sensor for k in rows])), wanted)

    def facts(self) -> dict[str, str]:
        """Return a summary as names and values."""
        model, mapper = (f"{1e3 * median(times):.1f} ms/scan" for times in zip(*self.seconds, strict=True))
        spec, grid = self.mapper.spec, self.mapper.grid
        cells = f"{spec.shape[0]} x {spec.shape[1]} cells of {spec.resolution:g} m"
        facts = {
            "scans": f"{len(self.mapped)} mapped, {self.failed} skipped",
            "time": f"{self.elapsed:.1f} s",
            "path": f"{self.path:.1f} m",
            **{"+".join(self.models): model, "mapper": mapper, "map": f"{cells}: {_shares(grid)}"},
        }
        facts |= grid.meta
        if isinstance(self.mapper, DynamicMapper):
            groups = moving_groups(self.mapper.dynamic_grid)
            cells = f"{np.count_nonzero(groups)} cells in {groups.max()} groups"
            facts["moving"] = f"{cells}, by {self.mapper.particles} particles"
        if self.restarts:
            facts["restarts"] = f"{self.restarts}, after jumps of pose or stamp, or with a new sequence"
        return facts


def _shares(grid: EvidentialGrid) -> str:
    """Return the mean masses of a grid as text."""
    parts = (("free", grid.free), ("occupied", grid.occupied), ("unknown", grid.unknown))
    return ", ".join(f"{name} {100 * float(mass.mean()):4.1f} %" for name, mass in parts)


def _shortened(name: str, width: int = 28) -> str:
    """Return the end of a name, at most `width` characters; names in a drive differ at their end."""
    return name if len(name) <= width else f"...{name[3 - width :]}"

"""The dynamic map: belief masses of free, static and dynamic, and velocities, from scans of a moving vehicle.

Static occupancy is a mass of the cell, as in `EvidentialMapper`. Dynamic occupancy is carried by particles. Both
compete in one Dempster update. A static cell is predicted exactly by its own mass, but only roughly by particles, whose
copies leave it and die in cells that scans measure as free. When an object moves on, its cell is measured as free:
static is lost, the particles have moved and survive.

Sources: Nuss et al., "A random finite set approach for dynamic occupancy grid maps with real-time application" (2018).
Static mass in addition to particles: Nègre, Rummelhard and Laugier, "Hybrid sampling Bayesian occupancy filter" (2014);
Tanzmeister and Wollherr, "Evidential grid-based tracking and mapping" (2017).
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion.dynamic.beliefs import beliefs, masses, seen_from
from ogm.fusion.dynamic.cells import (
    CellOutput,
    DynamicCells,
    forget_hidden_free,
    no_cells,
    share_particles,
    update_cells,
)
from ogm.fusion.dynamic.hashed_noise import NORMALS, scan_key
from ogm.fusion.dynamic.measured_velocities import SCAN_AGES, MeasuredVelocities, matched_velocities
from ogm.fusion.dynamic.object_tracker import ObjectTracker
from ogm.fusion.dynamic.objects import Objects, find_objects
from ogm.fusion.dynamic.particles import Step, cell_starts, count_in_cells, no_particles, sort_into_cells
from ogm.fusion.dynamic.prediction import move_on, predict_dynamic
from ogm.fusion.dynamic.radial import with_radial_velocities
from ogm.fusion.dynamic.resampling import Moments, resample
from ogm.fusion.dynamic.scan_history import Extent, ScanHistory, scan_cells, scan_states
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.fusion.dynamic.velocity_evidence import GroupVelocities, group_velocities, renew_particles, weigh_motion
from ogm.fusion.kernels import BLOCK, DEMPSTER, BeliefLayers, Memory, evidential_update
from ogm.fusion.lookup import ScanLookup
from ogm.fusion.mapper import Mapper, locked
from ogm.fusion.update_gate import CheckedScan, UpdateGate
from ogm.fusion.window import Window, WindowMode, check_choice
from ogm.grid import EvidentialGrid, GridSpec
from ogm.threads import Threads, spans

_log = logging.getLogger(__name__)

DynamicFilter = Literal["hybrid", "nuss"]
MAX_PARTICLES = 2**25  # 1.2 GB

_BORDER = 1.0  # [cells] from the border of a measurement grid within which cells are only partly measured


class DynamicMapper(Mapper):
    """Map of free, static and dynamic masses with velocities, which fuses scan after scan.

    Parameters
    ----------
    spec : GridSpec
        The window: relative to the vehicle if it rolls, in map coordinates if it is fixed.
    particles : int
        Number of particles that carry the belief in dynamic, 1 to 2**25.
    filter : {"hybrid", "nuss"}
        "nuss": all occupied mass is carried by particles, as in Nuss et al., and static is 0.
    matching : bool, optional
        Whether velocities of groups of occupied cells are measured by matching them with earlier scans. By default only
        in the hybrid filter.
    window, max_speed, max_delay
        See `EvidentialMapper`.
    seed : int
        Seed of the random numbers. Results are identical for one seed, with any number of threads.
    threads : int
        Number of threads of an update.
    settings : DynamicSettings, optional
        Parameters of the model.

    Raises
    ------
    ValueError
        If a number is out of its range, or a name is not one of the choices.

    Notes
    -----
    Stamps, poses, jumps and reading threads are treated as in `EvidentialMapper`; every scan needs a stamp. A scan of
    the same moment ages and moves nothing. A late scan moves and creates no particles: it is first aged to the map's
    time, and changes cells with more free or static than dynamic. After an error the map is unchanged.

    Planes. A cell has one mass of free. A laser that is free only in its plane (`EvidentialGrid.in_plane`) would clear
    obstacles that other sensors see above and below it. So its free cells count in maps of planar lasers only. At the
    first scan of another sensor they are forgotten. From then on planar scans add occupied cells only, with a warning;
    `EvidentialMapper` keeps both.

    Radial velocities (`update`) measure one velocity component of the cells in which they lie. A scan with radial
    velocities, even without moving ones, is treated as a radar scan: it is not matched with other scans, unless
    `RadialVelocities.dense` is set.
    """

    particles: int
    filter: DynamicFilter
    matching: bool
    seed: int
    threads: int
    settings: DynamicSettings

    def __init__(
        self,
        spec: GridSpec,
        particles: int = 200_000,
        *,
        filter: DynamicFilter = "hybrid",  # noqa: A002
        matching: bool | None = None,
        window: WindowMode = "rolling",
        max_speed: float = 70.0,
        max_delay: float = 0.5,
        seed: int = 0,
        threads: int = 1,
        settings: DynamicSettings | None = None,
    ) -> None:
        if not 1 <= particles <= MAX_PARTICLES or particles != int(particles):
            raise ValueError(
                f"particles must be a whole number from 1 to {MAX_PARTICLES} (1.2 GB), got {particles}; for a map "
                "without dynamic cells use EvidentialMapper"
            )
        if not threads >= 1 or threads != int(threads):
            raise ValueError(f"threads must be a whole number of at least 1, got {threads}")
        self.particles, self.filter = int(particles), check_choice("filter", filter, DynamicFilter)
        self.matching = self.filter == "hybrid" if matching is None else bool(matching)
        self.seed, self.threads = int(seed), int(threads)
        self.settings = settings or DynamicSettings()
        if self.filter == "nuss":
            self.settings = replace(
                self.settings, static_share=0.0, to_dynamic_rate=0.0, motion_odds=1.0, hiding_width=0.0
            )
        self.half_life = self.settings.free_half_life, self.settings.static_half_life
        super().__init__(Window(spec, window), UpdateGate(max_speed, max_delay, needs_stamps=True))
        nx, ny = spec.shape
        self._cells, self._next_cells = no_cells(spec.shape), no_cells(spec.shape)
        self._particles, self._predicted = (no_particles(self.particles + 1, nx * ny) for _ in range(2))
        self._particle_mass = 0.0
        self._moments = Moments(np.zeros((nx, ny, 2), np.float32), np.zeros((nx, ny, 3), np.float32))
        self._measured = np.empty((nx, 2 * ny), np.float32)
        self._cell_of, self._survivors = np.empty(self.particles + 1, np.int32), np.empty(nx * ny, np.int32)
        self._count_of, self._no_label = np.empty((self.threads, nx * ny), np.int32), np.zeros(spec.shape, np.int32)
        self._no_velocities = MeasuredVelocities(
            self._no_label, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, bool)
        )
        self._groups = group_velocities(*self._no_velocities, 0.0, 0.0)
        self._history = ScanHistory(0.6, 0.04)
        self._tracker: ObjectTracker | None = None  # made by the first call of `objects`
        self._objects: Objects | None = None
        self._beyond_plane = False  # whether a scan was fused that is not in-plane
        self._warned = False  # whether the warning about planar scans was logged

    def __repr__(self) -> str:
        return f"DynamicMapper({self.filter}, {self.particles} particles, {self.scans} scans, {self.spec})"

    @locked
    def reset(self) -> None:
        """Forget everything: the next scan begins a new map."""
        super().reset()
        self._history.clear()
        self._objects, self._beyond_plane = None, False
        if self._tracker is not None:
            self._tracker.reset()

    @property
    @locked
    def grid(self) -> EvidentialGrid:
        """Masses of free and of occupied, static or dynamic, after the last scan (a copy), in map coordinates."""
        cells = self._cells
        occupied = cells.static + (cells.surviving + cells.born)
        return EvidentialGrid.trusted(self.spec, np.stack([cells.free, occupied], axis=-1))

    @property
    @locked
    def dynamic_grid(self) -> DynamicGrid:
        """The map after the last scan (a copy), in map coordinates."""
        return DynamicGrid.trusted(self.spec, *beliefs(self._cells, self._moments, self._groups))

    @locked
    def dynamic_view(self, spec: GridSpec | None = None, T_map_vehicle: ArrayLike | None = None) -> DynamicGrid:
        """Return the map with velocities in the vehicle's axes, by nearest cells. For the arguments see `view`."""
        cells, T = self._around(spec, T_map_vehicle)
        belief = beliefs(self._cells, self._moments, self._groups, still=0.0)
        return seen_from(belief, self.spec, cells, T)

    @locked
    def objects(self) -> Objects:
        """Return the moving objects after the last scan, in map coordinates.

        They are tracked from the first call on: `Objects.boxes.track` numbers objects that were found in three of their
        last five scans, and `Objects.confirmed` selects these. Updates then take 2 to 3 ms longer.

        Raises
        ------
        ImportError
            If filterpy, which the tracker needs, is missing.
        """
        if self._tracker is None:
            self._tracker = ObjectTracker()
            self._update_objects(self.stamp)
        return find_objects(self.dynamic_grid) if self._objects is None else self._objects

    @locked
    def predicted(self, seconds: float) -> DynamicGrid:
        """Return the map predicted some time after the last scan, without further measurements; see `predict_dynamic`.

        Objects turn at their recent turn rates if they are tracked, see `objects`.

        Parameters
        ----------
        seconds : float
            Time after the last scan [s], 0 or more. Reliable to about 0.5 s: see docs/dynamic.md.
        """
        if self._objects is None or not 0 < seconds < math.inf:
            return predict_dynamic(self.dynamic_grid, self._particles, seconds, self._objects)
        return move_on(self.spec, masses(self._cells), self._particles, self._objects, seconds)

    def _update_objects(self, stamp: float | None) -> None:
        """Update the tracker, if there is one, with the objects of the map."""
        if self._tracker is not None and stamp is not None:
            self._objects = self._tracker.update(find_objects(self.dynamic_grid), stamp)

    def _fuse(self, grid: EvidentialGrid, scan: CheckedScan, reliability: float) -> None:
        lookup = ScanLookup(self._usable(grid), scan.affine, scan.samples)
        if scan.elapsed < 0:
            self._fuse_late(lookup, -scan.elapsed, reliability)
            return
        nx, old = self._window.spec0.shape[0], self._window.corner
        shift = scan.corner[0] - old[0], scan.corner[1] - old[1]
        step = self._step(scan.elapsed, shift)
        rates = self.settings.rates(scan.elapsed, reliability, self._particle_mass)
        new = CellOutput(self._next_cells, self._measured, np.empty(nx))
        with Threads(self.threads) as threads:
            self._count(step, threads)
            rows, start = spans(nx, self.threads), self._predicted.start

            def sort_and_update(k: int) -> None:  # the two are independent
                self._sort(step, k)
                update_cells(self._cells, shift, start, lookup, rates, rows[k], new)

            threads.run(sort_and_update)
            self._restart_beyond_border(scan, new)
            states = scan_states(self._measured) if self.matching and _shows_shapes(scan) else None
            groups = self._measured_velocities(scan, states, new.cells)
            if len(groups.rows) > 1:
                threshold = self.settings.renewal_likelihood
                threads.run(lambda k: weigh_motion(new.cells, groups, rows[k], new.dynamic))
                threads.run(lambda k: renew_particles(new.cells, self._predicted, groups, threshold, rows[k]))
            if self.settings.hiding_width and _shows_shapes(scan):
                forget_hidden_free(new.cells, new.measured, self.settings.hiding_width / self._window.spec0.resolution)
            # The map has not changed so far; the following steps cannot fail.
            self._particle_mass = float(new.dynamic.sum()) / self.particles
            self._draw(new.cells, groups, step, threads)
        self._groups = groups
        self._cells, self._next_cells = new.cells, self._cells
        self._window.move_to(scan.corner)
        if scan.stamp is not None:
            self._history.add_grid(scan.stamp, scan.corner, Extent(scan.affine, grid.spec.shape))
            if states is not None:
                self._history.add(scan.stamp, scan.corner, states)
        self._update_objects(scan.stamp)

    def _usable(self, grid: EvidentialGrid) -> NDArray[np.float32]:
        """Return the masses of a scan; forget free of planes at the first scan of another sensor."""
        if grid.in_plane and self._beyond_plane:
            if not self._warned:
                self._warned = True
                _log.warning(
                    "a dynamic map gets scans of a planar laser and of other sensors: the free cells of the laser are "
                    "ignored, as they would clear obstacles above and below its plane; evidential rules keep both"
                )
            return grid.mass * np.array([0, 1], np.float32)
        if not (grid.in_plane or self._beyond_plane):
            self._cells.free[:] = 0  # so far from planar scans only
            self._beyond_plane = True
        return np.ascontiguousarray(grid.mass)

    def _restart_beyond_border(self, scan: CheckedScan, new: CellOutput) -> None:
        """Treat occupied mass as newly appeared in cells that no earlier scan reached.

        An object that continues past the border of a measurement grid seems to end there, and this end moves with the
        vehicle. Particles of the vehicle's speed would be confirmed by every scan.
        """
        cells, moved = new.cells, np.nonzero(new.cells.surviving)
        reached = self._history.reached(scan.corner, np.stack(moved), _BORDER)
        rows, columns = (index[~reached] for index in moved)
        occupied = cells.static[rows, columns] + cells.surviving[rows, columns] + cells.born[rows, columns]
        cells.static[rows, columns] = self.settings.static_share * occupied
        cells.born[rows, columns] = (1 - self.settings.static_share) * occupied
        cells.surviving[rows, columns] = 0
        changed = np.unique(rows)
        new.dynamic[changed] = (cells.surviving[changed] + cells.born[changed]).sum(axis=1, dtype=np.float64)

    def _count(self, step: Step, threads: Threads) -> None:
        """Move the particles and count them in their new cells, with all threads."""
        p, cell_of, count = self._particles, self._cell_of, self._count_of
        parts = spans(int(p.start[-1]), self.threads)
        threads.run(lambda k: count_in_cells(p, parts[k], step, NORMALS, cell_of, count[k]))
        cell_starts(count, self._predicted.start)

    def _sort(self, step: Step, k: int) -> None:
        """Sort the particles of a thread by their new cells."""
        p, part = self._particles, spans(int(self._particles.start[-1]), self.threads)[k]
        sort_into_cells(p, part, step, NORMALS, self._cell_of, self._count_of[k], self._predicted)

    def _draw(self, cells: DynamicCells, groups: GroupVelocities, step: Step, threads: Threads) -> None:
        """Draw the new particles of every cell, and compute its mean velocity and covariance."""
        old, new, survivors = self._predicted, self._particles, self._survivors
        offset = float(step.key >> np.uint64(11)) * 2.0**-53
        masses = cells.surviving.reshape(-1), cells.born.reshape(-1)
        share_particles(masses, self._particle_mass, offset, self.particles + 1, survivors, new.start)
        threads.divide(
            len(survivors), lambda part: resample(old, part, survivors, groups, step, NORMALS, new, self._moments)
        )

    def _measured_velocities(
        self, scan: CheckedScan, states: NDArray[np.uint8] | None, cells: DynamicCells
    ) -> GroupVelocities:
        """Return the measured velocities of groups of cells, from matching and from Doppler."""
        settings, resolution = self.settings, self._window.spec0.resolution
        found = self._no_velocities
        if states is not None and scan.stamp is not None:
            earlier = self._history.earlier(scan.stamp, scan.corner, SCAN_AGES)
            if earlier:
                found = matched_velocities(scan_cells(states, 0.0), cells, self._predicted, earlier, resolution)
        if scan.radial is not None and len(scan.radial.speed):
            window = self._window.spec_at(scan.corner)
            found = with_radial_velocities(found, scan.radial, self._measured, cells, window)
        numbers = settings.birth_speed, settings.association, settings.motion_odds
        return group_velocities(*found, *numbers)

    def _fuse_late(self, lookup: ScanLookup, seconds: float, reliability: float) -> None:
        """Fuse a scan older than the map into free and static, in cells that hold more free or static than dynamic."""
        cells, known = self._cells, np.float32(1 - self.settings.min_unknown)
        nx, ny = cells.free.shape
        mass, no_conflict = np.stack([cells.free, cells.static], axis=-1), np.zeros((nx, 2 * ny), np.float32)
        rates = self.settings.rates(seconds, reliability, 0.0)
        aged = lookup._replace(values=lookup.values * np.array([rates.keep_free, rates.keep_static]))
        layers = BeliefLayers(mass.reshape(nx, 2 * ny), no_conflict, np.zeros((nx, -(-ny // BLOCK))))
        forever = Memory(*(math.inf,) * 4, False, False, 0.0, 0.0)
        evidential_update(layers, (0, 0), aged, float(reliability), forever, DEMPSTER, float(known))
        if self.filter == "nuss":
            mass[..., 1] = 0
        dynamic = cells.surviving + cells.born
        rest = known - dynamic
        mass *= np.minimum(1, rest / np.maximum(mass.sum(axis=-1), np.maximum(rest, 1e-9)))[..., np.newaxis]
        changed = (dynamic <= np.maximum(cells.free, cells.static)) & (rest > 0)
        cells.free[changed], cells.static[changed] = mass[changed, 0], mass[changed, 1]

    def _step(self, seconds: float, shift: tuple[int, int]) -> Step:
        spec = self._window.spec0
        metres = np.float32(shift[0] * spec.resolution), np.float32(shift[1] * spec.resolution)
        key, noise = scan_key(self.seed, self.scans), self.settings.noise(seconds)
        return Step(np.float32(seconds), metres, noise, np.float32(spec.resolution), spec.shape, key)

    @property
    def _layers(self) -> Sequence[NDArray[np.generic]]:
        return (*self._cells, *self._next_cells, self._particles.start)

    def _conflict_layers(self) -> NDArray[np.float32]:
        return np.stack([self._cells.to_occupied, self._cells.to_free], axis=-1)


def _shows_shapes(scan: CheckedScan) -> bool:
    """Return whether a scan is matched with others: radar scans hold single detections without shapes."""
    return scan.radial is None or scan.radial.dense

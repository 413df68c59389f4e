"""Slow reference of the filter of `ogm.fusion.DynamicMapper`, in plain numpy.

It follows the formulas of the documentation with numpy's sums, and sorts particles by argsort. It draws the same random
numbers as the kernels (`hashed_noise`), so both filters hold the same particles up to rounding. `tests/fusion`
compares the two, and `dynamic_speed.py` times them.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtri
from scipy.stats import multivariate_normal

from ogm.fusion.dynamic.settings import DynamicSettings

Array = NDArray[np.floating]
TABLE = ndtri((np.arange(4096) + 0.5) / 4096)
TABLE = (TABLE / TABLE.std()).astype(np.float32)


def split_mix(number: NDArray[np.integer], key: np.uint64) -> NDArray[np.uint64]:
    """Return the hash of numbers and a key (SplitMix64)."""
    z = (number.astype(np.uint64) + key) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def bits(h: NDArray[np.uint64], k: int) -> NDArray[np.int64]:
    """Return the k-th group of 12 bits of a hash."""
    return ((h >> np.uint64(12 * k)) & np.uint64(4095)).astype(np.int64)


@dataclass
class MeasuredGroups:
    """Measured velocities: label (nx, ny) from 1 on, velocity (G, 2), information (G, 2, 2), resting (G,)."""

    label: NDArray[np.int32]
    velocity: Array
    information: Array
    resting: NDArray[np.bool_]


@dataclass
class NumpyFilter:
    """State of the filter on a window of cells; `update` makes one step.

    Parameters
    ----------
    shape : (int, int)
    resolution : float
        Side of a cell [m].
    particles : int
    settings : DynamicSettings
        Parameters; Nuss' filter has `static_share` and `to_dynamic_rate` of 0.
    """

    shape: tuple[int, int]
    resolution: float
    particles: int
    settings: DynamicSettings
    mass: float = 0.0  # of one particle
    state: Array = field(default_factory=lambda: np.empty((4, 0), np.float32))  # x, y, vx, vy

    def __post_init__(self) -> None:
        self.free, self.static, self.dynamic, self.to_occupied, self.to_free = np.zeros((5, *self.shape))
        self.mean, self.covariance = np.zeros((*self.shape, 2)), np.zeros((*self.shape, 3))

    def update(
        self,
        measured: Array,
        seconds: float,
        key: np.uint64,
        shift: tuple[int, int] = (0, 0),
        groups: MeasuredGroups | None = None,
        reached: NDArray[np.bool_] | None = None,
    ) -> None:
        """Make one step with the masses (nx, ny, 2) of a scan; mass in cells not in `reached` counts as new."""
        for name in ("free", "static", "to_occupied", "to_free"):
            setattr(self, name, self._scrolled(getattr(self, name), shift))
        cell = self._predict(seconds, key, shift)
        surviving, born = self._update_cells(measured.astype(np.float64), seconds, cell)
        if reached is not None:
            new, occupied = ~reached & (surviving > 0), self.static + surviving + born
            self.static = np.where(new, self.settings.static_share * occupied, self.static)
            born = np.where(new, (1 - self.settings.static_share) * occupied, born)
            surviving = np.where(new, 0, surviving)
        surviving, born = self._weigh_motion(surviving, born, groups)
        surviving, born = self._renew(surviving, born, cell, groups)
        self.dynamic = surviving + born
        self._forget_hidden_free(measured)
        self._draw(surviving.reshape(-1), born.reshape(-1), cell, key, groups)

    def _scrolled(self, layer: Array, shift: tuple[int, int]) -> Array:
        """Return the layer of a window after a move by whole cells."""
        out = np.zeros_like(layer)
        for i in range(max(0, -shift[0]), min(self.shape[0], self.shape[0] - shift[0])):
            first, last = max(0, -shift[1]), min(self.shape[1], self.shape[1] - shift[1])
            if first < last:
                out[i, first:last] = layer[i + shift[0], first + shift[1] : last + shift[1]]
        return out

    def _predict(self, seconds: float, key: np.uint64, shift: tuple[int, int]) -> NDArray[np.int64]:
        """Move the particles by constant velocity and noise, sort them by cell; return their cells."""
        h = split_mix(np.arange(self.state.shape[1]), key)
        noise = np.stack([TABLE[bits(h, k)] for k in range(4)])
        root = math.sqrt(seconds)
        position = np.float32(self.settings.position_noise * root)
        velocity = np.float32(self.settings.velocity_noise * root)
        by = np.array([[cells * self.resolution] for cells in shift], np.float32)
        self.state[:2] = self.state[:2] + self.state[2:] * np.float32(seconds) + position * noise[:2] - by
        self.state[2:] += velocity * noise[2:]
        u = np.floor(self.state[:2] * (np.float32(1) / np.float32(self.resolution))).astype(np.int64)
        inside = (u >= 0).all(axis=0) & (u[0] < self.shape[0]) & (u[1] < self.shape[1])
        cell = u[0, inside] * self.shape[1] + u[1, inside]
        order = np.argsort(cell, kind="stable")
        self.state = self.state[:, inside][:, order]
        sorted_cells: NDArray[np.int64] = cell[order]
        return sorted_cells

    def _update_cells(self, z: Array, seconds: float, cell: NDArray[np.int64]) -> tuple[Array, Array]:
        """Combine prediction and scan; return the surviving and the new dynamic mass."""
        s, known = self.settings, 1 - self.settings.min_unknown
        count = np.bincount(cell, minlength=self.shape[0] * self.shape[1]).reshape(self.shape)
        static = 0.5 ** (seconds / s.static_half_life) * self.static
        dynamic = np.minimum(0.5 ** (seconds / s.dynamic_half_life) * self.mass * count, known - static)
        before = static + dynamic
        free = np.minimum(0.5 ** (seconds / s.free_half_life) * self.free, known - before)
        unknown, z_unknown = 1 - free - before, 1 - z.sum(axis=-1)
        conflict_free, conflict_occupied = free * z[..., 1], before * z[..., 0]
        joint_free = free * (z[..., 0] + z_unknown) + unknown * z[..., 0]
        joint_occupied = before * (z[..., 1] + z_unknown) + unknown * z[..., 1]
        whole = 1 - conflict_free - conflict_occupied
        total = (joint_free + joint_occupied) / whole
        scale = np.minimum(1, known / np.maximum(total, 1e-12)) / whole
        self.free, occupied = joint_free * scale, joint_occupied * scale
        birth = (1 - math.exp(-s.birth_rate * seconds)) * (1 - before)
        with np.errstate(invalid="ignore", divide="ignore"):
            born = np.where(before + birth > 0, occupied * birth / (before + birth), occupied)
            share = np.where(before > 0, (occupied - born) / before, 0)
        static = share * static + s.static_share * born
        leaves = (1 - math.exp(-s.to_dynamic_rate * seconds)) * static
        self.static = static - leaves
        keep = 0.5 ** (seconds / s.conflict_half_life)
        self.to_occupied = np.maximum(keep * self.to_occupied, conflict_free)
        self.to_free = np.maximum(keep * self.to_free, conflict_occupied)
        return share * dynamic, (1 - s.static_share) * born + leaves

    def _weigh_motion(self, surviving: Array, born: Array, groups: MeasuredGroups | None) -> tuple[Array, Array]:
        """Multiply the odds of dynamic by the likelihood ratio of a measured velocity, within bounds."""
        dynamic = surviving + born
        if groups is None:
            return surviving, born
        ratio, wide = [1.0], np.eye(2) * self.settings.birth_speed**2
        max_log_odds = math.log(self.settings.motion_odds)
        for v, information, rests in zip(groups.velocity, groups.information, groups.resting, strict=True):
            value = 1.0
            if np.linalg.matrix_rank(information) == 2:
                noise = np.linalg.inv(information)
                moving, still = multivariate_normal([0, 0], noise + wide), multivariate_normal([0, 0], noise)
                log_ratio = moving.logpdf(v) - still.logpdf(v)
                value = math.exp(np.clip(log_ratio, -max_log_odds if rests else 0, max_log_odds))
            ratio.append(value)
        odds = np.array(ratio)[groups.label] * dynamic / np.maximum(self.static, 1e-300)
        occupied = self.static + dynamic
        more = np.where(self.static > 0, occupied * odds / (1 + odds), dynamic)
        self.static = occupied - more
        factor = more / np.maximum(dynamic, 1e-300)
        return surviving * factor, born * factor

    def _renew(
        self, surviving: Array, born: Array, cell: NDArray[np.int64], groups: MeasuredGroups | None
    ) -> tuple[Array, Array]:
        """Turn surviving mass into births if the particles do not explain the measurement."""
        if groups is None:
            return surviving, born
        a, threshold = self.settings.association, self.settings.renewal_likelihood
        chance, row = self._chances(cell, groups)
        size = np.bincount(cell, minlength=len(row))
        likely = np.bincount(cell, (chance - 1 + a) / a, len(row)) / np.maximum(size, 1)
        measured = np.append(False, groups.information.any(axis=(1, 2)))[row] & (size > 0)
        renewed = np.where(measured, a * threshold / (threshold + likely), 0).reshape(self.shape) * surviving
        return surviving - renewed, born + renewed

    def _forget_hidden_free(self, measured: Array) -> None:
        """Limit free by the scan near cells that it measures as occupied, if they are more dynamic than static."""
        seen = np.argwhere((measured[..., 1] > 0.5) & (self.dynamic > self.static))
        if self.settings.hiding_width and len(seen):
            near = cKDTree(seen).query(np.argwhere(np.ones(self.shape)))[0].reshape(self.shape)
            hidden = near <= self.settings.hiding_width / self.resolution + 1e-9
            self.free = np.where(hidden, np.minimum(self.free, measured[..., 0]), self.free)

    def _draw(
        self, surviving: Array, born: Array, cell: NDArray[np.int64], key: np.uint64, groups: MeasuredGroups | None
    ) -> None:
        """Draw each cell's new particles: survivors systematically from its old ones, births at random."""
        cells = len(surviving)
        self.mass = float((surviving + born).sum()) / self.particles
        scale = 2.0**32 / self.mass if self.mass > 0 else 0.0
        offset = int(float(key >> np.uint64(11)) * 2.0**-53 * 2.0**32)
        units = np.stack([surviving, born], axis=1).reshape(-1) * scale
        copies = np.diff((np.cumsum(units.astype(np.int64)) + offset) >> 32, prepend=0).reshape(-1, 2)
        n = np.bincount(cell, minlength=cells)
        first = np.concatenate([[0], np.cumsum(n)[:-1]])
        chance, row = self._chances(cell, groups)
        self._moments(chance, cell, n)
        self._mix_births(surviving, born, row, groups)
        # Systematic resampling: within a cell, one particle per total / kept of the summed chances.
        kept = copies[:, 0]
        owner = np.repeat(np.arange(cells), kept)
        number = np.arange(kept.sum()) - np.repeat(np.cumsum(kept) - kept, kept)
        h = split_mix(np.arange(cells), ~key ^ np.uint64(0x5851F42D4C957F2D))
        start = (bits(h, 0) + 0.5) / 4096
        summed = np.cumsum(chance)
        base = np.concatenate([[0.0], summed])[first]
        total = np.bincount(cell, chance, cells)
        wanted = base[owner] + (number + start[owner]) * total[owner] / kept[owner]
        source = np.minimum(np.searchsorted(summed, wanted, side="right"), first[owner] + n[owner] - 1)
        survivors = self.state[:, np.maximum(source, first[owner])] if len(owner) else np.empty((4, 0), np.float32)
        births = self._births(copies, key, row, groups)
        cells_of_new = np.concatenate([owner, np.repeat(np.arange(cells), copies[:, 1])])
        self.state = np.concatenate([survivors, births], axis=1)[:, np.argsort(cells_of_new, kind="stable")]

    def _chances(self, cell: NDArray[np.int64], groups: MeasuredGroups | None) -> tuple[Array, NDArray[np.int64]]:
        """Return the weight of every particle in the draw, and the group of every cell (0 for none)."""
        chance, row = np.ones(len(cell)), np.zeros(self.shape[0] * self.shape[1], np.int64)
        if groups is not None:
            row = groups.label.reshape(-1).astype(np.int64)
            group = row[cell]
            off = np.where(group > 0, 1, 0)[:, None] * (self.state[2:].T - groups.velocity[group - 1])
            distance = np.einsum("ki,kij,kj->k", off, groups.information[group - 1], off)
            a = self.settings.association
            chance = np.where(group > 0, 1 - a + a * np.exp(-0.5 * distance), 1.0)
        return chance, row

    def _moments(self, chance: Array, cell: NDArray[np.int64], n: NDArray[np.int64]) -> None:
        cells, v = len(n), self.state[2:].astype(np.float64)
        total = np.maximum(np.bincount(cell, chance, cells), 1e-300)
        mean = np.stack([np.bincount(cell, chance * component, cells) / total for component in v])
        dx, dy = v - mean[:, cell]
        parts = [np.bincount(cell, chance * product, cells) / total for product in (dx * dx, dx * dy, dy * dy)]
        self.mean, self.covariance = mean.T.reshape(*self.shape, 2), np.stack(parts, -1).reshape(*self.shape, 3)

    def _mix_births(self, surviving: Array, born: Array, row: NDArray[np.int64], groups: MeasuredGroups | None) -> None:
        """Set the moments to the mixture of survivors and births."""
        mean, covariance = self._birth_normals(groups)
        parts = np.stack([surviving, born]) / np.maximum(surviving + born, 1e-300)
        own = self.covariance.reshape(-1, 3)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        means = np.stack([self.mean.reshape(-1, 2), mean[row]])
        mixed = np.einsum("kc,kci->ci", parts, means)
        off = means - mixed
        both = np.stack([own, covariance[row]]) + np.einsum("kci,kcj->kcij", off, off)
        whole = np.einsum("kc,kcij->cij", parts, both).reshape(-1, 4)[:, [0, 1, 3]]
        self.mean, self.covariance = mixed.reshape(*self.shape, 2), whole.reshape(*self.shape, 3)

    def _birth_normals(self, groups: MeasuredGroups | None) -> tuple[Array, Array]:
        """Return mean and covariance of the velocity of births, first without a group, then in each group."""
        wide = np.eye(2) * self.settings.birth_speed**2
        if groups is None:
            return np.zeros((1, 2)), wide[np.newaxis]
        covariance = np.linalg.inv(np.linalg.inv(wide) + groups.information)
        mean = np.einsum("gij,gjk,gk->gi", covariance, groups.information, groups.velocity)
        return np.concatenate([np.zeros((1, 2)), mean]), np.concatenate([wide[np.newaxis], covariance])

    def _births(
        self, copies: NDArray[np.int64], key: np.uint64, row: NDArray[np.int64], groups: MeasuredGroups | None
    ) -> Array:
        """Return new particles, uniform in their cells, with velocities from the group's measurement or from none."""
        cells, numbers = len(copies), copies[:, 1]
        owner = np.repeat(np.arange(cells), numbers)
        within = np.arange(numbers.sum()) - np.repeat(np.cumsum(numbers) - numbers, numbers)
        place = (np.cumsum(copies.sum(axis=1)) - numbers)[owner] + within
        h = split_mix(place, ~key)
        normal = np.stack([TABLE[bits(h, k)] for k in (0, 1)])
        mean, covariance = self._birth_normals(groups)
        associated = np.where(bits(h, 4) / 4096 < self.settings.association, row[owner], 0)
        factor = np.linalg.cholesky(covariance)[associated]
        velocity = mean[associated].T + np.einsum("nij,jn->in", factor, normal)
        corner = np.stack([owner // self.shape[1], owner % self.shape[1]])
        position = (corner + (np.stack([bits(h, 2), bits(h, 3)]) + 0.5) / 4096) * self.resolution
        return np.concatenate([position, velocity]).astype(np.float32)

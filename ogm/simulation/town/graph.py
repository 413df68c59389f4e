"""Graph of crossings on a curved grid and of the edges between them, from which streets are made."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.sparse.csgraph import connected_components

from ogm.simulation.mesh import Floats

MARGIN = 35.0  # [m] between the outermost street and the edge of the square
Edges = list[tuple[int, int]]


class Grid(NamedTuple):
    """Crossings, the meshes between them, the broad road and the roundabout."""

    nodes: Floats  # (N, 2)
    faces: Floats  # (F, 2) middle of each mesh
    styles: tuple[str, ...]  # district of each mesh
    broad: set[tuple[int, int]]  # edges of the broad road
    roundabout: int  # node of the roundabout, -1 without one

    def district(self, point: Floats) -> str:
        """Return the district of the mesh nearest to a point (2,)."""
        return self.styles[int(np.argmin(np.linalg.norm(self.faces - point, axis=1)))]


def bent_grid(n: int, size: float, rng: Generator) -> Floats:
    """Return the crossings of n x n curved, irregular lines; crossing (i, j) has index i * n + j."""
    half = size / 2 - MARGIN
    spacing = 2 * half / (n - 1)
    ticks = []
    for _ in range(2):
        gaps = rng.uniform(0.82, 1.18, n - 1)
        ticks.append(np.concatenate([[0], np.cumsum(gaps)]) / gaps.sum() * 2 * half - half)
    x, y = np.meshgrid(*ticks, indexing="ij")
    phase = rng.uniform(0, 2 * np.pi, 2)
    bend = 0.07 * spacing * (1 - (np.maximum(abs(x), abs(y)) / half) ** 4)
    x, y = x + bend * np.sin(y / 60 + phase[0]), y + bend * np.sin(x / 60 + phase[1])
    jitter = rng.uniform(-0.06, 0.06, (2, n, n)) * spacing
    jitter[0, [0, -1]] = -np.sign(x[[0, -1]]) * abs(jitter[0, [0, -1]]) * 0.5
    jitter[1][:, [0, -1]] = -np.sign(y[:, [0, -1]]) * abs(jitter[1][:, [0, -1]]) * 0.5
    return np.stack([x + jitter[0], y + jitter[1]], axis=-1).reshape(-1, 2)


def grid_edges(n: int) -> Edges:
    """Return the edges between neighbours in an n x n grid."""
    along = [(i * n + j, (i + 1) * n + j) for i in range(n - 1) for j in range(n)]
    across = [(i * n + j, i * n + j + 1) for i in range(n) for j in range(n - 1)]
    return sorted(along + across)


def broad_line(n: int, side: int) -> set[tuple[int, int]]:
    """Return the edges of a line of the grid: an outer line in a small town, an inner line in a larger town."""
    line = (0 if n == 3 else 1) if side % 2 == 0 else (n - 1 if n == 3 else n - 2)
    if side < 2:
        return {(line * n + j, line * n + j + 1) for j in range(n - 1)}
    return {(i * n + line, (i + 1) * n + line) for i in range(n - 1)}


def thinned(edges: Edges, kept: Edges, count: int) -> Edges:
    """Remove edges except `kept`, as long as every crossing keeps two streets and no street becomes a bridge."""
    result = list(edges)
    for edge in edges:
        rest = [other for other in result if other != edge]
        degree = np.bincount(np.ravel(rest), minlength=count)
        if edge not in kept and min(degree[list(edge)]) >= 2 and _ring(rest, count):
            result = rest
    return result


def _ring(edges: Sequence[tuple[int, int]], count: int) -> bool:
    """Return whether the graph stays connected after removal of any one edge."""
    for closed in range(len(edges)):
        joined = np.zeros((count, count), bool)
        joined[tuple(np.delete(edges, closed, axis=0).T)] = True
        if connected_components(joined, directed=False)[0] > 1:
            return False
    return True


def dead_ends(grid: Grid, edges: Edges, count: int) -> tuple[Grid, Edges, list[int]]:
    """Add short dead-end streets into some suburban and industrial blocks; return their end nodes too."""
    heads: list[int] = []
    nodes, faces = grid.nodes, grid.faces
    for face in [k for k, style in enumerate(grid.styles) if style in ("suburb", "industrial")][: count + 2]:
        if len(heads) == count:
            break
        middle = np.array([(nodes[a] + nodes[b]) / 2 for a, b in edges])
        length = np.array([np.linalg.norm(nodes[a] - nodes[b]) for a, b in edges])
        far = np.linalg.norm(middle - faces[face], axis=1) + 1000 * (length < 76)
        taken = [edge in grid.broad or max(edge) >= len(nodes) or grid.roundabout in edge for edge in edges]
        far += 1000 * np.array(taken)
        k = int(np.argmin(far))
        inward = faces[face] - middle[k]
        reach = min(40.0, float(np.linalg.norm(inward)))
        if far[k] > 80 or reach < 30:
            continue
        a, b = edges[k]
        across = np.array([-(nodes[b] - nodes[a])[1], (nodes[b] - nodes[a])[0]]) / length[k]
        across *= np.sign(across @ inward)
        m, e = len(nodes), len(nodes) + 1
        nodes = np.vstack([nodes, middle[k], middle[k] + across * reach])
        edges = [edge for edge in edges if edge != (a, b)] + [(a, m), (b, m), (m, e)]
        heads.append(e)
    return grid._replace(nodes=nodes), edges, heads


def chains_of(edges: Edges, count: int, stops: set[int]) -> list[list[int]]:
    """Join edges at crossings of two edges into streets: lists of nodes."""
    neighbours: list[list[int]] = [[] for _ in range(count)]
    for a, b in edges:
        neighbours[a].append(b)
        neighbours[b].append(a)
    ends = [k for k in range(count) if len(neighbours[k]) and (len(neighbours[k]) != 2 or k in stops)]
    chains, seen = [], set()
    for start in ends:
        for following in neighbours[start]:
            if (start, following) in seen:
                continue
            chain = [start, following]
            while chain[-1] not in ends:
                chain.append(next(k for k in neighbours[chain[-1]] if k != chain[-2]))
            seen |= {(chain[0], chain[1]), (chain[-1], chain[-2])}
            chains.append(chain)
    return chains

"""Heights of one scan: the ground, as layers on the cells of its grid."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.surface import sample_many
from ogm.geometric.ray import RayTrace


def height_layers(trace: RayTrace) -> dict[str, NDArray[np.float32]]:
    """Return the height of the ground at each cell's centre, (nx, ny) [m], in the vehicle frame."""
    spec = trace.grid.spec
    x, y = (np.broadcast_to(a, spec.shape).astype(np.float32).ravel() for a in spec.cell_centers)
    return {"ground_height": sample_many(trace.ground, x, y).reshape(spec.shape)}

"""From the frame of the points to the frame of the vehicle."""

import numpy as np

from ogm.geometric.core.jit import kernel

__all__ = ["own_frame"]


@kernel
def own_frame(points, T, box, xyz):
    """Take points to the vehicle frame and drop those that are not finite or lie in the vehicle's own box.

    Parameters
    ----------
    points : (N, 3 or more) float32
        x, y, z [m] in the sensor frame.
    T : (3, 4) float32
        Vehicle from sensor.
    box : (4,) float32
        x_min, x_max, y_min, y_max [m] of the own vehicle, in the vehicle frame.
    xyz : (3, N) float32
        Filled with the points that stay, in their order: a row of x, one of y, one of z.

    Returns
    -------
    kept, invalid, own : int
        Rows filled, rows dropped for NaN or inf, rows dropped as returns from the own vehicle.
    """
    r00, r01, r02, tx = T[0]
    r10, r11, r12, ty = T[1]
    r20, r21, r22, tz = T[2]
    x_min, x_max, y_min, y_max = box
    limit = np.float32(1e6)  # [m] also keeps what follows from overflowing
    kept, invalid, own = 0, 0, 0
    for n in range(points.shape[0]):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        if not (abs(a) < limit and abs(b) < limit and abs(c) < limit):
            invalid += 1
            continue
        x, y, z = (
            r00 * a + r01 * b + r02 * c + tx,
            r10 * a + r11 * b + r12 * c + ty,
            r20 * a + r21 * b + r22 * c + tz,
        )
        if x > x_min and x < x_max and y > y_min and y < y_max:
            own += 1
            continue
        xyz[0, kept], xyz[1, kept], xyz[2, kept] = x, y, z
        kept += 1
    return kept, invalid, own

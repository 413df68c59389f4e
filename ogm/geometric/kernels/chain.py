"""The steps of `RayISM` from points over a known ground to masses, each divided among threads.

One kernel does them all: each kernel that is called from Python takes time to load.
"""

from ogm.geometric.kernels.arguments import RayScan
from ogm.geometric.kernels.belief import clear_sectors, ray_mass
from ogm.geometric.kernels.breaks import agree, find_breaks
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.geometric.kernels.rays import aim_rays, place_rays, sort_sectors
from ogm.geometric.kernels.silence import silence_reliability
from ogm.jit import kernel

__all__ = ["AIM", "AGREE", "CLEAR", "MASS", "PLACE", "SORT", "ray_step"]

AIM, PLACE, SORT, AGREE, CLEAR, MASS = range(6)


@kernel
def ray_step(step: int, k: int, threads: int, scan: RayScan) -> None:
    """Do the share of one thread in a step.

    Parameters
    ----------
    step : int
        `AIM` to `MASS`; all threads end a step before the next begins.
    k, threads : int
        Number of the thread, and of all threads.
    scan : RayScan
        `rays`, `breaks`, `silence`, `work` and `mass` are filled.
    """
    points, polar, numbers, rays, work = scan.points, scan.polar, scan.numbers, scan.rays, scan.work
    count, nx = points.x.shape[0], scan.mass.shape[0]
    part = count * k // threads, count * (k + 1) // threads, k
    if step == AIM:
        aim_rays(points, scan.directions, scan.origin, polar, numbers.max_range, part, work)
    elif step == PLACE:
        place_rays(points, scan.origin, scan.ground, scan.cells, numbers, scan.shown, part, work)
        if k == 0:
            rays.starts[0] = 0
            for s in range(polar.sectors):
                rays.starts[s + 1] = rays.starts[s]
                for j in range(threads):
                    rays.starts[s + 1] += work.counts[j, s]
    elif step == AGREE:
        if k == 0:
            agree(scan.breaks)
        if k == threads - 1 and scan.directions.shape[0] > 0:
            reliability = silence_reliability(rays, scan.limits, polar)
            for n in range(polar.bins):
                scan.silence[n] = reliability[n]
    elif step == MASS:
        ray_mass(work, polar, scan.false_alarm, numbers, nx * k // threads, nx * (k + 1) // threads, scan.mass)
    else:
        for j in range(k, 2 * threads, threads):  # two opposite parts of a turn
            first, last = polar.rows * j // (2 * threads) << ROW_BITS, polar.rows * (j + 1) // (2 * threads) << ROW_BITS
            if step == SORT:
                sort_sectors(rays, first, last, count, work)
                find_breaks(rays, scan.limits, polar, numbers, (first, last), scan.breaks)
            else:
                part = first, last, k
                clear_sectors(
                    rays, points, scan.limits, polar, scan.cells, scan.breaks, scan.silence, numbers, part, work
                )

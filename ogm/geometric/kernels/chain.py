"""Steps of `RayISM` from points to sorted rays and breaks, each divided among threads.

The steps share a kernel, because each kernel that Python calls takes time to load.
"""

from ogm.geometric.kernels.arguments import RayScan
from ogm.geometric.kernels.breaks import agree, find_breaks
from ogm.geometric.kernels.rays import aim_rays, place_rays, sort_sectors
from ogm.jit import kernel

__all__ = ["AGREE", "AIM", "PLACE", "SORT", "ray_step"]

AIM, PLACE, SORT, AGREE = range(4)


@kernel
def ray_step(step: int, part: tuple[int, int, int], scan: RayScan) -> None:
    """Run a part of a step.

    Parameters
    ----------
    step : int
        `AIM` to `AGREE`; all parts of a step end before the next step begins.
    part : (first, last, k)
        Part k: returns, or for `SORT` sectors, from `first` to ``last - 1``. `AGREE` has a single part.
    scan : RayScan
        `rays`, `breaks` and `work` are filled.
    """
    points, polar, numbers, rays, work = scan.points, scan.polar, scan.numbers, scan.rays, scan.work
    if step == AIM:
        aim_rays(points, scan.directions, scan.origin, polar, numbers.max_range, part, work)
    elif step == PLACE:
        place_rays(points, scan.origin, scan.ground, scan.cells, numbers, scan.shown, part, work)
        if part[2] == 0:
            rays.starts[0] = 0
            for s in range(polar.sectors):
                rays.starts[s + 1] = rays.starts[s]
                for j in range(work.counts.shape[0]):
                    rays.starts[s + 1] += work.counts[j, s]
    elif step == SORT:
        sort_sectors(rays, part[0], part[1], points.x.shape[0], work)
        find_breaks(rays, scan.limits, polar, numbers, (part[0], part[1]), scan.breaks)
    else:
        agree(scan.breaks)

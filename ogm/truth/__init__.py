"""True states of cells, from classified points, boxes, maps and other scans.

Simulated and labelled data share the rules of van Kempen et al. 2021, Sec. IV-B:

* a cell with *ground* is free; drivable surfaces count as ground;
* a cell with an *obstacle* between the obstacle height and the clearance above ground (`HeightLimits`) is occupied,
  even if ground was hit, too: a cell with road and kerb is occupied;
* a cell without any hit is unknown. Cells between the sensor and a hit are not filled;
* all cells of a traffic participant with at least `MIN_RETURNS` points in the *input* scan are occupied; with fewer
  points, only its hit cells are occupied;
* cells under the ego vehicle and unobserved cells are ignored: neither free nor unknown.

A single hit is enough, as hits of a simulator have no noise, and real scans are sparse. Sensors with false returns need
cleaning of their points before.

Real datasets have several kinds of evidence: classes of points, boxes, the road of a map, other scans of the
same area. Each gives a separate truth (`truth_from_points`, `truth_from_boxes`, `truth_from_road`,
`truth_from_scans`), and `combine_truths` combines them; unlabelled cells are ignored there, not unknown. The rays of
the simulator are counted by `ogm.truth.rays`, which is compiled and not imported here.

>>> from ogm import Boxes, GridSpec
>>> from ogm.truth import cells_in_boxes
>>> car = Boxes([[2.0, 0.0, 0.8]], [[4.0, 2.0, 1.6]], [0.0])                # centre, size [m], yaw
>>> int(cells_in_boxes(car, GridSpec(0.5, (16, 8), (-2.0, -2.0))).sum())
32
"""

from ogm.truth.boxes import cells_in_boxes, truth_from_boxes, truth_from_road
from ogm.truth.motion import motion_of_boxes
from ogm.truth.observe import HEIGHT_LIMITS, Kind
from ogm.truth.points import TRUTH_SPEC, truth_from_points
from ogm.truth.scans import combine_truths, truth_from_scans

__all__ = [
    "HEIGHT_LIMITS", "TRUTH_SPEC", "Kind", "cells_in_boxes", "combine_truths", "motion_of_boxes", "truth_from_boxes",
    "truth_from_points", "truth_from_road", "truth_from_scans",
]  # fmt: skip

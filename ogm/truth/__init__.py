"""True states of cells, from classified points, boxes, maps and other scans.

Simulated and labelled data share the rules of van Kempen et al. 2021, Sec. IV-B:

* a cell with *ground* is free; what a vehicle may drive over counts as ground;
* a cell with an *obstacle* between the obstacle height and the clearance above ground (`HeightLimits`) is occupied,
  also where ground was hit: a cell with road and kerb is occupied;
* a cell without any hit is unknown. Nothing is drawn between the sensor and a hit;
* all cells of a traffic participant that returned at least `MIN_RETURNS` points to the *input* scan are occupied;
  one with fewer is occupied only where it was hit;
* cells under the ego vehicle, and those that were not observed, are to be ignored: neither free nor unknown.

One hit is enough in either case: the hits of a simulator carry no noise, and real scans are too sparse to ask
for more. Points of a sensor that invents returns must be cleaned before.

Real data sets give several kinds of evidence: classes of points, boxes, the road of a map, other scans of the
same place. Each makes a truth of its own (`truth_from_points`, `truth_from_boxes`, `truth_from_road`,
`truth_from_scans`), and `combine_truths` makes one of them; unlabelled cells are to be ignored there, not unknown.
The simulator's rays are counted by `ogm.truth.rays`, which is compiled and not imported here.

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

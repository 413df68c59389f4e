"""What is really there: classified points and object boxes in, a grid of states out.

Simulated and real recordings meet here. A simulator says what each ray hit, a labelled recording says what
each point is; from then on both go the same way (van Kempen et al. 2021, Sec. IV-B):

* a cell in which *ground* was seen is free; what a vehicle may drive over counts as ground;
* a cell in which an *obstacle* was hit between `obstacle_height` and `clearance` above the ground is occupied,
  whatever else was seen in it: occupied wins over free, so that a cell with road and kerb is occupied;
* a cell in which nothing was seen is unknown. Nothing is drawn between the sensor and a hit;
* all cells of a traffic participant that returned at least `min_returns` points to the *input* scan are
  occupied, seen or not; one with fewer is occupied only where it was hit;
* cells under the own vehicle, and those that nobody looked at, are to be ignored: not free, not unknown.

One hit is enough in either case: the hits of a simulator carry no noise, and real scans are too sparse to ask
for more. Points of a sensor that invents returns must be cleaned before.

Recordings know more, each of a kind: boxes alone, the road of a map, other scans of the same place. Their
truths are made apart (`truth_from_boxes`, `truth_from_road`, `truth_from_scans`) and then combined
(`combine_truths`); what nobody labelled is to be ignored there, not unknown.
"""

from ogm.truth.aggregated import MARGIN, contradicted, truth_from_scans
from ogm.truth.area import Road, cells_in_areas, free_road, truth_from_road
from ogm.truth.boxes import boxes_seen_from, cells_in_box, count_returns
from ogm.truth.combined import combine_truths
from ogm.truth.moving import boxes_over_points, cells_in_boxes, move_boxes, moving_tracks, widen_boxes
from ogm.truth.objects import truth_from_boxes
from ogm.truth.recording import height_above_ground, truth_from_points
from ogm.truth.rules import MIN_RETURNS, check_heights, finalize_truth, truth_grid
from ogm.truth.state import FREE, IGNORE, OCCUPIED, TRUTH_SPEC, UNKNOWN, Truth
from ogm.truth.tally import (
    CLEARANCE,
    GROUND_SEEN,
    OBSTACLE_HEIGHT,
    OBSTACLE_SEEN,
    PLANT_HEIGHT,
    Kind,
    tally_points,
    tally_rays,
)

__all__ = [
    "TRUTH_SPEC",
    "CLEARANCE",
    "FREE",
    "GROUND_SEEN",
    "IGNORE",
    "MARGIN",
    "MIN_RETURNS",
    "OBSTACLE_HEIGHT",
    "OBSTACLE_SEEN",
    "OCCUPIED",
    "PLANT_HEIGHT",
    "UNKNOWN",
    "Kind",
    "Road",
    "Truth",
    "boxes_over_points",
    "boxes_seen_from",
    "cells_in_areas",
    "cells_in_box",
    "cells_in_boxes",
    "check_heights",
    "combine_truths",
    "contradicted",
    "count_returns",
    "free_road",
    "height_above_ground",
    "move_boxes",
    "moving_tracks",
    "finalize_truth",
    "tally_points",
    "tally_rays",
    "truth_from_boxes",
    "truth_from_points",
    "truth_from_road",
    "truth_from_scans",
    "truth_grid",
    "widen_boxes",
]

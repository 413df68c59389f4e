"""An own sensor model in 15 lines: free where all returns of a cell are low, occupied where some are high.

    ogm simulate data --samples 1 --validation 4 --test 0 --town-size 240
    python examples/own_sensor_model.py data

compares it with the models of ogm on the four validation samples, and writes a report.
"""

import sys

import numpy as np

from ogm import EvidentialGrid, GridSpec, Scan, evaluate, open_dataset
from ogm.evaluation import Evaluation, write_report


class CountISM:
    """Counts low and high returns of each cell; takes flat ground, `scan.mount.sensor_height` below the sensor."""

    def __init__(self, spec: GridSpec, weight: float = 0.5) -> None:
        self.spec, self.weight = spec, weight  # weight: mass that one return gives

    def __call__(self, scan: Scan) -> EvidentialGrid:
        x, y, z = scan.points[:, :3].T
        height = z + scan.mount.sensor_height
        counts, inside = np.zeros((*self.spec.shape, 2)), self.spec.contains(x, y)
        for state, chosen in enumerate((height < 0.3, (height >= 0.3) & (height < 3.0))):
            chosen = chosen & inside
            np.add.at(counts[..., state], self.spec.index(x[chosen], y[chosen]), 1)
        counts[counts[..., 1] > 0, 0] = 0  # one high return outweighs all low ones
        return EvidentialGrid(self.spec, (1 - (1 - self.weight) ** counts).astype(np.float32))


def main(folder: str, out: str = "report") -> Evaluation:
    spec = GridSpec.centered()
    data = open_dataset(folder)  # its scans know their mounts, which differ
    result = evaluate({"own": CountISM(spec), "height-band": "height-band", "ray": "ray"}, data, spec, out=out)
    write_report(out, result)
    for name in ("own", "height-band", "ray"):
        scores = result.macro(name)
        print(f"{name:12} IoU free {scores['iou_free']:.3f}   IoU occupied {scores['iou_occupied']:.3f}")
    return result


if __name__ == "__main__":
    main(*sys.argv[1:])

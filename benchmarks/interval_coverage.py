"""How often do intervals of `ogm.evaluation` hold the truth? Simulated drives whose true mean is known.

    python benchmarks/interval_coverage.py [--repeats 4000]

Values of frames are made of normal numbers: one per drive, and a chain within it whose neighbours are correlated. They
become metrics of several shapes. Drives have 10 to 100 frames. Counted is how often the 95 % intervals of the
mean, and of the ratio of two methods' means, hold the true value; how often two methods that are equally good differ
with p < 0.05; and how often the interval of the mean would hold the truth if frames were taken for independent. Writes
benchmarks/results/interval_coverage.json; docs/build.py makes the table of docs/evaluation.md of it.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import lfilter

from ogm.evaluation import compare_paired, mean_interval

SHAPES: dict[str, Any] = {  # of the values of a metric: quantile functions
    "normal": stats.norm(10),
    "share, mean 0.2": stats.beta(2, 8),
    "share, mean 0.1": stats.beta(1, 9),
    "share, mean 0.95": stats.beta(19, 1),
    "error, lognormal": stats.lognorm(0.7),
}
DRIVES = (5, 12, 24)
FRAMES = (10, 100)  # of a drive, at least and at most
ALIKE = ((0.2, 0.8), (0.7, 0.5))  # share of the variance between drives, correlation of neighbours within one
ALONE = (100, 200)  # frames of a drive that is alone
PAIRED = 0.8  # correlation of the normal numbers of two methods


class Case(NamedTuple):
    """Simulated drives: their number and frames, the shape of the values, the likeness of frames."""

    drives: int
    frames: tuple[int, int]
    shape: str
    between: float
    lag: float


def cases() -> list[Case]:
    """Return all cases of the record."""
    many = [Case(n, FRAMES, shape, *alike) for n, shape, alike in product(DRIVES, SHAPES, ALIKE)]
    return many + [Case(1, (n, n), shape, 0.0, lag) for n, shape, (_, lag) in product(ALONE, SHAPES, ALIKE)]


def simulate(case: Case, rng: Generator) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return values of two equally good methods, (2, frames), and the drive of each frame."""
    low, high = case.frames
    lengths = rng.integers(low, high + 1, case.drives)
    innovations = rng.standard_normal((2, case.drives, high + 50))  # the chain forgets its start in 50 frames
    chain = np.sqrt(1 - case.lag**2) * lfilter([1.0], [1.0, -case.lag], innovations)[..., 50:]
    normal = np.sqrt(case.between) * rng.standard_normal((2, case.drives, 1)) + np.sqrt(1 - case.between) * chain
    normal[1] = PAIRED * normal[0] + np.sqrt(1 - PAIRED**2) * normal[1]
    kept = np.arange(high) < lengths[:, None]
    values = SHAPES[case.shape].ppf(stats.norm.cdf(normal[:, kept]))
    return values, np.repeat(np.arange(case.drives), lengths)


def coverage(case: Case, repeats: int, rng: Generator) -> dict[str, float]:
    """Return the shares of repeated simulations of a case whose intervals hold the truth."""
    truth, found = SHAPES[case.shape].mean(), []
    for _ in range(repeats):
        (a, b), drives = simulate(case, rng)
        mean, frames = mean_interval(a, drives), mean_interval(a)
        pair = compare_paired(a, b, "lower", drives)
        holds = [one.low <= right <= one.high for one, right in ((mean, truth), (pair.ratio, 1.0), (frames, truth))]
        found.append([*holds, pair.p < 0.05])
    names = ("mean", "ratio", "mean, frames as independent", "p below 0.05")
    return dict(zip(names, np.mean(found, axis=0).tolist(), strict=True))


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("--repeats", type=int, default=4000)
    given = parser.parse_args()
    record = run.environment() | {"repeats": given.repeats, "cases": []}
    for number, case in enumerate(cases()):
        record["cases"].append(case._asdict() | coverage(case, given.repeats, np.random.default_rng(number)))
        print(*(f"{name} {value}" for name, value in record["cases"][-1].items()), sep="  ", flush=True)
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()

"""Shared parts of the benchmarks: processor cores, options, environment, verdicts and records.

Importing this module pins the process to one core. It must come before numpy: the thread pools of numba, OpenMP and
BLAS read their sizes when they are loaded. A benchmark of several cores sets OGM_CORES, their number, in ``os.environ``
before it imports this module; the process may then use every core.
"""

import os

THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
CORES = int(os.environ.get("OGM_CORES", "1"))
os.environ.update(dict.fromkeys(THREADS, str(CORES)))
CORE = None
if CORES == 1 and hasattr(os, "sched_setaffinity"):  # Linux
    CORE = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {CORE})
elif hasattr(os, "sched_setaffinity"):  # started by a benchmark that is pinned
    os.sched_setaffinity(0, range(os.cpu_count() or 1))

import argparse  # noqa: E402
import contextlib  # noqa: E402
import importlib.metadata  # noqa: E402
import json  # noqa: E402
import platform  # noqa: E402
import re  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
from collections.abc import Iterable, Mapping, Sequence  # noqa: E402
from datetime import UTC, datetime  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import ogm  # noqa: E402
from ogm.storage.files import atomic_write  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PICTURES, RUNS = ROOT / "benchmarks" / "results", ROOT / "docs" / "pictures", ROOT / "runs"
DATA = Path(os.environ.get("OGM_DATA", ROOT.parent / "shared" / "data" / "real"))  # see benchmarks/README.md
PACKAGES = (
    *("rosbags", "mcap", "mcap-ros2-support"),
    *("numpy", "numba", "llvmlite", "open3d", "zarr", "dask", "obstore", "shapely", "torch", "onnxruntime", "openvino"),
    *("pyoctomap", "octomap-python", "kiss-slam", "pypatchworkpp", "travel-seg", "dufomap"),
    *("py_dempster_shafer", "pybelief", "evtools-dst", "eslimpp"),
)
BUSY = 0.5  # load beyond which other programs disturb the figures
EXACT = 17  # digits that keep a float64


class Parser(argparse.ArgumentParser):
    """Command line of a benchmark, with the options that all of them share.

    Parameters
    ----------
    description : str
        The docstring of the benchmark.
    picture, quick, real : bool
        Adds ``--picture``, ``--quick``, ``--real``. With ``--quick``, record and picture go to runs/ by default.
    rounds : int
        Adds ``--rounds`` with this default, unless 0.
    """

    def __init__(
        self, description: str, *, picture: bool = False, quick: bool = False, real: bool = False, rounds: int = 0
    ) -> None:
        super().__init__(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
        self.add_argument("--out", type=Path, help="record (default: benchmarks/results)")
        if picture:
            self.add_argument("--picture", type=Path, help="picture (default: docs/pictures)")
        if quick:
            self.add_argument("--quick", action="store_true", help="check that everything runs; writes to runs/")
        if rounds:
            self.add_argument("--rounds", type=int, default=rounds)
        if real:
            self.add_argument("--real", type=Path, default=DATA, help="folder of real recordings (default: OGM_DATA)")

    def parse_args(self, *given: Any) -> argparse.Namespace:  # type: ignore[override]
        """Return the options, with the places of record and picture."""
        options, name = super().parse_args(*given), Path(sys.argv[0]).stem
        quick = getattr(options, "quick", False)
        options.out = options.out or (RUNS if quick else RESULTS) / f"{name}.json"
        if "picture" in options:
            options.picture = options.picture or (RUNS if quick else PICTURES) / f"{name}.png"
        return options


def environment(*models: str, **others: str | Path) -> dict[str, Any]:
    """Return command, date, commit, machine and versions of a record, and the checksums of its models.

    Parameters
    ----------
    *models : str
        All sensor models of the benchmark, by name as in `ogm.models.load_model`, and the rules of its maps, as in
        `ogm.fusion.make_mapper`. docs/build.py marks the tables of a record as outdated when one gives other results.
    **others : str or Path
        Models that are not shipped: paths by their titles in the record.
    """
    load = [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None
    if load and load[0] > BUSY:
        print(f"other programs run on this machine (load {load[0]}): its figures are good for ratios at best")
    versions = {}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    words = (Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:])
    return {
        "command": " ".join([f"python benchmarks/{Path(sys.argv[0]).name}", *words]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": commit(Path(ogm.__file__).parent),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "cores used": CORES,
        "pinned": CORE is not None,
        "load at start": load,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": versions,
        "checksums": {
            title: describe(str(name)) for title, name in (dict(zip(models, models, strict=True)) | others).items()
        },
    }


def commit(folder: Path) -> str | None:
    """Return the commit of a checkout, with "-dirty" if the folder or the benchmarks differ; None outside of git."""
    git = ["git", "-C", str(folder)]
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        name = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        paths = [".", ":(top,glob)benchmarks/*.py"]
        changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", *paths]).returncode == 1
        return f"{name}-dirty" if changed else name
    return None


def describe(name: str) -> dict[str, Any]:
    """Return the fingerprint of a model or of a map, and file name and SHA-256 of its weights, if it has any."""
    from _fingerprints import fingerprint  # only now: processes whose memory is measured stay small

    from ogm.evidence.map_rules import MAP_RULES
    from ogm.models import describe_model

    weights = None if name in MAP_RULES else describe_model(name)[1]
    return {**(weights or {}), "fingerprint": list(fingerprint(name))}


def _cpu() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def verdicts(rows: Iterable[tuple[str, float, str, float, str]]) -> list[dict[str, Any]]:
    """Return figures beside their limits.

    Parameters
    ----------
    rows : iterable of (str, float, {"<=", ">="}, float, str)
        Name, figure, relation, limit and unit.
    """
    return [
        {
            "what": name,
            "got": got,
            "wanted": limit,
            "unit": unit,
            "met": bool(got >= limit if at == ">=" else got <= limit),
        }
        for name, got, at, limit, unit in rows
    ]


def print_verdicts(rows: Iterable[Mapping[str, Any]]) -> None:
    """Print a line for each of `verdicts`."""
    for row in rows:
        figure = f"{row['what']}: {row['got']:.4g} {row['unit']} (wanted {row['wanted']:g})"
        print(f"{'ok    ' if row['met'] else 'MISSED'} {figure}")


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON, whole or not at all, and print its verdicts.

    NaN and infinity become null; a list of numbers takes one line.
    """
    from ogm.evaluation.text import as_json  # only now: processes whose memory is measured stay small

    text = json.dumps(as_json(record, EXACT), indent=1, allow_nan=False, ensure_ascii=False)
    short = re.sub(r"\[[^\[\]{}\"]*\]", lambda found: re.sub(r"\s+", " ", found[0]), text)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, "w") as file:
        file.write(short + "\n")
    print_verdicts(record.get("verdicts", ()))
    print(f"wrote {path}", flush=True)


def in_new_process(script: str, words: Sequence[object] = (), **options: Any) -> str:
    """Return the standard output of a script in a new Python process; `options` are of `subprocess.run`."""
    command = [sys.executable, "-c", script, *map(str, words)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, **options).stdout

"""The commands that `tests/faults.py` stops: small inputs, command lines, and what their outputs must be."""

import errno
import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

WALL = 9.0  # [m] from the sensor to the wall of sample 0
SMALL = ("--length", "24", "--width", "16", "--resolution", "0.5")
TRAINING = (
    *("--length", "30.72", "--width", "20.48", "--resolution", "0.64", "--accelerator", "cpu", "--batch", "4"),
    *("--epochs", "2", "--workers", "1"),
)
PLAN = ("--samples", "20", "--validation", "10", "--test", "0", "--town-size", "240", "--lidar", "vlp-16")


class Case(NamedTuple):
    """A command that is stopped.

    Attributes
    ----------
    words : list of str
        The command line, in a folder that holds `inputs` as ``../in`` and gets the folder ``out``.
    again : list of str
        What goes on with it.
    finished : str
        Pattern of files below ``out`` that a resumed run must leave as they are.
    whole : function
        Raises an error if an output in ``out`` is there but not whole.
    outputs : bool
        False if the command writes no files.
    stand_in : bool
        Samples are made by `make_sample` below rather than in towns.
    """

    words: Sequence[str]
    again: Sequence[str]
    finished: str = ""
    whole: Callable[[Path], None] = lambda out: None
    outputs: bool = True
    stand_in: bool = False


def make_sample(plan: Any, split: str, index: int, threads: int = 0) -> Any:
    """Make a sample without a town: flat ground and a wall across the way."""
    from samples import flat_sample, flat_steps

    from ogm.pose import pose
    from ogm.simulation.sensors import LIDARS, beams_of
    from ogm.state import CellState
    from ogm.truth import TRUTH_SPEC

    beams = beams_of(LIDARS["vlp-16"])
    wall = WALL + np.random.default_rng([index, len(split)]).uniform(0, 3)
    state = np.where(TRUTH_SPEC.cell_centers[0] < wall, CellState.FREE, CellState.OCCUPIED)
    steps = flat_steps(beams, 1.8, wall, reach=30)
    facts = {"intensities": (steps > 0).astype(np.uint8) * 100, "T_vehicle_sensor": pose(z=1.8)}
    return flat_sample(split, index, steps, state, beams=beams, stamp=float(index), **facts)


def make_inputs(command: str, folder: Path) -> None:
    """Make the input of a command."""
    make = {"train": _make_data, "evaluate": _make_data, "fuse": _make_drive, "serve": _make_drive}
    make |= {"convert": _make_map, "world": _make_drive}
    make.get(command, lambda folder: None)(folder)


def _make_data(folder: Path) -> None:
    from ogm.simulation.plan import DatasetPlan
    from ogm.simulation.sensors import LIDARS, beams_of
    from ogm.simulation.store import Store

    splits = {"training": 20, "validation": 10}
    data = Store.create(folder / "data", {"seed": 1}, splits, [beams_of(LIDARS["vlp-16"])], {"ogm": "test"})
    for split, count in splits.items():
        for shard in range(count // 10):
            data.write(split, shard, [make_sample(DatasetPlan(), split, k) for k in range(10 * shard, 10 * shard + 10)])


def _make_drive(folder: Path) -> None:
    from ogm.pose import inverse, pose, transform_points

    (folder / "drive" / "velodyne").mkdir(parents=True)
    rng = np.random.default_rng(0)
    ground, wall = rng.uniform(-12, 12, (6000, 4)), rng.uniform(-12, 12, (2000, 4))
    ground[:, 2], wall[:, 0], wall[:, 2] = 0.0, 12.1, rng.uniform(0, 2, len(wall))
    poses = [pose(0.4 * k, 0.05 * k, 1.8, yaw=0.02 * k) for k in range(12)]
    for k, T in enumerate(poses):
        points = transform_points(inverse(T), np.concatenate([ground, wall]))
        points[:, 3] = 0.5
        points.astype(np.float32).tofile(folder / "drive" / "velodyne" / f"{k:06d}.bin")
    np.savetxt(folder / "drive" / "poses.txt", [T[:3].ravel() for T in poses])
    np.savetxt(folder / "drive" / "times.txt", 0.1 * np.arange(12))


def _make_map(folder: Path) -> None:
    from ogm.grid import EvidentialGrid, GridSpec

    spec, rng = GridSpec.centered(48, 32, 0.1), np.random.default_rng(0)
    free = rng.uniform(0, 0.6, spec.shape)
    EvidentialGrid(spec, np.stack([free, 0.9 * (1 - free)], -1).astype(np.float32)).save(folder / "map.npz")


def cases() -> dict[str, Case]:
    """Return the commands by their names; several command lines of one name take turns."""
    drive = ("../in/drive", "--sensor-height", "1.8", "--ism", "height-band", *SMALL)
    found: dict[str, Case] = {}
    for workers in (1, 2):
        words = ["simulate", "out", "--workers", str(workers)]
        one = Case([*words, *PLAN], [*words, "--resume"], "*/facts/c/*", whole_store, stand_in=True)
        found[f"simulate, {workers} worker{'s' * (workers > 1)}"] = one
    few = ("--samples", "2", "--validation", "1", *PLAN[4:])
    words = ["simulate", "out", "--workers", "2"]
    found["simulate, towns"] = Case([*words, *few], [*words, "--resume"], "*/facts/c/*", whole_store)
    words = ["train", "../in/data", "--out", "out", *TRAINING]
    found["train"] = Case(words, [*words, "--resume"], "", whole_run)
    words = ["evaluate", "../in/data", "--ism", "height-band", "--samples", "6", "--out", "out"]
    found["evaluate"] = Case(words, words, "frames/*.npz", whole_report)
    for kind in ("npz", "mcap", "db3", "bag"):
        files = ["--out", f"out/map.{kind}", "--picture", "out/map.png", "--save-poses", "out/poses.txt"]
        words = ["fuse", *drive, *files]
        found[f"fuse {kind}"] = Case(words, words, "", whole_maps)
    for kind in ("tif", "nc", "zarr", "yaml", "png", "mcap", "bag"):
        words = ["convert", "../in/map.npz", f"out/map.{kind}"]
        found[f"convert {kind}"] = Case(words, words, "", whole_maps)
    for workers in (1, 2):
        words = ["world", "build", "../in/drive", "--out", "out/map", "--ism", "height-band", *SMALL, "--tile", "16"]
        words += ["--submap-length", "0.9", "--workers", str(workers)]
        found[f"world build, {workers} worker{'s' * (workers > 1)}"] = Case(words, words, "", whole_world)
    found["serve"] = Case(["serve", *drive, "--port", "0", "--rate", "1"], [], outputs=False)
    return found


# ---- outputs that are there are whole


def whole_store(out: Path) -> None:
    """Read every sample that is said to be there."""
    from ogm.simulation.store import Store

    if Store.exists(out):
        store = Store.open(out)
        for name in store.counts:
            for index in store[name].finished:
                store[name][int(index)]


def whole_run(out: Path) -> None:
    """Read the weights with their description, the state, and the rows of the curve."""
    import torch

    from ogm.deep.checkpoint import load_network

    if (out / "best.json").exists():
        load_network(out / "best.safetensors")
    if (out / "state.pt").exists():
        torch.load(out / "state.pt", weights_only=True)
    if (out / "log.csv").exists():
        header, *rows = (out / "log.csv").read_text().splitlines()
        if not rows or any(row.count(",") != header.count(",") for row in rows):
            raise ValueError("log.csv is cut")
    _whole_pictures(out)


def whole_report(out: Path) -> None:
    """Read finished frames and what there is of the report."""
    for path in out.glob("frames/*.npz"):
        with np.load(path) as data:
            _ = [data[name] for name in data.files]
    for path in out.rglob("*.json"):
        json.loads(path.read_text())
    if (out / "report.html").exists() and "</html>" not in (out / "report.html").read_text():
        raise ValueError("report.html is cut")
    _whole_pictures(out)


def whole_maps(out: Path) -> None:
    """Read maps."""
    from ogm.grid import GridSpec
    from ogm.io.grids.files import read_placed_grid

    for path in out.glob("map.*"):
        if path.suffix in (".npz", ".mcap", ".db3", ".bag", ".tif", ".nc", ".zarr", ".yaml"):
            read_placed_grid(path, GridSpec.centered(48, 32, 0.1))
    _whole_pictures(out)


def whole_world(out: Path) -> None:
    """Read all tiles and the descriptions of drives."""
    from ogm.world import WorldMap
    from ogm.world.drives import drive_names, has_drive, load_drive

    if (out / "map" / "zarr.json").exists():
        with WorldMap.open(out / "map") as world:
            for _, error in world.damage() if (out / "map" / "0").exists() else ():
                raise error
            for name in drive_names(world.store):
                if has_drive(world.store, name):
                    load_drive(world.store, name)


def _whole_pictures(out: Path) -> None:
    from PIL import Image

    for path in out.glob("*.png"):
        with Image.open(path, formats=["PNG"]) as image:
            image.load()


# ---- outputs are equal


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder without what tells times: speeds in log.csv, stamps of libraries."""
    found = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: _timeless(name, path) for name, path in found.items() if ".ogm-" not in name}  # no temporary ones


def _timeless(name: str, path: Path) -> bytes:
    if name == "log.csv":
        return re.sub(rb",[^,\n]*\n", b"\n", path.read_bytes())
    if path.suffix in (".nc", ".pt"):
        return repr(list(_arrays(path))).encode()
    return path.read_bytes()


def _arrays(path: Path) -> Iterable[tuple[str, bytes]]:
    """Yield the arrays of a file that libraries write in more than one way."""
    if path.suffix == ".nc":
        from ogm.io.grids.files import read_placed_grid

        yield "mass", read_placed_grid(path).grid.mass.tobytes()
        return
    import torch

    stack = [("", torch.load(path, weights_only=True))]
    while stack:
        name, value = stack.pop()
        if isinstance(value, dict):
            stack += [(f"{name}/{key}", one) for key, one in value.items()]
        else:
            yield name, value.numpy().tobytes() if isinstance(value, torch.Tensor) else repr(value).encode()


def left_behind(folder: Path) -> list[str]:
    """Return temporary files below a folder."""
    names = [str(path.relative_to(folder)) for path in folder.rglob("*")]
    return [name for name in names if ".ogm-" in name or name.endswith((".partial", ".tmp", "~"))]


def prepare(stand_in: bool, named: bool) -> None:
    """Let this process make samples without towns; let temporary files have names, as on other systems."""
    if stand_in:
        from ogm.simulation import dataset

        dataset.make_sample = make_sample
    if named and hasattr(os, "O_TMPFILE"):
        kept = os.open

        def refuse(path: Any, flags: int, *more: Any, **others: Any) -> int:
            if flags & os.O_TMPFILE == os.O_TMPFILE:
                raise OSError(errno.ENOTSUP, "no files without a name")
            return kept(path, flags, *more, **others)

        os.open = refuse


def begun(out: Path) -> None:
    """Raise an error unless there is a data set to go on with."""
    from ogm.simulation.store import Store

    Store.open(out)

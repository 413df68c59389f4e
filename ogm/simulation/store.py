"""Data sets on disk: one Zarr v3 group per split, ten samples per shard, a checksum on every chunk.

Reading needs numpy, numba and zarr, neither Open3D nor Dask::

    from ogm.simulation.store import Store

    sample = Store.open("data")["training"][0]
    sample.points, sample.truth, sample.objects, sample.T_world_sensor

Layout of a split, for n samples:

``returns`` (n, 3, rays) uint8
    Range and intensity of every ray, as `ogm.simulation.sample.pack` writes them. Layers follow each other
    from the lowest up; a lidar with fewer rays than the largest leaves the end 0.
``truth`` (n, 624, 624) uint8
    0 unknown, 1 free, 2 occupied, 3 to be ignored.
``objects`` (n, objects, 12) float32
    Rows of `ogm.simulation.sample.OBJECT`, the nearest first.
``facts`` (n, 38) float64
    Columns named by the split's attribute ``facts``: poses, velocities, the lidar's number, weather, and how many
    rays returned and cells are known, so that a file that vanished is not read as empty. A shard's
    facts are written last, in one step, so a row whose first number is 1 says that all of its sample is there.

The attributes of the root group hold the format, the plan that the samples were made by, the lidars, and the
versions of the libraries that made them; no date and no machine, so that the same plan gives the same bytes.
"""

import json
import operator
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ogm.simulation.sample import LABELS, OBJECT, RANGE_STEP, Beams, Sample, Weather, pack, unpack
from ogm.state import Truth
from ogm.truth import TRUTH_SPEC

__all__ = ["FORMAT", "SHARD", "Damaged", "Split", "Store"]

FORMAT = "ogm.samples/1"
BEGUN = "ogm.samples/begun"  # what a data set says of itself until all its arrays stand
SHARD = 10  # samples per shard: they become whole together
MOST = 1_000_000  # samples of a split
OBJECTS = 160  # rows for objects per sample; of more, the first are kept
_LEVEL = 5  # of zstd: above it, files shrink by 2 % and writing takes four times as long
_COLUMNS = tuple(OBJECT.names or ())
_POSE = [
    f"{name}{row}{column}"
    for name in ("T_world_sensor_", "T_vehicle_sensor_")
    for row in range(3)
    for column in range(4)
]
FACTS = (
    "made", "lidar", "returns", "known", "objects", "scenario", "stamp",
    *_POSE,
    "velocity_x", "velocity_y", "velocity_z", "yaw_rate",
    "rain", "fog", "wet",
)  # fmt: skip


class Damaged(ValueError):
    """Stored bytes are not what was written."""


class Split(Sequence[Sample]):
    """The samples of one part of a data set.

    ``split[i]`` reads sample i; ``len(split)`` is the number planned, of which `finished` can be read. May be
    pickled and used by several processes at once.
    """

    def __init__(self, path: Path, name: str, count: int, beams: Sequence[Beams]) -> None:
        self.path, self.name, self.beams = path, name, tuple(beams)
        self._count = count
        self._arrays: dict[str, Any] = {}
        self._small: dict[tuple[str, int], NDArray[Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_arrays": {}, "_small": {}}

    def __repr__(self) -> str:
        return f"Split({str(self.path / self.name)!r}, {self._count} samples planned)"

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        """Read samples.

        Raises
        ------
        IndexError
            Beyond the samples that are planned.
        ValueError
            If the sample has not been made yet.
        Damaged
            If its bytes are not those that were written; the message says how to make them anew.
        """
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = operator.index(index)
        i += len(self) if i < 0 else 0
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name} has {len(self)} samples, there is no number {index}")
        row = self._shard("facts", i // SHARD)[i % SHARD]
        if not row[0]:
            raise ValueError(
                f"sample {i} of {self.name} has not been made yet: go on with `ogm simulate {self.path} --resume`"
            )
        value = dict(zip(FACTS, row.tolist(), strict=True))
        if not (
            0 <= value["lidar"] < len(self.beams)
            and 0 <= value["objects"] <= OBJECTS
            and np.isfinite(value["scenario"])
        ):
            raise self._damaged("facts", i, "it has impossible numbers")
        beams = self.beams[int(value["lidar"])]
        steps, intensities = unpack(self._read("returns", i), beams.shape)
        state = self._read("truth", i)
        objects = self._shard("objects", i // SHARD)[i % SHARD, : int(value["objects"])]
        for name, whole in (
            ("returns", np.count_nonzero(steps) == value["returns"]),
            ("truth", np.count_nonzero(state) == value["known"]),
            ("objects", objects[:, _COLUMNS.index("length")].all()),
        ):
            if not whole:
                raise self._damaged(name, i, "a file is missing")
        poses = np.zeros((2, 4, 4))
        poses[:, 3, 3] = 1
        poses[:, :3] = row[FACTS.index(_POSE[0]) :][:24].reshape(2, 3, 4)
        return Sample(
            beams=beams,
            steps=steps,
            intensities=intensities,
            truth=Truth(TRUTH_SPEC, state),
            objects=_named(objects),
            T_world_sensor=poses[0],
            T_vehicle_sensor=poses[1],
            velocity=np.array([value[f"velocity_{axis}"] for axis in "xyz"]),
            yaw_rate=value["yaw_rate"],
            stamp=value["stamp"],
            split=self.name,
            index=i,
            scenario=int(value["scenario"]),
            weather=Weather(value["rain"], value["fog"], value["wet"]),
        )

    @property
    def facts(self) -> NDArray[np.float64]:
        """What is known of every sample beside its arrays, (n, columns `FACTS`); zeros where it is not made."""
        facts = np.zeros((len(self), len(FACTS)))
        self._array("facts")  # or the complaint that it is missing
        folder = self.path / self.name / "facts" / "c"
        names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
        for shard in sorted(int(name) for name in names if name.isdecimal()):
            if shard * SHARD < len(self):
                facts[shard * SHARD : (shard + 1) * SHARD] = self._shard("facts", shard)
        return facts

    @property
    def finished(self) -> NDArray[np.int64]:
        """Numbers of the samples that can be read, ascending."""
        return np.flatnonzero(self.facts[:, 0])

    def _shard(self, name: str, shard: int) -> NDArray[Any]:
        """Read a small array of a shard, once for its ten samples."""
        key = name, shard
        if key not in self._small:
            rows = self._read(name, slice(shard * SHARD, min((shard + 1) * SHARD, len(self))))
            if name == "facts" and not rows[:, 0].all():
                return rows  # may be on its way
            self._small[key] = rows
        return self._small[key]

    def _array(self, name: str) -> Any:
        """Open an array, once, and see that it is as `_grow` makes it: kernels trust its shape."""
        if name not in self._arrays:
            path = self.path / self.name / name
            array, (shape, kind) = _opened(path), _layout(_rays(self.beams))[name]
            if array.shape[0] < len(self) or array.shape[1:] != shape or array.dtype != kind:
                raise Damaged(
                    f"{path} holds {array.dtype} of {array.shape}, wanted {kind} of {(len(self), *shape)}: "
                    "the data set is not whole; make it anew in a new folder"
                )
            self._arrays[name] = array
        return self._arrays[name]

    def _read(self, name: str, index: int | slice) -> NDArray[Any]:
        array = self._array(name)
        try:
            return array[index]
        except (ValueError, RuntimeError, TypeError, EOFError) as error:  # what zarr and its codecs raise
            first = index if isinstance(index, int) else index.start
            raise self._damaged(name, first, str(error)) from error

    def _damaged(self, name: str, index: int, why: str) -> Damaged:
        marker = self.path / self.name / "facts" / "c" / str(index // SHARD) / "0"
        return Damaged(
            f"sample {index} of {self.name} in {self.path}: {name} damaged on disk ({why}); make it anew with "
            f"`rm {marker}` and `ogm simulate {self.path} --resume`"
        )


class Store:
    """A data set on disk. Open one with `Store.open`; the parts are ``store["training"]`` and so on."""

    def __init__(self, path: Path, attributes: Mapping[str, Any]) -> None:
        self.path = path
        self.plan: dict[str, Any] = dict(attributes["plan"])
        self.versions: dict[str, str] = dict(attributes["versions"])
        self.beams = tuple(Beams.from_dict(one) for one in attributes["lidars"])
        self.counts = _counts(attributes["splits"])
        if not self.beams:
            raise ValueError("it names no lidars")

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> "Store":
        """Open a data set to read.

        Raises
        ------
        FileNotFoundError
            If there is none.
        ValueError
            If the folder holds something else, or a data set of another version.
        """
        path = Path(path)
        try:
            text = (path / "zarr.json").read_bytes()
        except FileNotFoundError:
            raise FileNotFoundError(f"{path} holds no data set; `ogm simulate {path}` makes one") from None
        except NotADirectoryError:
            raise ValueError(f"{path} is a file; a data set is a folder that `ogm simulate` made") from None
        try:
            attributes = json.loads(text)["attributes"]
            found = attributes["format"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} is no data set that `ogm simulate` made ({error!r})") from error
        if found == BEGUN:
            raise FileNotFoundError(
                f"{path} holds no data set yet: making it was stopped at once; `ogm simulate {path}` begins again"
            )
        if found != FORMAT:
            raise ValueError(
                f"{path} has the format {found}, this version of ogm reads {FORMAT}; "
                "make the data set anew, or use the version that made it"
            )
        try:
            return cls(path, attributes)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise Damaged(
                f"{path / 'zarr.json'} does not say what `ogm simulate` writes ({error!r}); "
                "restore the file, or make the data set anew in a new folder"
            ) from error

    @classmethod
    def exists(cls, path: str | os.PathLike[str]) -> bool:
        """Say whether `open` finds something, be it to complain about; not what a killed `create` left."""
        try:
            cls.open(path)
        except FileNotFoundError:
            return False
        except ValueError:
            return True
        return True

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        plan: Mapping[str, Any],
        counts: Mapping[str, int],
        beams: Sequence[Beams],
        versions: Mapping[str, str],
    ) -> "Store":
        """Begin a data set, or let one that was begun grow.

        Parameters
        ----------
        path : path
            A new or empty folder, or one whose data set has the same lidars.
        plan, versions : dict
            Provenance, kept as JSON.
        counts : dict of str to int
            Samples that each split shall have; an existing split may grow, not shrink.
        beams : sequence of Beams
            The lidars; a sample names its own by number.

        Raises
        ------
        ValueError
            If the folder holds something else, or a split would shrink.
        """
        path, counts = Path(path), _counts(counts)
        zarr = _zarr()
        if path.is_file():
            raise ValueError(f"{path} is a file; give a new or empty folder")
        if cls.exists(path):
            before = cls.open(path)
            for name, count in before.counts.items():
                if counts.get(name, 0) < count:
                    raise ValueError(
                        f"{path} has {count} samples of {name} planned, got {counts.get(name, 0)}; "
                        "a data set only grows"
                    )
            if before.beams != tuple(beams):
                raise ValueError(
                    f"{path} was begun with other lidars ({', '.join(one.name for one in before.beams)}) than "
                    f"those given ({', '.join(one.name for one in beams)}), or their numbers have changed; "
                    "give a new folder"
                )
            root = zarr.open_group(path, mode="r+")
        else:
            if (path / "zarr.json").exists():  # made by a `create` that was killed
                for name in counts:
                    shutil.rmtree(path / name, ignore_errors=True)
            elif path.is_dir() and any(path.iterdir()):
                raise ValueError(f"{path} holds other files; give a new or empty folder")
            path.mkdir(parents=True, exist_ok=True)
            root = zarr.open_group(path, mode="a", zarr_format=3, attributes={"format": BEGUN})
        for name, count in counts.items():
            _grow(root, name, count, _rays(beams))
        # Last: until then it is no data set, and is begun again.
        root.attrs.put(
            {
                "format": FORMAT,
                "plan": dict(plan),
                "splits": dict(counts),
                "lidars": [one.as_dict() for one in beams],
                "range_step": RANGE_STEP,
                "labels": list(LABELS),
                "versions": dict(versions),
            }
        )
        return cls.open(path)

    def __getitem__(self, split: str) -> Split:
        if split not in self.counts:
            raise KeyError(f"{self.path} has no split {split!r}; it has {', '.join(self.counts)}")
        return Split(self.path, split, self.counts[split], self.beams)

    def __iter__(self) -> Iterator[str]:
        return iter(self.counts)

    def write(self, split: str, shard: int, samples: Sequence[Sample]) -> int:
        """Write one shard: samples ``shard * SHARD`` and those that follow, all that the split has of it.

        Shards may be written by several processes at once, each shard by one. A reader sees the shard when
        all of it is on disk.

        Returns
        -------
        int
            Its size on disk [byte].

        Raises
        ------
        OSError
            If the disk is full; shards written before stay whole.
        """
        first = shard * SHARD
        wanted = min(SHARD, self.counts[split] - first)
        if [one.index for one in samples] != list(range(first, first + wanted)):
            raise ValueError(f"shard {shard} of {split} wants samples {first} to {first + wanted - 1}")
        numbers = {one: k for k, one in enumerate(self.beams)}
        rays = _rays(self.beams)
        facts = np.zeros((wanted, len(FACTS)))
        objects = np.zeros((wanted, OBJECTS, len(_COLUMNS)), np.float32)
        for k, one in enumerate(samples):
            rows = one.objects[:OBJECTS]
            facts[k] = _facts(one, numbers[one.beams], len(rows))
            objects[k, : len(rows)] = np.stack([rows[name] for name in _COLUMNS], axis=-1)
        columns: dict[str, NDArray[Any]] = {
            "returns": np.stack([pack(one.steps, one.intensities, rays) for one in samples]),
            "truth": np.stack([one.truth.state for one in samples]),
            "objects": objects,
            "facts": facts,
        }
        size = 0
        for name, values in columns.items():
            folder = self.path / split / name
            file = folder / "c" / str(shard) / "/".join(["0"] * (values.ndim - 1))
            with _zarr().config.set({"array.write_empty_chunks": True}):
                array = _opened(folder, "r+")
                try:
                    array[first : first + wanted] = values
                except (ValueError, RuntimeError, TypeError, EOFError):
                    # Zarr reads what stands there before it writes; where that is damaged, it has to go.
                    if not file.exists():
                        raise
                    file.unlink()
                    array[first : first + wanted] = values
            size += file.stat().st_size
        return size

    def sweep(self) -> int:
        """Remove what a killed writer left behind; return how many files. Nobody may be writing."""
        left = [path for name in self.counts for path in (self.path / name).rglob("*.partial")]
        left += self.path.glob("*.partial")
        for path in left:
            path.unlink()
        return len(left)

    def describe(self) -> dict[str, str]:
        """Tell what the data set holds, as names and values to print."""
        files = [file for name in self.counts for file in (self.path / name).rglob("*")]
        size = sum(file.stat().st_size for file in files if file.is_file())
        facts = {"format": FORMAT, "made by": " ".join(f"{k} {v}" for k, v in self.versions.items())}
        made = 0
        for name in self.counts:
            split = self[name]
            rows = split.facts
            rows = rows[rows[:, 0] > 0]
            made += len(rows)
            lidars = np.bincount(rows[:, FACTS.index("lidar")].astype(int), minlength=len(self.beams))
            by_lidar = ", ".join(f"{n} {one.name}" for n, one in zip(lidars, self.beams, strict=True) if n)
            of = "" if len(rows) == len(split) else f" of {len(split)}"
            facts[name] = f"{len(rows)}{of} samples" + (f" ({by_lidar})" if by_lidar else "")
        facts["size"] = f"{size / 1e6:.1f} MB" + (f", {size / made / 1e3:.0f} kB per sample" if made else "")
        facts["truth"] = f"{TRUTH_SPEC.shape[0]} x {TRUTH_SPEC.shape[1]} cells of {TRUTH_SPEC.resolution:g} m"
        facts["plan"] = ", ".join(f"{k} {v}" for k, v in self.plan.items())
        return facts


def _zarr() -> Any:
    try:
        import zarr
    except ImportError as error:
        raise ImportError(
            f'data sets are kept with zarr, which is missing ({error}): pip install "ogm-toolkit[sim]"'
        ) from error
    return zarr


def _opened(path: Path, mode: str = "r") -> Any:
    zarr = _zarr()
    try:
        return zarr.open_array(path, mode=mode)
    except FileNotFoundError as error:
        raise Damaged(
            f"{path} is missing: the data set is not whole; make it anew in a new folder"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:  # what zarr raises of odd metadata
        raise Damaged(
            f"{path} is no array that can be read ({error}): the data set is not whole; "
            "make it anew in a new folder"
        ) from error


def _counts(splits: Mapping[str, int]) -> dict[str, int]:
    """Return the samples of each split, or raise ValueError where they make no sense."""
    for name, count in splits.items():
        if not name.isidentifier():
            raise ValueError(f"a split's name is a word, got {name!r}")
        if not isinstance(count, int) or not 0 <= count <= MOST:
            raise ValueError(f"a split holds 0 to {MOST:,} samples, got {count!r} of {name}")
    return dict(splits)


def _rays(beams: Sequence[Beams]) -> int:
    """Return the rays of the lidar that has most."""
    return max(one.shape[0] * one.shape[1] for one in beams)


def _layout(rays: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and the type of a sample in each array."""
    return {
        "returns": ((3, rays), "uint8"),
        "truth": (TRUTH_SPEC.shape, "uint8"),
        "objects": ((OBJECTS, len(_COLUMNS)), "float32"),
        "facts": ((len(FACTS),), "float64"),
    }


def _grow(root: Any, name: str, count: int, rays: int) -> None:
    """Make the arrays of a split, or lengthen them."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    group = root.require_group(name)
    whole = {"compressors": [ZstdCodec(level=_LEVEL), Crc32cCodec()], "filters": None, "fill_value": 0}
    for array, (shape, kind) in _layout(rays).items():
        if array in group:
            if group[array].shape[0] != count:
                group[array].resize((count, *shape))
            continue
        large = array in ("returns", "truth")
        group.create_array(
            array,
            shape=(count, *shape),
            chunks=(1 if large else SHARD, *shape),
            shards=(SHARD, *shape) if large else None,
            dtype=kind,
            **whole,
        )
    group.attrs.put({"facts": list(FACTS), "objects": list(_COLUMNS)})


def _facts(sample: Sample, lidar: int, objects: int) -> list[float]:
    return [
        1.0,
        lidar,
        np.count_nonzero(sample.steps),
        np.count_nonzero(sample.truth.state),
        objects,
        sample.scenario,
        sample.stamp,
        *sample.T_world_sensor[:3].ravel(),
        *sample.T_vehicle_sensor[:3].ravel(),
        *sample.velocity,
        sample.yaw_rate,
        *sample.weather,
    ]


def _named(rows: NDArray[np.float32]) -> NDArray[Any]:
    objects = np.zeros(len(rows), OBJECT)
    for k, name in enumerate(_COLUMNS):
        objects[name] = rows[:, k]
    return objects

"""Samples of one split, read from its arrays on disk; ``docs/formats.md`` describes the layout."""

import math
import operator
import zlib
from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray

from ogm.extras import import_extra
from ogm.simulation.contents import FACTS, OBJECTS, OF_RADARS, POSES, SHARD, SWEEP, UNMEASURED, Contents
from ogm.simulation.mesh import Array, Floats, Ints
from ogm.simulation.sample import OBJECT_DTYPE, PlacedSweep, RadarSweep, SimulatedSample, Weather
from ogm.state import Truth
from ogm.storage.files import OgmError
from ogm.storage.remote import ObjectPath
from ogm.truth import TRUTH_SPEC


class Damaged(OgmError):
    """Bytes on disk differ from those written."""


class Split(Sequence[SimulatedSample]):
    """Samples of one split of a dataset.

    ``split[i]`` reads sample i; ``len(split)`` is the planned number, of which `finished` can be read. A split can be
    pickled and used by several processes at once.
    """

    def __init__(self, path: Any, name: str, count: int, contents: Contents) -> None:
        self.path, self.name, self.contents = path, name, contents
        self.columns = contents.facts
        self._count = count
        self._arrays: dict[str, Any] = {}
        self._small: dict[tuple[str, int], Array] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_arrays": {}, "_small": {}}

    def __repr__(self) -> str:
        return f"Split({str(self.path / self.name)!r}, {self._count} samples planned)"

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> SimulatedSample: ...
    @overload
    def __getitem__(self, index: slice) -> list[SimulatedSample]: ...
    def __getitem__(self, index: int | slice) -> SimulatedSample | list[SimulatedSample]:
        """Read samples.

        Raises
        ------
        IndexError
            If the index exceeds the planned number of samples.
        ValueError
            If the sample is not made yet.
        Damaged
            If the bytes of the sample differ from those written; the message gives the command that remakes it.
        """
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i, row = self._row(index)
        value = dict(zip(self.columns, row.tolist(), strict=True))
        beams = self.contents.beams[int(value["lidar"])]
        rays = beams.shape[0] * beams.shape[1]
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[:, :3] = row[FACTS.index(POSES[0]) :][:24].reshape(2, 3, 4)
        image = [self._read(name, i)[:rays].reshape(beams.shape) for name in ("steps", "intensities")]
        measured = image[0] != UNMEASURED if self.contents.gaps else None
        if measured is not None:
            image[0] = np.where(measured, image[0], np.uint16(0))
        heights = self._read("heights", i) if self.contents.heights else None
        truth = Truth(TRUTH_SPEC, self._read("truth", i), heights if heights is not None and heights.any() else None)
        objects = self.objects(i)
        velocity = np.array([value[f"velocity_{axis}"] for axis in "xyz"])
        arrays: Any = (*image, truth, objects, *poses, velocity, value["yaw_rate"], value["stamp"])
        weather = Weather(value["rain"], value["fog"], value["wet"], value.get("dust", 0.0))
        facts: Any = {"split": self.name, "index": i, "scenario": int(value["scenario"]), "weather": weather}
        facts |= {"measured": measured, "sweeps": self.sweeps(i)}
        return SimulatedSample(beams, *arrays, **facts)

    def objects(self, index: int) -> Array:
        """Read only the traffic participants of a sample, (K,) of `OBJECT_DTYPE`; errors as for ``split[index]``."""
        i, row = self._row(index)
        count = int(row[self.columns.index("objects")])
        rows = self._shard("objects", i // SHARD)[i % SHARD]
        self._compare("objects", i, rows[None])
        return unstructured_to_structured(rows[:count], OBJECT_DTYPE)

    def sweeps(self, index: int) -> tuple[PlacedSweep, ...]:
        """Read only the radar sweeps of a sample; errors as for ``split[index]``."""
        if not self.contents.radars:
            return ()
        rows, table = self.sweep_rows(index), self._read("detections", self._row(index)[0])
        ends = np.cumsum(rows[:, 3]).astype(int)
        result = []
        for row, start, stop in zip(rows, [0, *ends[:-1]], ends, strict=True):
            T = np.eye(4)
            T[:3] = row[4:16].reshape(3, 4)
            result.append(PlacedSweep(int(row[1]), row[2], T, row[16:], RadarSweep.of_table(table[start:stop])))
        return tuple(result)

    def sweep_rows(self, index: int) -> Floats:
        """Read the rows of a sample's sweeps, (sweeps, `SWEEP`), without their detections."""
        if not self.contents.radars:
            return np.zeros((0, SWEEP))
        i, _ = self._row(index)
        rows: Floats = self._shard("sweeps", i // SHARD)[i % SHARD]
        self._compare("sweeps", i, rows[None])
        rows = rows[rows[:, 0] > 0]
        capacity = self.contents.layout["detections"][0][0]
        if not (
            np.isin(rows[:, 1], range(len(self.contents.radars))).all()
            and np.isin(rows[:, 3], range(capacity + 1)).all()
            and rows[:, 3].sum() <= capacity
        ):
            raise self._damaged("sweeps", i, "values out of range")
        return rows

    def damage(self) -> Iterator[tuple[int, Damaged]]:
        """Read every finished sample; yield the index and error of each damaged sample."""
        for name in self.contents.large:
            self._array(name)  # raises if no sample can be read
        for i in range(len(self)):
            try:
                self._row(i)
                for name in self.contents.large:
                    self._read(name, i)
                self.objects(i)
                self.sweep_rows(i)
            except Damaged as error:
                yield i, error
            except ValueError:
                continue  # not made yet

    def _row(self, index: int) -> tuple[int, Floats]:
        """Return the index of a finished sample, counted from 0, and its row of facts."""
        i = operator.index(index)
        i += len(self) if i < 0 else 0
        if not 0 <= i < len(self):
            raise IndexError(f"sample {index} is beyond the {len(self)} samples of {self.name}")
        if isinstance(self.path, ObjectPath):  # fetch all arrays of the shard at once: requests take most of the time
            part = self.path / self.name
            self.path.fetch(shard_file(part, name, i // SHARD).key for name in self.contents.layout)
        row = self._shard("facts", i // SHARD)[i % SHARD]
        if not row[0]:
            raise ValueError(
                f"sample {i} of {self.name} is not made yet; make it with `ogm simulate {self.path} --resume`"
            )
        self._compare("facts", i, row[None])
        lidar, count, scenario = (row[self.columns.index(name)] for name in ("lidar", "objects", "scenario"))
        if not (0 <= lidar < len(self.contents.beams) and 0 <= count <= OBJECTS and np.isfinite(scenario)):
            raise self._damaged("facts", i, "values out of range")
        return i, row

    @property
    def facts(self) -> Floats:
        """Facts of every sample, (n, `columns`); zeros for samples not made yet."""
        if isinstance(self.path, ObjectPath):  # one request; missing shards read as zeros
            return np.asarray(self._array("facts")[: len(self)], np.float64)
        shards = [self._shard("facts", shard) for shard in range(-(-len(self) // SHARD))]
        return np.concatenate([np.zeros((0, len(self.columns))), *shards])

    @property
    def finished(self) -> Ints:
        """Indices of the finished samples, ascending."""
        return np.flatnonzero(self.facts[:, 0])

    def _shard(self, name: str, shard: int) -> Array:
        """Read a small array of a shard, cached for its ten samples."""
        key = name, shard
        if key not in self._small:
            rows = self._read(name, slice(shard * SHARD, min((shard + 1) * SHARD, len(self))))
            if name == "facts" and not rows[:, 0].all():
                return rows  # not cached: incomplete shards may be written later
            self._small[key] = rows
        return self._small[key]

    def _array(self, name: str) -> Any:
        """Open an array, cached, and check its shape, type and chunks."""
        if name not in self._arrays:
            path = self.path / self.name / name
            array, (shape, kind) = open_array(path), self.contents.layout[name]
            if array.shape[0] < len(self) or array.shape[1:] != shape or array.dtype != kind:
                raise incomplete(f"{path} has {array.dtype} {array.shape}, wanted {kind} {(len(self), *shape)}")
            if math.prod(array.chunks) > SHARD * math.prod(shape):  # zarr would allocate the declared size
                raise incomplete(f"{path} has chunks of {array.chunks}, wanted at most {SHARD} samples")
            self._arrays[name] = array
        return self._arrays[name]

    def _read(self, name: str, index: Any) -> Array:
        first = index if isinstance(index, int) else index.start
        there = shard_file(self.path / self.name, name, first // SHARD).exists()
        if name == "checksums" and not there:
            # written by a version without checksums
            return np.zeros((index.stop - first, len(self.contents.checked)), np.uint32)
        array = self._array(name)
        if not there:
            if name == "facts":
                return np.zeros((index.stop - first, len(self.columns)))  # not made yet
            raise self._damaged(name, first, "a file is missing")
        try:
            values: Array = array[index]
        except (ArithmeticError, EOFError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
            # errors of zarr and its codecs
            raise self._damaged(name, first, str(error)) from error
        if name in self.contents.large:
            self._compare(name, index, values[None])
        return values

    def _compare(self, name: str, index: int, values: Array) -> None:
        """Compare a sample's part of an array, (1, ...), with its checksum, if any."""
        stored = self._shard("checksums", index // SHARD)[index % SHARD]
        if stored.any() and stored[self.contents.checked.index(name)] != sample_checksums(self.name, index, values)[0]:
            raise self._damaged(name, index, "the checksum differs")

    def _damaged(self, name: str, index: int, why: str) -> Damaged:
        marker = shard_file(self.path / self.name, "facts", index // SHARD)
        return Damaged(
            f"sample {index} of {self.name} in {self.path}: the array {name} is damaged on disk ({why}); remake it "
            f"with `rm {marker}` and `ogm simulate {self.path} --resume`"
        )


def sample_checksums(split: str, first: int, values: Array) -> NDArray[np.uint32]:
    """Return CRC-32 checksums (k,) of each sample's part of an array, seeded by split name and sample index."""
    little = values.astype(values.dtype.newbyteorder("<"), copy=False)
    sums = [zlib.crc32(part.tobytes(), zlib.crc32(f"{split} {first + k}".encode())) for k, part in enumerate(little)]
    return np.array(sums, np.uint32)


_DIMENSIONS = {name: len(shape) for name, (shape, _) in Contents().layout.items()} | dict.fromkeys(OF_RADARS, 2)


def shard_file(split: Any, name: str, shard: int) -> Any:
    """Return the file or object that stores a shard of an array."""
    return split.joinpath(name, "c", str(shard), *["0"] * _DIMENSIONS[name])


def load_zarr() -> Any:
    """Import zarr and register `CheckedBlosc` as its Blosc codec.

    Raises
    ------
    ImportError
        If zarr is not installed; the message has the install line.
    """
    zarr = import_extra("zarr", "sim")
    from ogm.simulation.blosc import CheckedBlosc

    zarr.registry.register_codec("blosc", CheckedBlosc)
    zarr.config.set({"codecs.blosc": f"{CheckedBlosc.__module__}.{CheckedBlosc.__qualname__}"})
    return zarr


def open_array(path: Any, mode: str = "r") -> Any:
    """Open a Zarr array; raise `Damaged` if it is missing or unreadable."""
    zarr = load_zarr()
    try:
        if isinstance(path, ObjectPath):
            return zarr.open_array(path.objects.zarr, path=path.key, mode=mode, zarr_format=3)
        return zarr.open_array(path, mode=mode)
    except FileNotFoundError as error:
        raise incomplete(f"{path} is missing") from error
    except (ArithmeticError, AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        # errors of zarr for invalid metadata
        raise incomplete(f"{path} is not a readable array ({error})") from error


def incomplete(problem: str) -> Damaged:
    """Return the error for missing or invalid arrays."""
    return Damaged(f"{problem}: the dataset is incomplete; make it again in a new folder")

"""Datasets on disk: one Zarr v3 group per split, ten samples per shard, a checksum on every chunk.

Reading needs numpy and zarr, neither Open3D nor Dask.

>>> from ogm.simulation.store import Store
>>> sample = Store.open("data")["training"][0]                              # doctest: +SKIP
>>> sample.points, sample.truth, sample.objects, sample.T_world_sensor      # doctest: +SKIP

``docs/formats.md`` describes the layout: per split the arrays steps, intensities, truth, heights, objects, checksums
and facts. A shard's facts are written last, in one step, so a row with a 1 in front marks a complete sample.

The attributes of the root group have the format, the plan, the lidars, the library versions, and their own SHA-256.
They name no date and no machine, so that equal plans give equal bytes.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from ogm.io.reading import decode_json
from ogm.simulation.contents import FACTS, OBJECTS, SHARD, UNMEASURED, Contents, StoredRadar
from ogm.simulation.mesh import Floats, Floats32
from ogm.simulation.mounts import RadarMount
from ogm.simulation.sample import LABELS, OBJECT_DTYPE, RANGE_STEP, Beams, SimulatedSample
from ogm.simulation.split import Damaged, Split, load_zarr, open_array, sample_checksums, shard_file
from ogm.storage.archive import attributes_checksum
from ogm.storage.files import FilePath, OgmError, update_hint
from ogm.storage.remote import ObjectPath, as_path
from ogm.truth import TRUTH_SPEC

__all__ = ["FACTS", "FORMAT", "SHARD", "Damaged", "Split", "Store"]

FORMAT = "ogm.samples/3"
OLDER = "ogm.samples/2"  # without heights: readable, but not writable
GAPS = "ogm.samples/4"  # of recipes: with unmeasured beams
SWEEPS = "ogm.samples/5"  # with radars, with or without a recipe
KINDS = "ogm.samples/6"  # with planar lasers or depth cameras, without a recipe, with or without radars
BEGUN = "ogm.samples/begun"  # format of a dataset until all its arrays are created
MAX_SAMPLES = 1_000_000  # in a split
_LEVEL = 5  # of zstd: higher levels shrink files by 2 % and take four times as long


class Store:
    """A dataset on disk, opened with `Store.open`; its splits are ``store["training"]`` and so on."""

    def __init__(self, path: Any, attributes: Mapping[str, Any]) -> None:
        self.path = path
        self.format = str(attributes["format"])
        self.plan: dict[str, Any] = dict(attributes["plan"])
        self.versions: dict[str, str] = dict(attributes["versions"])
        self.beams = tuple(Beams.from_dict(lidar) for lidar in attributes["lidars"])
        radars = attributes["radars"] if self.format == SWEEPS or "radars" in attributes else ()
        self.radars = tuple(map(StoredRadar.from_dict, radars))
        self.counts = _counts(attributes["splits"])
        if not self.beams:
            raise ValueError("no lidars")
        gaps = self.format == GAPS or (self.format == SWEEPS and bool(self.plan.get("recipe")))
        self.contents = Contents(self.beams, self.radars, self.format != OLDER, gaps)

    @classmethod
    def open(cls, path: FilePath | ObjectPath) -> "Store":
        """Open a dataset for reading, in a folder or an object store (``s3://...``, see `ogm.storage.remote.as_path`).

        Raises
        ------
        FileNotFoundError
            If there is no dataset.
        OgmError
            If the folder holds anything else, or a dataset of another version.
        """
        place = as_path(path)
        try:
            attributes = decode_json((place / "zarr.json").read_bytes(), place)["attributes"]
            found = attributes["format"]
        except FileNotFoundError:
            raise FileNotFoundError(f"{place} holds no dataset; make one with `ogm simulate {place}`") from None
        except NotADirectoryError:
            raise OgmError(f"{place} is a file; give the folder of a dataset made by `ogm simulate`") from None
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise OgmError(f"{place} is not a dataset made by `ogm simulate` ({error!r})") from error
        if found == BEGUN:
            raise FileNotFoundError(
                f"{place} holds an interrupted dataset without samples; start again with `ogm simulate {place}`"
            )
        if found not in (FORMAT, GAPS, SWEEPS, KINDS, OLDER):
            raise OgmError(
                f"{place} has the format {found}, this version of ogm reads {FORMAT} to {KINDS}"
                + (update_hint(found, FORMAT, KINDS) or "; make the dataset again, or use the version that made it")
            )
        try:
            store = cls(place, attributes)
            if attributes.get("sha256", "") not in ("", attributes_checksum(attributes)):
                raise ValueError("the SHA-256 differs")
            return store
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise Damaged(
                f"{place / 'zarr.json'} differs from the files that `ogm simulate` writes ({error!r}); "
                "restore the file, or make the dataset again in a new folder"
            ) from error

    @classmethod
    def exists(cls, path: FilePath) -> bool:
        """Return whether a folder holds a dataset, even a damaged one, but not an interrupted `create`."""
        try:
            cls.open(path)
        except FileNotFoundError:
            return False
        except ValueError:
            pass
        return True

    @classmethod
    def create(
        cls,
        path: FilePath,
        plan: Mapping[str, Any],
        counts: Mapping[str, int],
        beams: Sequence[Beams],
        versions: Mapping[str, str],
    ) -> "Store":
        """Create a dataset, or extend an existing one.

        Parameters
        ----------
        path : path
            A new or empty folder, or the folder of a dataset with the same lidars.
        plan, versions : dict
            Plan and library versions, stored as JSON.
        counts : dict of str to int
            Number of samples per split; an existing split may grow, not shrink.
        beams : sequence of Beams
            Lidars of the samples, which refer to them by index.

        Raises
        ------
        ValueError
            If the folder holds anything else, or a split would shrink.
        """
        path, counts, zarr = Path(path), _counts(counts), load_zarr()
        if path.is_file():
            raise ValueError(f"{path} is a file; give a new or empty folder")
        if cls.exists(path):
            before = cls.open(path)
            if before.format == OLDER:
                raise ValueError(
                    f"{path} has the format {before.format}, which this version of ogm reads but does not write: give "
                    "a new folder, or use the version that made it"
                )
            for name, count in before.counts.items():
                if (got := counts.get(name, 0)) < count:
                    raise ValueError(
                        f"{path} has {count} planned samples of {name}, got {got}; a dataset cannot shrink"
                    )
            if before.beams != tuple(beams):
                names = ", ".join(lidar.name for lidar in before.beams)
                raise ValueError(f"{path} has other lidars ({names}) or parameters of them; give a new folder")
            root = zarr.open_group(path, mode="r+")
        else:
            if (path / "zarr.json").exists():  # from an interrupted `create`
                for name in counts:
                    shutil.rmtree(path / name, ignore_errors=True)
            elif path.is_dir() and any(path.iterdir()):
                raise ValueError(f"{path} holds other files; give a new or empty folder")
            path.mkdir(parents=True, exist_ok=True)
            root = zarr.open_group(path, mode="a", zarr_format=3, attributes={"format": BEGUN})
        gaps = bool(plan.get("recipe"))
        radars = tuple(StoredRadar.of_mount(RadarMount(**radar)) for radar in plan.get("radars", ()))
        for name, count in counts.items():
            _grow(root, name, count, Contents(tuple(beams), radars, gaps=gaps))
        # Last, so that an interrupted `create` does not count as a dataset and is started again.
        kinds = any(lidar.kind for lidar in beams)
        made: dict[str, Any] = {"format": KINDS if kinds else SWEEPS if radars else GAPS if gaps else FORMAT}
        made |= {"plan": dict(plan), "splits": counts, "lidars": [lidar.to_dict() for lidar in beams]}
        made |= {"radars": [radar._asdict() for radar in radars]} if radars else {}
        made |= {"range_step": RANGE_STEP, "labels": list(LABELS), "versions": dict(versions)}
        root.attrs.put(made | {"sha256": attributes_checksum(made)})
        return cls.open(path)

    def __getitem__(self, split: str) -> Split:
        if split not in self.counts:
            raise KeyError(f"{self.path} has no split {split!r}; splits: {', '.join(self.counts)}")
        return Split(self.path, split, self.counts[split], self.contents)

    def write(self, split: str, shard: int, samples: Sequence[SimulatedSample]) -> int:
        """Write one shard: ten samples, or the rest of a split.

        Several processes may write at once, but each shard is written by one of them. A reader sees a shard when all
        of it is on disk.

        Returns
        -------
        int
            Size of the shard on disk [byte].

        Raises
        ------
        OSError
            If the disk is full. Shards written before stay complete.
        ValueError
            If the samples do not belong to the shard.
        """
        first = shard * SHARD
        wanted = min(SHARD, self.counts[split] - first)
        if [sample.index for sample in samples] != list(range(first, first + wanted)):
            raise ValueError(f"shard {shard} of {split} needs the samples {first} to {first + wanted - 1}, in order")
        numbers = {lidar: k for k, lidar in enumerate(self.beams)}
        layout, checked = self.contents.layout, self.contents.checked
        columns = {array: np.zeros((wanted, *shape), kind) for array, (shape, kind) in layout.items()}
        for k, sample in enumerate(samples):
            rows = sample.objects[:OBJECTS]
            columns["steps"][k, : sample.steps.size] = self._steps(sample).ravel()
            columns["intensities"][k, : sample.steps.size] = np.where(sample.steps > 0, sample.intensities, 0).ravel()
            columns["truth"][k] = sample.truth.state
            if sample.truth.height_cm is not None:
                columns["heights"][k] = sample.truth.height_cm
            columns["objects"][k, : len(rows)] = structured_to_unstructured(rows, np.float32)
            columns["facts"][k] = _facts(sample, numbers[sample.beams], len(rows))[: layout["facts"][0][0]]
            if self.radars:
                _put_sweeps(sample, columns["sweeps"][k], columns["detections"][k])
        sums = [sample_checksums(split, first, columns[name]) for name in checked]
        columns["checksums"] = np.stack(sums, axis=-1)
        files = [shard_file(self.path / split, name, shard) for name in columns]
        for file in reversed(files):  # the facts first: without them the shard counts as not made
            file.unlink(missing_ok=True)
        for name, values in columns.items():
            with load_zarr().config.set({"array.write_empty_chunks": True}):
                open_array(self.path / split / name, "r+")[first : first + wanted] = values
        return sum(file.stat().st_size for file in files)

    def _steps(self, sample: SimulatedSample) -> NDArray[np.uint16]:
        """Return a range image as it is stored."""
        if sample.measured is None:
            return sample.steps
        if not self.contents.gaps:
            raise ValueError(f"{self.path} is not a dataset of a recipe and cannot store unmeasured beams")
        return np.where(sample.measured, sample.steps, np.uint16(UNMEASURED))

    def describe(self) -> dict[str, str]:
        """Return a summary of the dataset as names and values to print."""
        files = [file for name in self.counts for file in (self.path / name).rglob("*")]
        size = sum(file.stat().st_size for file in files if file.is_file())
        facts = {"format": self.format, "made by": " ".join(f"{k} {v}" for k, v in self.versions.items())}
        made = 0
        for name in self.counts:
            split = self[name]
            rows = split.facts
            rows = rows[rows[:, 0] > 0]
            made += len(rows)
            lidars = np.bincount(rows[:, FACTS.index("lidar")].astype(int), minlength=len(self.beams))
            by_lidar = ", ".join(f"{n} {lidar.name}" for n, lidar in zip(lidars, self.beams, strict=True) if n)
            of = "" if len(rows) == len(split) else f" of {len(split)}"
            facts[name] = f"{len(rows)}{of} samples" + (f" ({by_lidar})" if by_lidar else "")
        if self.radars:
            facts["radars"] = ", ".join(radar.name for radar in self.radars)
        facts["size"] = f"{size / 1e6:.1f} MB" + (f", {size / made / 1e3:.0f} kB per sample" if made else "")
        facts["truth"] = f"{TRUTH_SPEC.shape[0]} x {TRUTH_SPEC.shape[1]} cells of {TRUTH_SPEC.resolution:g} m"
        facts["plan"] = ", ".join(f"{k} {v}" for k, v in self.plan.items())
        return facts


def _counts(splits: Mapping[str, int]) -> dict[str, int]:
    """Return the number of samples per split; raise ValueError for invalid names or numbers."""
    for name, count in splits.items():
        if not name.isidentifier():
            raise ValueError(f"the name of a split must be an identifier, got {name!r}")
        if not isinstance(count, int) or not 0 <= count <= MAX_SAMPLES:
            raise ValueError(f"samples of {name} must be in 0 ... {MAX_SAMPLES:,}, got {count!r}")
    return dict(splits)


def _put_sweeps(sample: SimulatedSample, rows: Floats, table: Floats32) -> None:
    """Write the sweeps of a sample into its row of the arrays."""
    tables = [placed.detections.table for placed in sample.sweeps]
    for row, placed, detections in zip(rows, sample.sweeps, tables, strict=False):
        pose = placed.T_world_sensor[:3].ravel()
        row[:] = [1.0, placed.radar, placed.stamp, len(detections), *pose, *placed.velocity]
    if tables:
        every = np.concatenate(tables)
        table[: len(every)] = every


def _grow(root: Any, name: str, count: int, contents: Contents) -> None:
    """Create or lengthen the arrays of a split."""
    from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

    group = root.require_group(name)
    for array, (shape, kind) in contents.layout.items():
        if array in group:
            if group[array].shape[0] != count:
                group[array].resize((count, *shape))
            continue
        large = array in contents.large
        shuffled = BloscCodec(cname="zstd", clevel=_LEVEL, shuffle="shuffle")
        group.create_array(
            array,
            shape=(count, *shape),
            chunks=(1 if large else SHARD, *shape),
            shards=(SHARD, *shape) if large else None,
            dtype=kind,
            compressors=[shuffled if array == "steps" else ZstdCodec(level=_LEVEL), Crc32cCodec()],
            filters=None,
            fill_value=0,
        )
    group.attrs.put({"facts": list(contents.facts), "objects": list(OBJECT_DTYPE.names or ())})


def _facts(sample: SimulatedSample, lidar: int, objects: int) -> list[float]:
    poses = [*sample.T_world_sensor[:3].ravel(), *sample.T_vehicle_sensor[:3].ravel()]
    made = [1.0, lidar, objects, sample.scenario, sample.stamp]
    return [*made, *poses, *sample.velocity, sample.yaw_rate, *sample.weather]

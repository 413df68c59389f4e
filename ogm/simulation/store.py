"""Data sets on disk: one Zarr v3 group per split, ten samples per shard, a checksum on every chunk.

Reading needs numpy and zarr, neither Open3D nor Dask.

>>> from ogm.simulation.store import Store
>>> sample = Store.open("data")["training"][0]                              # doctest: +SKIP
>>> sample.points, sample.truth, sample.objects, sample.T_world_sensor      # doctest: +SKIP

``docs/formats.md`` has the layout: per split the arrays steps, intensities, truth, heights, objects, checksums, facts.
A shard's facts are written last, in one step, so a row whose first number is 1 marks a complete sample.

The attributes of the root group hold the format, the plan that the samples were made by, the lidars, and the
versions of the libraries that made them, and their own SHA-256; no date and no machine, so that the same plan gives the
same bytes.
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
from ogm.simulation.sample import LABELS, OBJECT, RANGE_STEP, Beams, SimulatedSample
from ogm.simulation.split import Damaged, Split, load_zarr, open_array, sample_checksums, shard_file
from ogm.storage.archive import attributes_checksum
from ogm.storage.files import FilePath, OgmError, update_hint
from ogm.storage.remote import ObjectPath, as_path
from ogm.truth import TRUTH_SPEC

__all__ = ["FACTS", "FORMAT", "SHARD", "Damaged", "Split", "Store"]

FORMAT = "ogm.samples/3"
OLDER = "ogm.samples/2"  # without heights: is read, but not written
GAPS = "ogm.samples/4"  # of recipes: some beams were not measured
SWEEPS = "ogm.samples/5"  # with radars, of recipes or not
KINDS = "ogm.samples/6"  # with planar lasers or depth cameras, which are no recipe's, with radars or not
BEGUN = "ogm.samples/begun"  # format of a data set until all its arrays are created
MOST = 1_000_000  # samples of a split
_LEVEL = 5  # of zstd: above it, files shrink by 2 % and writing takes four times as long


class Store:
    """A data set on disk. Open one with `Store.open`; the parts are ``store["training"]`` and so on."""

    def __init__(self, path: Any, attributes: Mapping[str, Any]) -> None:
        self.path = path
        self.format = str(attributes["format"])
        self.plan: dict[str, Any] = dict(attributes["plan"])
        self.versions: dict[str, str] = dict(attributes["versions"])
        self.beams = tuple(Beams.from_dict(one) for one in attributes["lidars"])
        radars = attributes["radars"] if self.format == SWEEPS or "radars" in attributes else ()
        self.radars = tuple(map(StoredRadar.from_dict, radars))
        self.counts = _counts(attributes["splits"])
        if not self.beams:
            raise ValueError("it names no lidars")
        gaps = self.format == GAPS or (self.format == SWEEPS and bool(self.plan.get("recipe")))
        self.contents = Contents(self.beams, self.radars, self.format != OLDER, gaps)

    @classmethod
    def open(cls, path: FilePath | ObjectPath) -> "Store":
        """Open a data set to read, from a folder or an object store (``s3://...``, see `ogm.storage.remote.as_path`).

        Raises
        ------
        FileNotFoundError
            If there is none.
        OgmError
            If the folder holds something else, or a data set of another version.
        """
        place = as_path(path)
        try:
            attributes = decode_json((place / "zarr.json").read_bytes(), place)["attributes"]
            found = attributes["format"]
        except FileNotFoundError:
            raise FileNotFoundError(f"{place} holds no data set; `ogm simulate {place}` makes one") from None
        except NotADirectoryError:
            raise OgmError(f"{place} is a file; a data set is a folder that `ogm simulate` made") from None
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise OgmError(f"{place} is no data set that `ogm simulate` made ({error!r})") from error
        if found == BEGUN:
            raise FileNotFoundError(
                f"{place} holds no data set yet: making it was stopped at once; `ogm simulate {place}` begins again"
            )
        if found not in (FORMAT, GAPS, SWEEPS, KINDS, OLDER):
            raise OgmError(
                f"{place} has the format {found}, this version of ogm reads {FORMAT} to {KINDS}"
                + (update_hint(found, FORMAT, KINDS) or "; make the data set anew, or use the version that made it")
            )
        try:
            store = cls(place, attributes)
            if attributes.get("sha256", "") not in ("", attributes_checksum(attributes)):
                raise ValueError("their SHA-256 differs")
            return store
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise Damaged(
                f"{place / 'zarr.json'} holds other values than `ogm simulate` writes ({error!r}); "
                "restore the file, or make the data set anew in a new folder"
            ) from error

    @classmethod
    def exists(cls, path: FilePath) -> bool:
        """Return whether there is a data set, be it damaged; what a killed `create` left is none."""
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
                    raise ValueError(f"{path} has {count} samples of {name} planned, got {got}; a data set only grows")
            if before.beams != tuple(beams):
                names = ", ".join(one.name for one in before.beams)
                raise ValueError(f"{path} was begun with other lidars ({names}) or numbers of them; give a new folder")
            root = zarr.open_group(path, mode="r+")
        else:
            if (path / "zarr.json").exists():  # made by a `create` that was killed
                for name in counts:
                    shutil.rmtree(path / name, ignore_errors=True)
            elif path.is_dir() and any(path.iterdir()):
                raise ValueError(f"{path} holds other files; give a new or empty folder")
            path.mkdir(parents=True, exist_ok=True)
            root = zarr.open_group(path, mode="a", zarr_format=3, attributes={"format": BEGUN})
        gaps = bool(plan.get("recipe"))
        radars = tuple(StoredRadar.of_mount(RadarMount(**one)) for one in plan.get("radars", ()))
        for name, count in counts.items():
            _grow(root, name, count, Contents(tuple(beams), radars, gaps=gaps))
        # Last: until then it is no data set, and is begun again.
        kinds = any(one.kind for one in beams)
        made: dict[str, Any] = {"format": KINDS if kinds else SWEEPS if radars else GAPS if gaps else FORMAT}
        made |= {"plan": dict(plan), "splits": counts, "lidars": [one.to_dict() for one in beams]}
        made |= {"radars": [one._asdict() for one in radars]} if radars else {}
        made |= {"range_step": RANGE_STEP, "labels": list(LABELS), "versions": dict(versions)}
        root.attrs.put(made | {"sha256": attributes_checksum(made)})
        return cls.open(path)

    def __getitem__(self, split: str) -> Split:
        if split not in self.counts:
            raise KeyError(f"{self.path} has no split {split!r}; it has {', '.join(self.counts)}")
        return Split(self.path, split, self.counts[split], self.contents)

    def write(self, split: str, shard: int, samples: Sequence[SimulatedSample]) -> int:
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
        layout, checked = self.contents.layout, self.contents.checked
        columns = {array: np.zeros((wanted, *shape), kind) for array, (shape, kind) in layout.items()}
        for k, one in enumerate(samples):
            rows = one.objects[:OBJECTS]
            columns["steps"][k, : one.steps.size] = self._steps(one).ravel()
            columns["intensities"][k, : one.steps.size] = np.where(one.steps > 0, one.intensities, 0).ravel()
            columns["truth"][k] = one.truth.state
            if one.truth.height_cm is not None:
                columns["heights"][k] = one.truth.height_cm
            columns["objects"][k, : len(rows)] = structured_to_unstructured(rows, np.float32)
            columns["facts"][k] = _facts(one, numbers[one.beams], len(rows))[: layout["facts"][0][0]]
            if self.radars:
                _put_sweeps(one, columns["sweeps"][k], columns["detections"][k])
        sums = [sample_checksums(split, first, columns[name]) for name in checked]
        columns["checksums"] = np.stack(sums, axis=-1)
        files = [shard_file(self.path / split, name, shard) for name in columns]
        for file in reversed(files):  # the facts first: until they are written again, the shard is not made
            file.unlink(missing_ok=True)
        for name, values in columns.items():
            with load_zarr().config.set({"array.write_empty_chunks": True}):
                open_array(self.path / split / name, "r+")[first : first + wanted] = values
        return sum(file.stat().st_size for file in files)

    def _steps(self, sample: SimulatedSample) -> NDArray[np.uint16]:
        """Return a range image as it is kept."""
        if sample.measured is None:
            return sample.steps
        if not self.contents.gaps:
            raise ValueError(f"{self.path} is no data set of a recipe, and keeps no beams that were not measured")
        return np.where(sample.measured, sample.steps, np.uint16(UNMEASURED))

    def describe(self) -> dict[str, str]:
        """Return what the data set holds, as names and values to print."""
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
            by_lidar = ", ".join(f"{n} {one.name}" for n, one in zip(lidars, self.beams, strict=True) if n)
            of = "" if len(rows) == len(split) else f" of {len(split)}"
            facts[name] = f"{len(rows)}{of} samples" + (f" ({by_lidar})" if by_lidar else "")
        if self.radars:
            facts["radars"] = ", ".join(one.name for one in self.radars)
        facts["size"] = f"{size / 1e6:.1f} MB" + (f", {size / made / 1e3:.0f} kB per sample" if made else "")
        facts["truth"] = f"{TRUTH_SPEC.shape[0]} x {TRUTH_SPEC.shape[1]} cells of {TRUTH_SPEC.resolution:g} m"
        facts["plan"] = ", ".join(f"{k} {v}" for k, v in self.plan.items())
        return facts


def _counts(splits: Mapping[str, int]) -> dict[str, int]:
    """Return the samples of each split, or raise ValueError where they make no sense."""
    for name, count in splits.items():
        if not name.isidentifier():
            raise ValueError(f"a split's name is a word, got {name!r}")
        if not isinstance(count, int) or not 0 <= count <= MOST:
            raise ValueError(f"a split holds 0 to {MOST:,} samples, got {count!r} of {name}")
    return dict(splits)


def _put_sweeps(sample: SimulatedSample, rows: Floats, table: Floats32) -> None:
    """Write the sweeps of a sample into its rows."""
    tables = [one.detections.table for one in sample.sweeps]
    for row, one, detections in zip(rows, sample.sweeps, tables, strict=False):
        pose = one.T_world_sensor[:3].ravel()
        row[:] = [1.0, one.radar, one.stamp, len(detections), *pose, *one.velocity]
    if tables:
        every = np.concatenate(tables)
        table[: len(every)] = every


def _grow(root: Any, name: str, count: int, contents: Contents) -> None:
    """Make the arrays of a split, or lengthen them."""
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
    group.attrs.put({"facts": list(contents.facts), "objects": list(OBJECT.names or ())})


def _facts(sample: SimulatedSample, lidar: int, objects: int) -> list[float]:
    poses = [*sample.T_world_sensor[:3].ravel(), *sample.T_vehicle_sensor[:3].ravel()]
    made = [1.0, lidar, objects, sample.scenario, sample.stamp]
    return [*made, *poses, *sample.velocity, sample.yaw_rate, *sample.weather]

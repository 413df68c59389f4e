"""Plan of a dataset: `DatasetPlan`, and the drive from which each sample is taken.

>>> from ogm.simulation.mounts import single_sensor
>>> from ogm.simulation.plan import DatasetPlan
>>> DatasetPlan(samples=20, validation=4, test=0, town_size=240, mounts=single_sensor("os1-64")).counts
{'training': 20, 'validation': 4, 'test': 0, 'sequences': 0}
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from ogm.simulation.mounts import MOUNTS, LidarMount, RadarMount
from ogm.simulation.recipe import RECIPES, DataRecipe

__all__ = ["SPLITS", "DatasetPlan", "count_towns", "moment", "sample_rng"]

SPLITS = ("training", "validation", "test", "sequences")
RUN = 10  # consecutive samples of one drive: one shard
LAP = 1000.0  # [s] length of a drive
WARM_UP = 20.0  # [s] of traffic before the first sample
BOUNDS = {  # bounds of `DatasetPlan` parameters, and their unit
    "drives": (1, 1000, ""), "spacing": (0.1, 100.0, " s"), "hd_layers": (2, math.inf, ""),
    "town_size": (240.0, 1000.0, " m"),
    "bad_weather": (0, 1, ", a share of the samples"), "in_motion": (0, 1, ", a share of the samples"),
}  # fmt: skip
# Settings missing in older datasets, which were made with today's defaults.
ADDED = {"drives", "test_towns", "spacing", "recipe", "radars"}
SEQUENCE = 100  # samples per sequence: 10 s at 10 Hz
PERIOD = 0.1  # [s] between samples of a sequence


@dataclass(frozen=True)
class DatasetPlan:
    """Plan of a dataset, which determines each sample by its index.

    The default is the paper's recipe (Sec. V): ten drives through one town, half of them clockwise, at 1 Hz;
    validation in the same town with other traffic; test in another town. Samples 1 s apart on a drive are very similar.
    Confidence intervals over a test need many drives (`drives`, `test_towns`) or a larger `spacing`.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    samples, validation, test : int
        Number of samples in each split.
    sequences : int
        Number of sequences of 100 samples (10 s at 10 Hz) with exact poses and velocities.
    truth : {"aimed", "hd", "none"}
        Observation of the truth: rays aimed at every cell; the paper's lidar of many layers; or no truth, for drives
        to be mapped. The scans are the same, and without truth take a sixth of the time.
    mounts : tuple of LidarMount
        Range sensors with their shares of the samples.
    bad_weather : float
        Share [0, 1] of the samples in rain, in fog or on wet roads.
    in_motion : float
        Share [0, 1] of the samples distorted by ego motion during the turn (rolling shutter).
    towns : int
        Number of towns of the training and validation drives, in turn; 1 in the paper. The test has towns of its own.
    town_size : float
        Side length of the towns [m], 240 to 1000.
    hd_layers : int
        Number of layers of the lidar for "hd" truth.
    drives : int
        Number of drives per split, which contribute ten samples each in turn.
    test_towns : int
        Number of towns of the test drives, in turn.
    spacing : float
        Time between samples of a drive [s], 0.1 to 100; always 0.1 s in `sequences`.
    recipe : str
        Name in `ogm.simulation.recipe.RECIPES`, or "" for none. A recipe sets mounts, towns, drives, spacing, weather
        and motion; the user chooses only the seed, the numbers of samples, the truth and the radars.
    radars : tuple of RadarMount
        Radars of every sample, in addition to its lidar.
    """

    seed: int = 1
    samples: int = 10_000
    validation: int = 1_000
    test: int = 100
    sequences: int = 0
    truth: str = "aimed"
    mounts: tuple[LidarMount, ...] = MOUNTS
    bad_weather: float = 0.0
    in_motion: float = 0.0
    towns: int = 1
    town_size: float = 480.0
    hd_layers: int = 3000
    drives: int = 10
    test_towns: int = 1
    spacing: float = 1.0
    recipe: str = ""
    radars: tuple[RadarMount, ...] = ()

    def __post_init__(self) -> None:
        whole = ("seed", "samples", "validation", "test", "sequences", "towns", "hd_layers", "drives", "test_towns")
        for name in whole:
            value = getattr(self, name)
            if not (isinstance(value, int | float | np.integer) and value >= 0 and value % 1 == 0):
                raise ValueError(f"{name} must be a whole number, 0 or more, got {value!r}")
            object.__setattr__(self, name, int(value))
        for name, kind in (("mounts", tuple), ("radars", tuple), ("town_size", float), ("spacing", float)):
            object.__setattr__(self, name, kind(getattr(self, name)))
        if len({radar.name for radar in self.radars}) < len(self.radars):
            raise ValueError(f"each radar needs a unique name, got {_short(self.radars)}")
        self._follow_recipe()
        if not sum(self.counts.values()):
            raise ValueError("the dataset would be empty: give at least one sample")
        if self.truth not in ("aimed", "hd", "none"):
            raise ValueError(f'truth must be "aimed", "hd" or "none", got {self.truth!r}')
        if not self.mounts:
            raise ValueError("mounts are empty: give at least one lidar")
        bounds = BOUNDS | dict.fromkeys(("towns", "test_towns"), (1, self.drives, ", the number of drives"))
        for name, (low, high, unit) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be in {low:g} ... {high:g}{unit}, got {getattr(self, name)}")

    def _follow_recipe(self) -> None:
        """Apply the settings of the recipe; raise ValueError for other values of them."""
        if not self.recipe:
            return
        if self.recipe not in RECIPES:
            raise ValueError(f"unknown recipe {self.recipe!r}; known recipes: {', '.join(RECIPES)}")
        given = RECIPES[self.recipe]
        skies = given.skies
        bad = skies.fog + skies.rain + skies.wet + skies.dust
        wanted = {"mounts": given.mounts, "town_size": given.town_size, "spacing": given.spacing}
        wanted |= {"in_motion": given.in_motion, "bad_weather": bad}
        usual = {field.name: field.default for field in fields(self)}
        for name in (*wanted, "towns", "test_towns", "drives"):
            value = wanted.get(name, usual[name])
            if getattr(self, name) not in (usual[name], value):
                got = _short(getattr(self, name))
                raise ValueError(f"recipe {self.recipe} sets {name} itself, got {got}; leave the option out")
            object.__setattr__(self, name, value)

    @property
    def counts(self) -> dict[str, int]:
        """Number of samples in each split."""
        counts = (self.samples, self.validation, self.test, SEQUENCE * self.sequences)
        return dict(zip(SPLITS, counts, strict=True))

    @classmethod
    def of_recipe(cls, name: str, *, samples: int | None = None, **chosen: Any) -> "DatasetPlan":
        """Make the plan of a recipe; by default validation has a twentieth of the training samples, test none.

        Parameters
        ----------
        name : str
            Name in `ogm.simulation.recipe.RECIPES`.
        samples : int, optional
            Number of training samples; by default `DataRecipe.samples`.
        **chosen
            Further parameters of `DatasetPlan`: other sizes, the seed, the truth.
        """
        if name not in RECIPES:
            raise ValueError(f"unknown recipe {name!r}; known recipes: {', '.join(RECIPES)}")
        usual = RECIPES[name].samples if samples is None else samples
        sizes: dict[str, Any] = {"samples": usual, "validation": usual // 20, "test": 0}
        return cls(**(sizes | chosen), recipe=name)

    @classmethod
    def from_options(
        cls, before: "DatasetPlan | None" = None, *, recipe: str | None = None, **chosen: Any
    ) -> "DatasetPlan":
        """Return the plan of a new or growing dataset.

        Parameters
        ----------
        before : DatasetPlan, optional
            Plan of the existing dataset; its larger counts are kept.
        recipe : str, optional
            See `of_recipe`.
        **chosen
            Parameters that differ from `before`, the recipe or the defaults. Without a recipe, a new dataset has a
            tenth as many samples for validation, at least one, and a hundredth for the test.

        Raises
        ------
        ValueError
            If a parameter is out of range, or differs from the existing dataset's.
        """
        if recipe is not None:
            plan = cls.of_recipe(recipe, **chosen)
        else:
            if before is None and (count := chosen.get("samples")) is not None:
                chosen = {"validation": max(count // 10, min(count, 1)), "test": count // 100} | chosen
            plan = replace(before or cls(), **chosen)
        return plan if before is None else plan.grown(before)

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> "DatasetPlan":
        """Make a plan from its `dataclasses.asdict`, also after a round trip through JSON or from an older version."""
        known = {field.name for field in fields(cls)}
        if odd := sorted((set(numbers) ^ known) - ADDED):
            raise ValueError(f"the plan has settings unknown to this version of ogm, or lacks some: {', '.join(odd)}")
        mounts = tuple(LidarMount(**mount) for mount in numbers["mounts"])
        radars = tuple(RadarMount(**radar) for radar in numbers.get("radars", ()))
        return cls(**(dict(numbers) | {"mounts": mounts, "radars": radars}))

    def grown(self, before: "DatasetPlan") -> "DatasetPlan":
        """Return this plan, with each count at least as large as in `before`.

        Raises
        ------
        ValueError
            If another setting differs: all samples of a dataset have one recipe.
        """
        sizes = ("samples", "validation", "test", "sequences")
        for field in fields(self):
            mine, theirs = getattr(self, field.name), getattr(before, field.name)
            if field.name not in sizes and mine != theirs:
                raise ValueError(
                    f"the dataset was begun with {field.name} = {_short(theirs)}, got {_short(mine)}; "
                    "leave the option out to continue it, or give a new folder"
                )
        return replace(self, **{name: max(getattr(self, name), getattr(before, name)) for name in sizes})


def _short(value: object) -> str:
    if isinstance(value, tuple):
        names = (mount.name if isinstance(mount, RadarMount) else f"{mount.share:g} x {mount.lidar}" for mount in value)
        return " + ".join(names) or "none"
    return str(value)


class Moment(NamedTuple):
    """Drive and time of a sample.

    Attributes
    ----------
    town, traffic : int
        Seeds of the town and of its traffic.
    clockwise : bool
        Direction of the ego vehicle's round trip.
    scenario : int
        Index of the drive within the split.
    time : float
        Time since the start of the drive [s].
    """

    town: int
    traffic: int
    clockwise: bool
    scenario: int
    time: float


def moment(plan: DatasetPlan, split: str, index: int) -> Moment:
    """Return the drive and the time of a sample.

    The drives contribute runs of ten samples in turn, so that a part of a dataset is as mixed as the whole, and a
    longer dataset begins with the samples of a shorter dataset.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
    if index < 0:
        raise ValueError(f"index must be 0 or more, got {index}")
    number = SPLITS.index(split)
    if plan.recipe:
        return _recipe_moment(plan, RECIPES[plan.recipe], split, index)
    if split == "sequences":
        scenario, frame = divmod(index, SEQUENCE)
        time = WARM_UP + PERIOD * frame
    else:
        runs = max(int(LAP / plan.spacing) // RUN, 1)  # of one drive
        lap, rest = divmod(index, plan.drives * runs * RUN)
        run, sample = divmod(rest, RUN)
        scenario = plan.drives * lap + run % plan.drives
        time = WARM_UP + plan.spacing * (run // plan.drives * RUN + sample)
    test = split == "test"
    town = _integer(plan.seed, int(test), scenario % (plan.test_towns if test else plan.towns))
    # Directions alternate in every town.
    towns = plan.test_towns if test and plan.test_towns > 1 else plan.towns
    way = scenario + (scenario // towns if towns % 2 == 0 else 0)
    return Moment(town, _integer(plan.seed, 2, number, scenario), way % 2 == 0, scenario, float(time))


def _recipe_moment(plan: DatasetPlan, recipe: DataRecipe, split: str, index: int) -> Moment:
    """Return the drive and the time of a sample of a recipe: a drive per ten samples, other towns in every split."""
    number = SPLITS.index(split)
    scenario, sample = divmod(index, SEQUENCE if split == "sequences" else RUN)
    town = _integer(plan.seed, 4, number, town_number(recipe, split, scenario))
    traffic = _integer(plan.seed, 5, number, scenario)
    begin = WARM_UP + traffic % 400 / 10
    time = begin + (PERIOD if split == "sequences" else recipe.spacing) * sample
    return Moment(town, traffic, scenario % 2 == 0, scenario, float(time))


def town_number(recipe: DataRecipe, split: str, scenario: int) -> int:
    """Return the index of a drive's town, counted from 0 in each split."""
    if split == "sequences":
        return scenario
    return scenario * RUN // (recipe.town_samples if split == "training" else recipe.town_others)


def count_towns(plan: Mapping[str, Any], split: str, scenarios: Iterable[int]) -> int:
    """Return the number of towns of the given drives of a split; `plan` is a dataset's stored plan."""
    if name := plan.get("recipe"):
        return len({town_number(RECIPES[name], split, scenario) for scenario in scenarios})
    planned = plan.get("test_towns" if split == "test" else "towns", 1)
    return len({scenario % planned for scenario in scenarios})


def sample_rng(plan: DatasetPlan, split: str, index: int, purpose: int) -> np.random.Generator:
    """Return the random generator of a sample for a purpose."""
    return np.random.default_rng([plan.seed, 3, SPLITS.index(split), index, purpose])


def _integer(*key: int) -> int:
    """Return a seed below 2**31 derived from all numbers of the key."""
    return int(np.random.SeedSequence(key).generate_state(1)[0] >> 1)

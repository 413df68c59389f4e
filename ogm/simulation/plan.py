"""What a data set shall hold: `DatasetPlan`, and which drive each of its samples is taken from.

>>> from ogm.simulation.mounts import only
>>> from ogm.simulation.plan import DatasetPlan
>>> DatasetPlan(samples=20, validation=4, test=0, town_size=240, mounts=only("os1-64")).counts
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
RUN = 10  # samples of one drive before the next one's turn: one shard
LAP = 1000.0  # [s] of a drive, from which samples are taken
WARM_UP = 20.0  # [s] that traffic has run before the first sample
BOUNDS = {  # of numbers of a `DatasetPlan`, and their unit
    "drives": (1, 1000, ""), "spacing": (0.1, 100.0, " s"), "hd_layers": (2, math.inf, ""),
    "town_size": (240.0, 1000.0, " m"),
    "bad_weather": (0, 1, ", a share of the samples"), "in_motion": (0, 1, ", a share of the samples"),
}  # fmt: skip
# settings that older data sets lack; their defaults are what those did
ADDED = {"drives", "test_towns", "spacing", "recipe", "radars"}
SEQUENCE = 100  # samples of one sequence: 10 s at 10 Hz
PERIOD = 0.1  # [s] from sample to sample of a sequence


@dataclass(frozen=True)
class DatasetPlan:
    """What a data set shall hold; with the number of a sample, all that is needed to make it.

    The default is the paper's recipe (Sec. V): ten drives through one town, half of them clockwise, at 1 Hz;
    validation in the same town with other traffic; test in another town. Samples of one drive 1 s apart are much
    alike: intervals over a test need many drives (`drives`, `test_towns`), or samples further apart (`spacing`).

    Parameters
    ----------
    seed : int
        Random seed.
    samples, validation, test : int
        Numbers of samples in these splits.
    sequences : int
        Pieces of 10 s at 10 Hz with exact poses and velocities, 100 samples each.
    truth : {"aimed", "hd", "none"}
        How the truth is observed: rays aimed at every cell, or the paper's lidar of many layers; or not at all, for
        drives that maps are made of: the scans are the same, in a sixth of the time.
    mounts : tuple of Mount
    bad_weather : float
        Share [0, 1] of the samples in rain, in fog or on wet roads.
    in_motion : float
        Share [0, 1] of the samples that the ego motion distorts during the turn (rolling shutter).
    towns : int
        Towns that training and validation drive through in turn; the paper has one. The test's are always
        others.
    town_size : float
        Side of the towns [m].
    hd_layers : int
        Layers of the lidar behind the "hd" truth.
    drives : int
        Drives that the samples of a split are taken from in turn, ten samples each time.
    test_towns : int
        Towns that the drives of the test go through in turn.
    spacing : float
        Time from one sample of a drive to its next one [s]. Of `sequences` it is always 0.1 s.
    recipe : str
        Name in `ogm.simulation.recipe.RECIPES`, or "" for none. A recipe sets mounts, towns, drives, spacing, weather
        and motion; only the seed, the numbers of samples, the truth and the radars are left to choose.
    radars : tuple of RadarMount
        Of every sample, beside its lidar.
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
                raise ValueError(f"{name} must be a whole number from 0 on, got {value!r}")
            object.__setattr__(self, name, int(value))
        for name, kind in (("mounts", tuple), ("radars", tuple), ("town_size", float), ("spacing", float)):
            object.__setattr__(self, name, kind(getattr(self, name)))
        if len({one.name for one in self.radars}) < len(self.radars):
            raise ValueError(f"each radar needs a name of its own, got {_short(self.radars)}")
        self._follow_recipe()
        if not sum(self.counts.values()):
            raise ValueError("the data set would be empty: ask for at least one sample")
        if self.truth not in ("aimed", "hd", "none"):
            raise ValueError(f'truth must be "aimed", "hd" or "none", got {self.truth!r}')
        if not self.mounts:
            raise ValueError("mounts are empty: give at least one lidar")
        bounds = BOUNDS | dict.fromkeys(("towns", "test_towns"), (1, self.drives, ", the number of drives"))
        for name, (low, high, unit) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be in {low:g} ... {high:g}{unit}, got {getattr(self, name)}")

    def _follow_recipe(self) -> None:
        """Take over what the recipe sets, and refuse other values."""
        if not self.recipe:
            return
        if self.recipe not in RECIPES:
            raise ValueError(f"there is no recipe {self.recipe!r}; there is {', '.join(RECIPES)}")
        given = RECIPES[self.recipe]
        skies = given.skies
        bad = skies.fog + skies.rain + skies.wet + skies.dust
        wanted = {"mounts": given.mounts, "town_size": given.town_size, "spacing": given.spacing}
        wanted |= {"in_motion": given.in_motion, "bad_weather": bad}
        usual = {one.name: one.default for one in fields(self)}
        for name in (*wanted, "towns", "test_towns", "drives"):
            value = wanted.get(name, usual[name])
            if getattr(self, name) not in (usual[name], value):
                got = _short(getattr(self, name))
                raise ValueError(f"the recipe {self.recipe} sets {name} itself, got {got}; leave the option out")
            object.__setattr__(self, name, value)

    @property
    def counts(self) -> dict[str, int]:
        """Samples of each split."""
        counts = (self.samples, self.validation, self.test, SEQUENCE * self.sequences)
        return dict(zip(SPLITS, counts, strict=True))

    @classmethod
    def of_recipe(cls, name: str, *, samples: int | None = None, **chosen: Any) -> "DatasetPlan":
        """Make the plan of a recipe, by default of its usual size: a twentieth as many samples for validation, no test.

        Parameters
        ----------
        name : str
            In `ogm.simulation.recipe.RECIPES`.
        samples : int, optional
            Of training.
        **chosen
            Other sizes, the seed, the truth: parameters of `DatasetPlan`.
        """
        if name not in RECIPES:
            raise ValueError(f"there is no recipe {name!r}; there is {', '.join(RECIPES)}")
        usual = RECIPES[name].samples if samples is None else samples
        sizes: dict[str, Any] = {"samples": usual, "validation": usual // 20, "test": 0}
        return cls(**(sizes | chosen), recipe=name)

    @classmethod
    def from_options(
        cls, before: "DatasetPlan | None" = None, *, recipe: str | None = None, **chosen: Any
    ) -> "DatasetPlan":
        """Return the plan of a new dataset, or that of a larger one.

        Parameters
        ----------
        before : DatasetPlan, optional
            Plan of the dataset that grows; its counts are kept where they are larger.
        recipe : str, optional
            See `of_recipe`.
        **chosen
            Parameters that differ from those of `before`, of the recipe, or from the defaults. Without a recipe, a new
            dataset has a tenth as many samples for validation, at least one, and a hundredth for the test.

        Raises
        ------
        ValueError
            If a parameter is out of its range, or the dataset was begun with another.
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
        """Make from what `dataclasses.asdict` returned, or from what JSON made of it; also by an older version."""
        known = {field.name for field in fields(cls)}
        if odd := sorted((set(numbers) ^ known) - ADDED):
            raise ValueError(f"the plan has other settings than this version of ogm: {', '.join(odd)}")
        mounts = tuple(LidarMount(**one) for one in numbers["mounts"])
        radars = tuple(RadarMount(**one) for one in numbers.get("radars", ()))
        return cls(**(dict(numbers) | {"mounts": mounts, "radars": radars}))

    def grown(self, before: "DatasetPlan") -> "DatasetPlan":
        """Return this plan, with `before`'s counts where those are larger, if it is `before` in all else.

        Raises
        ------
        ValueError
            If another setting differs: the samples of one data set are made by one recipe.
        """
        sizes = ("samples", "validation", "test", "sequences")
        for field in fields(self):
            mine, theirs = getattr(self, field.name), getattr(before, field.name)
            if field.name not in sizes and mine != theirs:
                raise ValueError(
                    f"the data set was begun with {field.name} = {_short(theirs)}, got {_short(mine)}; "
                    "leave the option out to go on, or give a new folder"
                )
        return replace(self, **{name: max(getattr(self, name), getattr(before, name)) for name in sizes})


def _short(value: object) -> str:
    if isinstance(value, tuple):
        names = (one.name if isinstance(one, RadarMount) else f"{one.share:g} x {one.lidar}" for one in value)
        return " + ".join(names) or "none"
    return str(value)


class Moment(NamedTuple):
    """When and where a sample is taken.

    Attributes
    ----------
    town, traffic : int
        Seeds.
    clockwise : bool
        Which way round the ego vehicle drives.
    scenario : int
        Number of the drive within the split.
    time : float
        [s] from the drive's beginning.
    """

    town: int
    traffic: int
    clockwise: bool
    scenario: int
    time: float


def moment(plan: DatasetPlan, split: str, index: int) -> Moment:
    """Return which drive a sample is from, and when.

    Runs of ten samples are taken from the drives in turn, so that a part of a data set is as mixed as the
    whole, and a longer one begins with the shorter one's samples.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
    if index < 0:
        raise ValueError(f"samples are counted from 0, got {index}")
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
    # both ways round by turns, in every town
    towns = plan.test_towns if test and plan.test_towns > 1 else plan.towns
    way = scenario + (scenario // towns if towns % 2 == 0 else 0)
    return Moment(town, _integer(plan.seed, 2, number, scenario), way % 2 == 0, scenario, float(time))


def _recipe_moment(plan: DatasetPlan, recipe: DataRecipe, split: str, index: int) -> Moment:
    """Return a drive for every ten samples, and a new town after so many drives; every split has its own towns."""
    number = SPLITS.index(split)
    scenario, sample = divmod(index, SEQUENCE if split == "sequences" else RUN)
    town = _integer(plan.seed, 4, number, town_number(recipe, split, scenario))
    traffic = _integer(plan.seed, 5, number, scenario)
    begin = WARM_UP + traffic % 400 / 10
    time = begin + (PERIOD if split == "sequences" else recipe.spacing) * sample
    return Moment(town, traffic, scenario % 2 == 0, scenario, float(time))


def town_number(recipe: DataRecipe, split: str, scenario: int) -> int:
    """Return which of a recipe's towns a drive goes through, counted from 0 in each split."""
    if split == "sequences":
        return scenario
    return scenario * RUN // (recipe.town_samples if split == "training" else recipe.town_others)


def count_towns(plan: Mapping[str, Any], split: str, scenarios: Iterable[int]) -> int:
    """Return how many towns some drives of a split go through, by a plan as a data set keeps it."""
    if name := plan.get("recipe"):
        return len({town_number(RECIPES[name], split, one) for one in scenarios})
    planned = plan.get("test_towns" if split == "test" else "towns", 1)
    return len({one % planned for one in scenarios})


def sample_rng(plan: DatasetPlan, split: str, index: int, purpose: int) -> np.random.Generator:
    """Return the random numbers that belong to one sample and one purpose."""
    return np.random.default_rng([plan.seed, 3, SPLITS.index(split), index, purpose])


def _integer(*key: int) -> int:
    """Return a seed below 2**31 that depends on all numbers of the key."""
    return int(np.random.SeedSequence(key).generate_state(1)[0] >> 1)

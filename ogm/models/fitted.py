"""Results of ``ogm calibrate``, read by `ogm.models.load_model`: fitted parameters, and a guarantee of false free.

>>> from ogm.models import Calibration
>>> Calibration("ray", {"p_miss": 0.1}).parameters
{'p_miss': 0.1}
"""

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Self

from ogm.io.reading import decode_json
from ogm.storage.files import OgmError, atomic_write, update_hint

FORMAT = "ogm.calibration/1"
MAX_PARAMETER = 1e300
_MIN_DRIVES = 4  # for standard errors
_SAFETY = ("false_free", "missed_occupied")


@dataclass(frozen=True)
class Guarantee:
    """Bound of a sensor model's false free on drives that resemble the calibrated drives, see `ogm.calibration`.

    Parameters
    ----------
    limit : float
        Largest share of a drive's occupied cells that are predicted free, in (0, 1).
    confidence : float
        Least probability that a further drive stays within the limit, in (0, 1).
    factor : float
        Factor for the mass of free, in [0, 1].
    drives : int
        Number of drives with occupied cells.
    sha256 : str
        Checksum of the weights; empty for models without weights.
    """

    limit: float
    confidence: float
    factor: float
    drives: int
    sha256: str = ""

    def __post_init__(self) -> None:
        if not (0 < self.limit < 1 and 0 < self.confidence < 1 and 0 <= self.factor <= 1):
            raise OgmError(f"limit and confidence must lie between 0 and 1, the factor in [0, 1], got {self}")

    def __str__(self) -> str:
        return (
            f"at most {100 * self.limit:g} % of the occupied cells of a drive are free, for {100 * self.confidence:g} "
            f"% of drives like the {self.drives} calibrated"
        )


@dataclass(frozen=True)
class Calibration:
    """Fitted parameters of a geometric model, or a guarantee of any model.

    Parameters
    ----------
    model : str
        "ray", "height-band" or "planar"; with a guarantee any model of `load_model`.
    parameters : dict of str to float
        Fitted parameters, and parameters of the calibration that the fit started from.
    start : dict of str to float
        Values before the fit.
    errors : dict of str to float or None
        Standard errors of the fitted parameters; None for fewer than four drives, a parameter at its bound or without
        effect, or an interrupted fit.
    before, after : dict of str to float
        Metrics of `ogm.metrics` on the frames of the fit: means over the frames of a drive, then over drives.
    data : dict
        Source of the frames, numbers of frames and drives, and the base rate of the fit.
    evaluations : int
        Number of evaluated sets of parameters.
    finished : bool
        False if the fit was interrupted.
    guarantee : Guarantee, optional
        Bound of false free.
    """

    model: str
    parameters: dict[str, float]
    start: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float | None] = field(default_factory=dict)
    before: dict[str, float] = field(default_factory=dict)
    after: dict[str, float] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    evaluations: int = 0
    finished: bool = True
    guarantee: Guarantee | None = None

    def __post_init__(self) -> None:
        if isinstance(self.guarantee, dict):
            object.__setattr__(self, "guarantee", Guarantee(**self.guarantee))
        known = default_parameters(self.model) if self.parameters or self.guarantee is None else {}
        for name, value in self.parameters.items():
            if name not in known:
                raise OgmError(f"{self.model} has no parameter {name!r}; it has {', '.join(known)}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_PARAMETER:
                raise OgmError(f"{name} must be a finite number, got {value!r}")

    @property
    def warnings(self) -> list[str]:
        """Warnings about the result: few drives, or a model that is less safe than before."""
        found = []
        drives = self.data.get("drives", _MIN_DRIVES)
        if drives < _MIN_DRIVES and self.guarantee is None:
            found.append(f"fitted to {drives} drives, hardly valid for others: fit to {_MIN_DRIVES} or more")
        if self.guarantee is not None and self.data.get("fitted_to") == self.data.get("name"):
            found.append("the parameters were fitted to the same dataset: the guarantee needs drives of no fit")
        if self.after.get("found_free") == 0:
            found.append("no cell is free with this guarantee: raise the limit, or lower the confidence")
        for name in _SAFETY:
            if name in self.after and self.after[name] > self.before[name]:
                change = f"{self.before[name]:.4f} to {self.after[name]:.4f}"
                found.append(f"less safe than before: {name} rises from {change}; evaluate it on other drives")
        return found

    def save(self, path: str | Path) -> None:
        """Write a JSON file in one step."""
        with atomic_write(path, "w") as file:
            json.dump({"format": FORMAT} | asdict(self), file, indent=1)
            file.write("\n")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file of `save`.

        Raises
        ------
        FileNotFoundError
            If the file does not exist.
        OgmError
            If it is no calibration, or has a model or parameters unknown to this version.
        """
        try:
            record = decode_json(Path(path).read_bytes(), Path(path))
            if not isinstance(record, dict) or (found := record.pop("format", None)) != FORMAT:
                hint = update_hint(found, FORMAT) if isinstance(record, dict) else ""
                raise OgmError(f"no {FORMAT} file of `ogm calibrate`{hint}")
            return cls(**record)
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise OgmError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def model_class(name: str) -> Any:
    """Return the class of a geometric model with adjustable parameters, by name."""
    from ogm.geometric import HeightBandISM, PlanarISM, RayISM

    classes = {"ray": RayISM, "height-band": HeightBandISM, "planar": PlanarISM}
    if name not in classes:
        raise OgmError(f"a geometric model with parameters must be one of {', '.join(classes)}, got {name!r}")
    return classes[name]


def default_parameters(name: str) -> dict[str, float]:
    """Return the adjustable parameters of a geometric model with their defaults."""
    return {number.name: number.default for number in fields(model_class(name)) if isinstance(number.default, float)}

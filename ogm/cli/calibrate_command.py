"""``ogm calibrate``: fit the parameters of a geometric model to labelled frames, or bound a model's false free."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from ogm.cli.console import complain, number_table, out, report_errors, stderr, ticked
from ogm.cli.options import First, FolderAxes, Kerbs, TruthSources, check_first, parsed_axes

if TYPE_CHECKING:
    from ogm.models import Calibration


@report_errors
def calibrate_command(
    data: Annotated[Path, Argument(help="Recording with truth, or dataset of `ogm simulate`.", metavar="DATA")],
    ism: Annotated[
        str,
        Option(
            help="Model: ray, height-band, planar, or an earlier result to start from; with --guarantee any model of "
            "`ogm map`."
        ),
    ] = "ray",
    fit: Annotated[
        str | None,
        Option(
            help="Parameters to fit, separated by commas; =LOW:HIGH sets the bounds of the search. [default: the "
            "error rates, weights and heights, see docs/evaluation.md]",
            metavar="NAME[=LOW:HIGH],...",
        ),
    ] = None,
    split: Annotated[str | None, Option(help="Split of simulated data. [default: train]")] = None,
    truth: TruthSources = None,
    kerbs: Kerbs = "ignore",
    axes: FolderAxes = "flu",
    base_rate: Annotated[
        str, Option(help="P(occupied) of a cell without evidence; data: the share of occupied cells.", metavar="P")
    ] = "data",
    first: First = None,
    every: Annotated[int, Option(help="Use every N-th frame.", metavar="N")] = 1,
    threads: Annotated[int, Option(help="Frames mapped at the same time by the fit.")] = 1,
    guarantee: Annotated[
        tuple[str, float] | None,
        Option(
            help="Fit nothing; discount the model's free so that at most this share of a drive's occupied cells is "
            "predicted free: false-free 0.01.",
            metavar="false-free SHARE",
        ),
    ] = None,
    confidence: Annotated[
        float, Option(help="With --guarantee: probability that a further drive is within it; needs 1/(1-P) - 1 drives.")
    ] = 0.9,
    out_path: Annotated[Path | None, Option("--out", help="Result file. [default: ./MODEL.json]")] = None,
) -> None:
    """Fit the parameters of a geometric model to the labels of your own sensor's data, by maximum likelihood.

    The result is a small JSON file. All commands take its path as a model. Evaluate it on drives that were not used
    for the fit: `ogm evaluate TEST --ism ray ray.json`. Ctrl-C ends the search and keeps the best parameters so far.

    With --guarantee, the model's false free is bounded on further drives like the given ones, and maps state the bound:
    `ogm calibrate DRIVES --ism combined --guarantee false-free 0.01`.
    """
    from ogm.calibration import calibrate
    from ogm.calibration import guarantee as bounded
    from ogm.datasets import open_dataset

    check_first(first)
    if every < 1:
        raise ValueError(f"--every must be at least 1, got {every}")
    path = Path(f"{Path(ism).stem}.json") if out_path is None else out_path
    if path.suffix != ".json":
        raise ValueError(f"--out must end in .json, got {path}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {path.parent} for --out {path.name}; create it first")
    if guarantee is not None and guarantee[0] != "false-free":
        raise ValueError(f"--guarantee takes false-free and a share, such as false-free 0.01, got {guarantee[0]}")
    if guarantee is not None and fit is not None:
        raise ValueError("--guarantee fits nothing: leave out --fit, and give its earlier result by --ism")
    sources = tuple((truth or "").split(",")) if truth else ()
    dataset = open_dataset(data, axes=parsed_axes(axes), split=split, default_split="train", truth=sources, kerbs=kerbs)
    frames = dataset[:first:every]
    if guarantee is not None:
        fitted = bounded(frames, ism, guarantee[1], confidence, reading=lambda numbers: ticked(numbers, "mapping"))
    else:
        with stderr.status("") as status:
            fitted = calibrate(
                frames,
                ism,
                fit=None if fit is None else _bounds(fit),
                base_rate=_base_rate(base_rate),
                threads=threads,
                reading=lambda numbers: ticked(numbers, "reading"),
                progress=lambda n, nll: status.update(f"evaluation {n}: NLL {nll:.4f} (Ctrl-C keeps the best so far)"),
            )
    fitted.save(path)
    _print(fitted)
    for warning in fitted.warnings:
        complain(warning)
    out.print(f"written {path}", markup=False, soft_wrap=True)
    if not fitted.finished:
        raise KeyboardInterrupt(f"the best parameters so far are in {path}")


def _base_rate(text: str) -> float | None:
    try:
        return None if text == "data" else float(text)
    except ValueError:
        raise ValueError(f"--base-rate takes a number or data, got {text!r}") from None


def _bounds(text: str) -> dict[str, tuple[float, float]]:
    """Return the parameters of --fit with their bounds."""
    from ogm.calibration.fit import BOUNDS

    found = {}
    for entry in text.split(","):
        name, equals, limits = (part.strip() for part in entry.partition("="))
        try:
            low, high = map(float, limits.split(":")) if equals else BOUNDS[name]
        except (ValueError, KeyError):
            known = f"NAME=LOW:HIGH, or one of {', '.join(BOUNDS)}"
            raise ValueError(f"--fit takes {known}; got {entry.strip()!r}") from None
        found[name] = low, high
    return found


def _print(fitted: "Calibration") -> None:
    title = f"{fitted.model}, {fitted.data['frames']} frames of {fitted.data['drives']} drives"
    table = number_table(title, "before", "after", "+-")
    if fitted.guarantee is None:
        for name, value in fitted.parameters.items():
            error = fitted.errors.get(name)
            table.add_row(name, f"{fitted.start[name]:.4g}", f"{value:.4g}", "" if error is None else f"{error:.2g}")
    for name, value in fitted.after.items():
        table.add_row(name, f"{fitted.before[name]:.4f}", f"{value:.4f}", "")
    out.print(table)
    if fitted.guarantee is not None:
        out.print(f"mass of free times {fitted.guarantee.factor:.4f}: {fitted.guarantee}", markup=False, soft_wrap=True)
    else:
        out.print("(+- standard error over drives)")

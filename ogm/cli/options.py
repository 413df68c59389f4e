"""Options that several commands take."""

from typing import Annotated

import typer

IntensityMax = Annotated[float | None, typer.Option(help="The file's intensity that means 1; by default the format's.")]
TimeUnit = Annotated[
    float | None,
    typer.Option(help="The file's unit of time [s]; by default whole numbers are nanoseconds, others seconds."),
]


def parsed_axes(text: str) -> str | tuple[str, ...]:
    """Return the name of some axes, or the three that were given."""
    return tuple(text.split(",")) if "," in text else text

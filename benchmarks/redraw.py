"""Draw again the pictures that need nothing but records: no scan, no map, no measurement.

    python benchmarks/redraw.py

Writes docs/pictures/paper_curves.png (needs the values, see there), quality_maps.png, quality_range.png,
quality_real.png, quality_reliability.png and soak.png.
"""

import soak  # first: it sets the number of threads

# isort: split
import argparse
import json

import _paper_facts
import _quality_pictures
import paper_curves
from _charts import caption
from _run import PICTURES, RESULTS


def main() -> None:
    """Draw them."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    names = ("paper_curves", "quality", "soak")
    records = {name: json.loads((RESULTS / f"{name}.json").read_text()) for name in names}
    soak.picture(records["soak"], PICTURES / "soak.png")
    if paper_curves.CURVES.is_file():
        found, curves = records["paper_curves"], _paper_facts.read_curves(paper_curves.CURVES)
        paper_curves.draw(PICTURES / "paper_curves.png", curves, found, caption(found))
    quality = records["quality"]
    note = caption(quality)
    _quality_pictures.by_distance(PICTURES / "quality_range.png", quality["town"], note)
    _quality_pictures.recordings(PICTURES / "quality_real.png", quality["real"], note)
    _quality_pictures.reliability(PICTURES / "quality_reliability.png", quality["reliability"], note)
    _quality_pictures.maps(PICTURES / "quality_maps.png", quality["drives"], note)


if __name__ == "__main__":
    main()

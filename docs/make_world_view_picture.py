"""Make docs/pictures/world_view.png: a world map in the browser, all of it and a part, as `ogm view` shows it.

    python docs/make_world_view_picture.py MAP

MAP is a map of simulated drives, such as `ogm world build` makes of those in benchmarks/README.md. Wants Chromium.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from ogm.world import WorldMap
from ogm.world.view_server import serve_world

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from chromium import Page, open_chromium  # noqa: E402

SIZE = (1120, 640)


def shot(page: Page) -> np.ndarray:
    """Return a picture of a page when its tiles are there."""
    page.wait("document.body?.dataset.state !== undefined")
    page.run("new Promise(done => setTimeout(done, 500))")
    page.wait("document.body.dataset.state === 'ready'")
    return page.picture()


def main() -> None:
    """Write the picture."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    with WorldMap.open(sys.argv[1]) as world, serve_world(world, "town") as address, open_chromium() as browse:
        page = browse(address, SIZE)
        shots = [shot(page)]
        x0, x1, y0, y1 = world.cells().extent
        page.run(f"location.hash = '#x={(x0 + x1) / 2}&y={(y0 + y1) / 2}&metre=12'")
        shots.append(shot(page))
    image = Image.fromarray(np.concatenate(shots, axis=1)).resize((SIZE[0] * 5 // 4, SIZE[1] * 5 // 8))
    image.quantize(200).save(ROOT / "docs" / "pictures" / "world_view.png", optimize=True)


if __name__ == "__main__":
    main()

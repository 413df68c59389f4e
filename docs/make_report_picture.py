"""Make docs/pictures/report.png: parts of a report of `ogm evaluate`, as a browser shows them.

    ogm evaluate DATA --ism height-band ray lite --samples 24 --out report
    python docs/make_report_picture.py report/report.html

DATA is a simulated data set, whose pictures may be passed on. Wants Chromium or Chrome on the path.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
PARTS = {  # sections that are shown
    "scores": ("summary", "scores"),
    "curves": ("curves",),
    "frames": ("frames",),
}
SECTIONS = ("summary", "scores", "paired", "per-frame", "curves", "frames", "run")
WIDTH, HEIGHT = 1300, 1180


def shot(browser: str, page: str, shown: tuple[str, ...], theme: str, folder: Path) -> Image.Image:
    """Return a picture of some sections in a browser."""
    hidden = ", ".join(f"section#{name}" for name in SECTIONS if name not in shown)
    first = "" if "summary" in shown else ", h1, main > p"
    style = f"<style>{hidden}{first} {{ display: none !important }} :root {{ color-scheme: {theme} }}</style>"
    path, picture = folder / "part.html", folder / "part.png"
    path.write_text(page.replace("</head>", f"{style}</head>", 1))
    words = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=4000")
    size = f"--window-size={WIDTH},{HEIGHT}"
    subprocess.run([browser, *words, size, f"--screenshot={picture}", path.as_uri()], check=True, capture_output=True)
    with Image.open(picture) as image:
        return image.convert("RGB")


def main() -> None:
    """Write the picture."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None or len(sys.argv) != 2:
        sys.exit(f"{__doc__}\n" if browser else f"no browser on the path: none of {', '.join(BROWSERS)}")
    page = Path(sys.argv[1]).read_text()
    with tempfile.TemporaryDirectory() as folder:
        themes = ("light", "dark", "light")
        parts = [
            np.asarray(shot(browser, page, shown, theme, Path(folder)))
            for shown, theme in zip(PARTS.values(), themes, strict=True)
        ]
    image = Image.fromarray(np.concatenate(parts, axis=1))
    image = image.resize((image.width * 5 // 8, image.height * 5 // 8), Image.Resampling.LANCZOS)
    image.quantize(200).save(Path(__file__).parent / "pictures" / "report.png", optimize=True)


if __name__ == "__main__":
    main()

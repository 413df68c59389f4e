"""Check that a wheel and a source distribution hold what they must: `python .ci/contents.py dist`."""

import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Compare the package's files with those of both distributions."""
    folder = Path(sys.argv[1])
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    source = [one for one in (ROOT / "ogm").rglob("*") if one.is_file() and "__pycache__" not in one.parts]
    wanted = {str(one.relative_to(ROOT)) for one in source}
    assert {"ogm/py.typed", "ogm/data/lite.onnx", "ogm/data/report.html", "ogm/data/view.html"} <= wanted
    packed = set(zipfile.ZipFile(wheel).namelist())
    info = next(name.split("/")[0] for name in packed if name.endswith("/METADATA"))
    licences = {f"{info}/licenses/{name}" for name in ("LICENSE", "NOTICE")}
    assert wanted | licences <= packed, sorted((wanted | licences) - packed)
    strange = {name for name in packed - wanted if not name.startswith(info)}
    assert not strange, sorted(strange)
    metadata = zipfile.ZipFile(wheel).read(f"{info}/METADATA").decode()
    assert "License-Expression: Apache-2.0" in metadata
    assert "Typing :: Typed" in metadata
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted |= {"pyproject.toml", "README.md", "LICENSE", "NOTICE"}
    assert wanted <= names, sorted(wanted - names)
    sizes = " and ".join(f"{one.stat().st_size / 1e6:.1f} MB" for one in (wheel, sdist))
    print(f"{len(packed)} files in the wheel; {sizes}")


if __name__ == "__main__":
    main()

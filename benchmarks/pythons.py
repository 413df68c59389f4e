"""Which extras can be installed on which Python from wheels alone, by a run of uv's resolver: nothing is installed.

    python benchmarks/pythons.py            # about 2 minutes; writes benchmarks/results/pythons.json

Where an extra cannot be resolved, each of its requirements is resolved alone, to name the ones without a wheel.
"""

import _run as run

# isort: split
import re
import subprocess
import sys
import tomllib

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS = {"glibc 2.35": "x86_64-manylinux_2_35", "glibc 2.28": "x86_64-manylinux_2_28"}  # Ubuntu 22.04; RHEL 8


def uv(*words: str, text: str = "") -> subprocess.CompletedProcess[str]:
    """Run uv, which is installed beside Python."""
    return subprocess.run([sys.executable, "-m", "uv", *words], input=text, capture_output=True, text=True, check=False)


def without_wheel(requirements: list[str], python: str, platform: str) -> list[str]:
    """Return the requirements without a wheel; each is tried alone if they do not resolve together."""
    words = ("pip", "compile", "--quiet", "--only-binary", ":all:", "--python-version", python)
    words += ("--python-platform", platform, "-")
    if uv(*words, text="\n".join(requirements)).returncode == 0:
        return []
    alone = [one for one in requirements if uv(*words, text=one).returncode]
    return [re.split(r"[\[>=<]", one)[0] for one in alone] or ["together"]


def main() -> None:
    """Resolve every extra for every Python."""
    given = run.Parser(__doc__).parse_args()
    project = tomllib.loads((run.ROOT / "pyproject.toml").read_text())["project"]
    extras = {"base": project["dependencies"]}
    extras |= {
        name: project["dependencies"] + requirements
        for name, requirements in project["optional-dependencies"].items()
        if name not in ("all", "test", "dev", "bench", "docs")
    }
    missing = {
        name: {
            python: {system: without_wheel(requirements, python, platform) for system, platform in PLATFORMS.items()}
            for python in PYTHONS
        }
        for name, requirements in extras.items()
    }
    record = run.environment() | {"uv": uv("--version").stdout.split()[1], "without a wheel": missing}
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()

"""The README as the package index shows it: its links lead to the repository. All else is in pyproject.toml."""

import re
import tomllib
from pathlib import Path


def index_text(readme: str, repository: str | None, tag: str) -> str:
    """Return a README whose links are absolute, below a repository as GitHub has it.

    Without a repository pictures are left out, and links are their words alone: nothing leads nowhere.
    """

    def absolute(found: re.Match[str]) -> str:
        mark, words, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        if repository is None:
            return "" if mark else words
        return f"{mark}[{words}]({repository}/{'raw' if mark else 'blob'}/{tag}/{target})"

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", absolute, readme)


if __name__ == "__main__":  # as the build runs it
    from setuptools import setup

    here = Path(__file__).parent
    project = tomllib.loads((here / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (here / "README.md").read_text(encoding="utf-8")
    setup(
        long_description=index_text(text, project.get("urls", {}).get("Repository"), f"v{project['version']}"),
        long_description_content_type="text/markdown",
    )

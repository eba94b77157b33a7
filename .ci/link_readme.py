"""Turn the relative links of README.md into absolute ones, for the page of a release on PyPI.

    python .ci/link_readme.py OWNER/NAME TAG

The tag has to be `v` and the version of the package.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(!\[[^\]]*\]\(|\]\()((?!https?:|#|mailto:)[^)\s]+)(?=\))")
"""The end of a link of Markdown to a file of the repository, or a whole picture."""
VERSION = re.compile(r'^__version__ = "(.+)"$', re.MULTILINE)


def main() -> None:
    """Write README.md anew."""
    repository, tag = sys.argv[1:]
    source = (ROOT / "src" / "gscompleter" / "__init__.py").read_text("utf-8")
    check_tag(tag, source)
    readme = ROOT / "README.md"
    readme.write_text(make_absolute(readme.read_text("utf-8"), repository, tag), "utf-8")


def check_tag(tag: str, source: str) -> None:
    """End the program if a tag is not that of the version in `source`."""
    found = VERSION.search(source)
    if found is None or tag != f"v{found[1]}":
        sys.exit(f"The tag {tag} is not v and the version {found and found[1]}; tag that one.")


def make_absolute(text: str, repository: str, tag: str) -> str:
    """Link the files of a repository at a tag: pictures by their bytes, others by their page."""

    def replace(link: re.Match[str]) -> str:
        kind = "raw" if link[1].startswith("!") else "blob"
        return f"{link[1]}https://github.com/{repository}/{kind}/{tag}/{link[2]}"

    return LINK.sub(replace, text)


if __name__ == "__main__":
    main()

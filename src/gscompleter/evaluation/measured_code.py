"""Which code gave a score: its commit, and a digest of the files that decide pictures and scores.

The digest is of the syntax trees: comments, docstrings and the layout of the source do not count.
"""

from __future__ import annotations

import ast
import hashlib
import shutil
import subprocess
from functools import cache
from pathlib import Path

PACKAGE_FOLDER = Path(__file__).parents[1]
METHOD = (
    *("completer.py", "state.py", "types.py", "config", "data", "evaluation/methods.py"),
    *("evaluation/steps.py", "evaluation/metrics", "evaluation/baselines", "generators", "guards"),
    *("numerics", "reconstructors", "render", "stages", "trust"),
)
"""Files and folders of the package that decide pictures and scores of the default models."""


@cache
def find_commit() -> str | None:
    """Find the commit of this code, or None if it is not a git checkout.

    It ends with `-dirty` if the sources differ from it; results that lie in the checkout may.
    """
    # From src/gscompleter of a checkout; an installed package has no .git there.
    root = PACKAGE_FOLDER.parents[1]
    if not (root / ".git").exists() or shutil.which("git") is None:
        return None
    git = ["git", "-C", str(root)]
    described = subprocess.run(
        [*git, "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True, check=False
    )
    if described.returncode:
        return None
    changed = subprocess.run(
        [*git, "status", "--porcelain", "--", "src"], capture_output=True, text=True, check=False
    )
    return described.stdout.strip() + ("-dirty" if changed.stdout.strip() else "")


def compute_method_digest(package: Path = PACKAGE_FOLDER) -> str:
    """Compute the digest of the method of the package in a folder, 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for path in list_method_files(package):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0")
        words: list[str] = []
        collect_words(ast.parse(path.read_bytes()), words)
        digest.update("\0".join(words).encode("utf-8", "backslashreplace") + b"\0")
    return digest.hexdigest()[:16]


def list_method_files(package: Path) -> list[Path]:
    """List the sources of the method in a fixed order."""
    found: set[Path] = set()
    for name in METHOD:
        place = package / name
        found |= {place} if place.is_file() else {*place.rglob("*.py")}
    return sorted(found)


def collect_words(node: ast.AST, words: list[str]) -> None:
    """Append the words of a syntax tree, which are the same for every version of Python."""
    words.append(type(node).__name__)
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            # Versions of Python differ in the fields that they leave empty. A string that stands
            # alone is a docstring.
            if child is None or (isinstance(child, ast.Expr) and is_text(child.value)):
                continue
            words.append(name)
            if isinstance(child, ast.AST):
                collect_words(child, words)
            else:
                words.append(repr(child))


def is_text(node: ast.expr) -> bool:
    """Check whether an expression is a string constant."""
    return isinstance(node, ast.Constant) and isinstance(node.value, str)

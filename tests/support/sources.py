"""The sources of the package, parsed once in a process for all tests that read them."""

import ast
import gc
from functools import cache
from pathlib import Path

from paths import PACKAGE


@cache
def parse_package() -> dict[Path, ast.Module]:
    """Parse all files of the package; the paths are those of the repository."""
    # A million nodes that stay: searches for garbage among them take longer than the parser.
    gc.disable()
    trees = {path: ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    gc.freeze()
    gc.enable()
    return trees


@cache
def list_nodes(path: Path) -> tuple[ast.AST, ...]:
    """List the nodes of a file of the package."""
    return tuple(ast.walk(parse_package()[path]))

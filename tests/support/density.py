"""Print how densely the source is written, for `make lint`: figures to read, with no limit.

python tests/support/density.py [FOLDER OR FILE ...]

    comments   lines with a comment and nothing else, per 1,000 lines
    packed     assignments of several unrelated values (`a, b = x, y`), per 100 functions
    one-use    functions of a module with at most eight lines and one use, of all of them
    length     lines of a function: the median, and what nine of ten stay below
    repeated   names of functions, classes and constants that several modules define
"""

from __future__ import annotations

import argparse
import ast
import re
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from statistics import median, quantiles

from paths import ROOT

SHORT = 8
"""Lines up to which a function may be a snippet that reads better in its one place."""
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Density:
    """Figures of some files."""

    lines: int
    comments: int
    packed: int
    lengths: list[int]
    num_module_functions: int
    one_use: list[str]
    repeated: list[str]

    def describe(self) -> str:
        """Write the figures in one line, and the repeated names in a second."""
        usual = median(self.lengths)
        most = quantiles(self.lengths, n=10)[-1]
        figures = [
            f"{self.lines:,} lines",
            f"comments {1000 * self.comments / self.lines:.1f} per 1,000",
            f"packed {100 * self.packed / len(self.lengths):.1f} per 100 functions",
            f"one-use {100 * len(self.one_use) / self.num_module_functions:.0f} %",
            f"length {usual:.0f}, 90 % below {most:.0f}",
            f"repeated {len(self.repeated)}",
        ]
        return ", ".join(figures) + f"\n  {' '.join(self.repeated)}"


def list_files(places: Sequence[Path]) -> list[Path]:
    """List the Python files of folders, and files that are given themselves."""
    # Resolved, so that a file that two folders name is counted once.
    return [
        file.resolve()
        for place in places
        for file in (sorted(place.rglob("*.py")) if place.is_dir() else [place])
    ]


def parse_files(places: Sequence[Path]) -> dict[Path, ast.Module]:
    """Parse the files of folders, and files that are given themselves."""
    return {file: ast.parse(file.read_text("utf-8")) for file in list_files(places)}


def count_comments(file: Path) -> int:
    """Count the lines that hold a comment alone, without those that instruct a tool."""
    with tokenize.open(file) as text:
        return sum(
            token.type == tokenize.COMMENT
            and token.line.lstrip().startswith("#")
            and not re.match(r"#(!|\s*(noqa|type:))", token.string)
            for token in tokenize.generate_tokens(text.readline)
        )


def is_packed(node: ast.AST) -> bool:
    """Return True for `a, b = x, y`."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    return isinstance(node.targets[0], ast.Tuple)


def measure_length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the lines of a function without its signature and docstring."""
    body = function.body
    if ast.get_docstring(function) is not None and len(body) > 1:
        body = body[1:]
    return (body[-1].end_lineno or 0) - body[0].lineno + 1


def list_names(statement: ast.stmt) -> list[str]:
    """List the names that a statement of a module defines, without those of Python itself."""
    if isinstance(statement, (*FUNCTIONS, ast.ClassDef)):
        return [statement.name]
    targets: list[ast.expr] = []
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    nodes = [node for target in targets for node in ast.walk(target)]
    names = [node.id for node in nodes if isinstance(node, ast.Name)]
    return [name for name in names if not name.startswith("__")]


def iterate_functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """List all functions and methods."""
    return (node for node in ast.walk(tree) if isinstance(node, FUNCTIONS))


def find_repeated(trees: Mapping[Path, ast.Module]) -> list[str]:
    """Find the names that several modules define."""
    homes = defaultdict[str, set[Path]](set)
    for file, tree in trees.items():
        for name in chain.from_iterable(map(list_names, tree.body)):
            homes[name].add(file)
    return sorted(name for name, files in homes.items() if len(files) > 1)


def measure(places: Sequence[Path], users: Sequence[Path] = ()) -> Density:
    """Measure the files of some folders; uses of a function are counted in `users`, too."""
    trees = parse_files(places)
    words = Counter[str]()
    for file in {*trees, *list_files(users)}:
        words.update(re.findall(r"[A-Za-z_]\w*", file.read_text("utf-8")))
    own = []
    for tree in trees.values():
        for node in tree.body:
            if isinstance(node, FUNCTIONS):
                own.append(node)
    definitions = Counter(function.name for function in own)
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    return Density(
        lines=sum(len(file.read_text("utf-8").splitlines()) for file in trees),
        comments=sum(map(count_comments, trees)),
        packed=sum(map(is_packed, nodes)),
        lengths=[measure_length(f) for tree in trees.values() for f in iterate_functions(tree)],
        num_module_functions=len(own),
        # A name that stands in two places is defined in one and used in the other.
        one_use=[
            function.name
            for function in own
            if measure_length(function) <= SHORT
            and definitions[function.name] == 1
            and words[function.name] == 2
        ],
        repeated=find_repeated(trees),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("places", nargs="*", type=Path)
    given = parser.parse_args().places
    package = ROOT / "src" / "gscompleter"
    models = package / "models"
    method = [package / name for name in ("stages", "guards", "trust", "completer.py")]
    core = [place for place in package.iterdir() if place != models and place.suffix in ("", ".py")]
    groups = {"method": method, "without models": core, "models": [models]}
    if given:
        groups = {"given": given}
    for name, places in groups.items():
        print(f"{name}: {measure(places, [package]).describe()}")


if __name__ == "__main__":
    main()

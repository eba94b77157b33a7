"""The language of docstrings and sentences: words and beginnings that are not used."""

import ast
import re
from collections.abc import Iterator

import pytest

from paths import ROOT

FIRST_WORDS = {"What", "Of", "That", "Whether", "Where", "How", "Which", "Who"}
FIRST_PHRASES = ("None where",)
WORDS = ("brought", "told", "doubt", "doubted", "doubts", "believe", "believed", "slope", "slopes")
WORDS += ("wary", "evened", "witness", "witnesses", "set aside")
VERBS = {"embed", "feed", "need", "seed", "read", "speed"}
MAX_PARTICIPLES = 9
FOLDERS = ("src", "tests", "benchmarks", "examples", "docs", "integrations")
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
SOURCES = [path for path in FILES if path.is_relative_to(ROOT / "src")]


def list_docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """List docstrings of modules, classes, functions and attributes with their lines."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else []:
            match statement:
                case ast.Expr(ast.Constant(str(text))):
                    yield statement.lineno, text


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_docstrings_use_the_words_of_the_field(path):
    wrong = []
    for line, text in list_docstrings(ast.parse(path.read_text())):
        begins = text.split(maxsplit=1)[:1][0] in FIRST_WORDS if text.strip() else False
        found = [word for word in WORDS if re.search(rf"\b{word}\b", text)]
        if begins or text.startswith(FIRST_PHRASES) or found:
            wrong.append(f"{path.relative_to(ROOT)}:{line}: {text[:60]!r} {found}")
    assert wrong == []


def is_participle(name: str) -> bool:
    """Return True if a function's name begins with a participle."""
    first = name.strip("_").split("_")[0]
    return first not in VERBS and re.fullmatch(r"\w{2,}(ed|ing)", first) is not None


def test_functions_are_named_by_verbs():
    named = [
        f"{path.stem}.{node.name}"
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and is_participle(node.name)
    ]
    assert len(named) <= MAX_PARTICIPLES, "\n".join(named)

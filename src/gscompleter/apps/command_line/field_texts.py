"""Help texts of options: the strings below the fields of their classes."""

from __future__ import annotations

import ast
import inspect
import sys
from functools import cache


def find_field_text(kind: type, field: str) -> str | None:
    """Find the string below a field of a class, or of the first parent that has one.

    tyro finds it, too, but parses the whole file anew for each class of it.
    """
    for owner in kind.__mro__:
        # Classes that are made while the command runs have no source.
        texts = read_field_texts(owner.__module__).get(owner.__qualname__, {})
        if field in texts:
            return texts[field]
    return None


@cache
def read_field_texts(module: str) -> dict[str, dict[str, str]]:
    """Read the strings below the fields of the classes of a module: by class, and by field."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):  # no source, as that of built-in types
        return {}
    return {
        node.name: {
            statement.target.id: below.value.value
            for statement, below in zip(node.body, node.body[1:], strict=False)
            if isinstance(statement, ast.AnnAssign)
            and isinstance(statement.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
            and isinstance(below.value.value, str)
        }
        for node in tree.body
        if isinstance(node, ast.ClassDef)
    }

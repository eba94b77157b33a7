"""A name of a module has one meaning in the whole package."""

import ast

import gscompleter
from density import find_repeated
from paths import PACKAGE
from sources import parse_package

REPEATED = {
    # The slow renderer states the numbers of rasterisation for itself, as it is the twin that the
    # kernels are compared with; these have them in float32.
    *("MAX_ALPHA", "MIN_ALPHA", "MIN_TRANSMITTANCE", "TANGENT_MARGIN"),
    # A type variable for anything has the name that it has everywhere in Python.
    "T",
    # A process begins at `main`, in the file that it runs.
    "main",
}
"""Names that several modules define, those of learned models aside."""


def test_a_name_is_defined_in_one_module():
    # Adapters of learned models keep the names of the code that they follow.
    models = PACKAGE / "models"
    modules = {path: tree for path, tree in parse_package().items() if models not in path.parents}
    repeated = set(find_repeated(modules)) - REPEATED
    assert not repeated, f"name these for what they mean where they stand: {sorted(repeated)}"


def test_type_checkers_see_the_public_names_that_there_are():
    tree = parse_package()[PACKAGE / "__init__.py"]
    (block,) = [statement for statement in tree.body if isinstance(statement, ast.If)]
    declared = {
        alias.asname: statement.module
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    assert declared == {name: f"gscompleter.{home}" for name, home in gscompleter._HOMES.items()}

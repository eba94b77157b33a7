"""A name of a module has one meaning in the whole package."""

from density import find_repeated, parse_files
from paths import ROOT

PACKAGE = ROOT / "src" / "gscompleter"

REPEATED = {
    # The slow renderer states the numbers of rasterisation for itself, as it is the twin that the
    # kernels are compared with; these have them in float32.
    *("BLUR", "MAX_ALPHA", "MIN_ALPHA", "MIN_TRANSMITTANCE", "TANGENT_MARGIN"),
    # A type variable for anything has the name that it has everywhere in Python.
    "T",
    # A process begins at `main`, in the file that it runs.
    "main",
}
"""Names that several modules define, those of learned models aside."""


def test_a_name_is_defined_in_one_module():
    # Adapters of learned models keep the names of the code that they follow.
    places = [place for place in PACKAGE.iterdir() if place.name != "models"]
    modules = parse_files([place for place in places if place.is_dir() or place.suffix == ".py"])
    repeated = set(find_repeated(modules)) - REPEATED
    assert not repeated, f"name these for what they mean where they stand: {sorted(repeated)}"

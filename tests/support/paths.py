"""Places in the repository, and the data of tests on real photographs."""

import os
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
SUPPORT = TESTS / "support"
FIXTURES = TESTS / "fixtures"
ROOT = TESTS.parent
PACKAGE = ROOT / "src" / "gscompleter"
DATA = Path(os.environ.get("GSCOMPLETER_DATA", ROOT.parent / "shared"))
"""Real photographs: `GSCOMPLETER_DATA`, or the folder beside a development checkout."""

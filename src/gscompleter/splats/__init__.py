"""Readers and writers of Gaussian splats, one file per format."""

from __future__ import annotations

from gscompleter.splats.formats import SPLAT_FORMATS as SPLAT_FORMATS
from gscompleter.splats.formats import load_splat as load_splat
from gscompleter.splats.formats import save_splat as save_splat

"""The console of all lines and tables for people."""

from __future__ import annotations

from functools import partial

from rich.console import Console

make_console = partial(Console, markup=False, emoji=False, highlight=False)
"""Make a console that prints each text as it is; arguments as of rich's `Console`.

rich itself would take `[x]` and `:cat:` in the name of a file for a style and a picture, in lines
as well as in the cells of tables.
"""

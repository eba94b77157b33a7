"""Plug-in of LichtFeld Studio: a heal button for what is selected."""

import lichtfeld as lf

from .panel import HealPanel


def on_load() -> None:
    """Register the panel; LichtFeld Studio calls it."""
    lf.register_class(HealPanel)
    lf.log.info("gscompleter loaded")


def on_unload() -> None:
    """Stop what runs, and take the panel away; LichtFeld Studio calls it."""
    HealPanel.stop()
    lf.unregister_class(HealPanel)

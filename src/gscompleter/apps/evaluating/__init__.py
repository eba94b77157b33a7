"""The work of `evaluate`, `tables` and `index`."""

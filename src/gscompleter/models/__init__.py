"""Learned models, which the core never imports: it finds `tables` through entry points."""

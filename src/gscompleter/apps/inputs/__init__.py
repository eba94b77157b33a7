"""Photographs, splats and targets as a command line names them."""

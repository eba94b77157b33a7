"""Cameras at which renders of a splat stand in for photographs that nobody has."""

"""Cameras that are chosen: targets to complete next, and photographs that are their context."""

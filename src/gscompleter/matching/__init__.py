"""Matched photographs: features, and what they tell of the scene before any model runs."""

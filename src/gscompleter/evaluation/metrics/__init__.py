"""Metrics of images, depth and geometry."""

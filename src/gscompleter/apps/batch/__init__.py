"""Manifests of many completions."""

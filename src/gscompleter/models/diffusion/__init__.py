"""Generators Φ by diffusion: PE-Field, and inpainting pipelines of diffusers.

Tested against the authors' code and published tensor shapes, and with tiny random models. Not
tested: published weights, their download, GPU, CPU offload, and image quality.
"""

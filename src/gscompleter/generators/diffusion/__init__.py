"""Φ by diffusion: PE-Field, and any inpainting pipeline of diffusers.

Checked here: position ids, rotary tables and attention against the authors' code (numbers in
`tests/fixtures/pefield`), the shapes of all published tensors, and whole runs with tiny random
models. NOT checked, for neither was at hand: any published weights, the download of them, a GPU,
CPU offload, and what images the real models give. `docs/generators.md` says the same.
"""

"""Compilation of the kernels in advance."""

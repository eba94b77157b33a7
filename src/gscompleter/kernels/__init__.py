"""Compiled loops (numba) on plain arrays. They know nothing of the types of the package.

Each file holds its kernels together with the helpers they inline: the compilation cache notices
edits of the file itself only.
"""

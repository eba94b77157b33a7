"""Compiled loops (numba) on plain arrays. They know nothing of the types of the package.

Each file holds its kernels together with the helpers they inline: the compilation cache notices
edits of the file itself only.

Of the liberties of fast mathematics they take one, `contract`. Were sums free to be reordered
(`reassoc`), a kernel that runs in parallel would round otherwise in the process that compiles it
than in those that find it in the cache, and the same command would not give the same bytes. On the
CPUs tried, that freedom saved no time.
"""

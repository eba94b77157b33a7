"""Errors, progress, threads, memory, timing, files, jobs and plug-ins: all others stand on them."""

"""Gives every Python process the fake CUDA device: `tests/project/test_gpu_report.py`.

Python imports this module at its start where its folder is on the path.
"""

import atexit
import sys

if "pip" not in " ".join(sys.orig_argv):
    from fake_gsplat import fake_gsplat

    device = fake_gsplat()
    device.__enter__()
    atexit.register(device.__exit__, None, None, None)

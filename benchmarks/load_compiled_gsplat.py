"""Stands as `gsplat/csrc.py` beside a `gsplat_cuda.so` that was compiled on another machine.

gsplat imports its kernels from `gsplat.csrc` and compiles them only if there is no such module. A
file named csrc.so would not do: the name under which a module was compiled, gsplat_cuda, is part of
it.
"""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

_spec = spec_from_file_location("gsplat_cuda", Path(__file__).with_name("gsplat_cuda.so"))
assert _spec is not None
assert _spec.loader is not None
_module = module_from_spec(_spec)
_spec.loader.exec_module(_module)
globals().update({name: value for name, value in vars(_module).items() if name[:2] != "__"})

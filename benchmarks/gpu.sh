#!/usr/bin/env bash
# Sets up what benchmarks/gpu.py needs and runs it; its options are passed on.
#
#     bash benchmarks/gpu.sh --out docs --seconds 420
#
# A machine with a network gets a virtual environment, .venv-gpu. A machine without one takes the
# wheels of a folder that was carried there (benchmarks/fetch_gpu_wheels.sh fills it), for its own
# Python; its torch has to see the GPU.
set -euo pipefail
cd "$(dirname "$0")/.."
PYTHON=${PYTHON:-python3}
WHEELS=${WHEELS:-.whl}
VENV=${GPU_VENV:-.venv-gpu}
TORCH=${TORCH:-torch==2.13.0}

nvidia-smi -L 2>/dev/null | grep -q '^GPU' || {
  echo 'make gpu needs an NVIDIA GPU, and nvidia-smi finds none on this machine.' >&2
  exit 2
}
has_cuda_torch() {
  "$PYTHON" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())' 2>/dev/null
}

if compgen -G "$WHEELS/*.whl" >/dev/null; then
  has_cuda_torch || {
    echo "The wheels in $WHEELS bring no torch, and that of $PYTHON sees no GPU; install one." >&2
    exit 2
  }
  site=$(mktemp -d)
  trap 'rm -rf "$site"' EXIT
  "$PYTHON" -m pip install --quiet --no-index --no-deps --no-compile --upgrade --target "$site" "$WHEELS"/*.whl
  # A compiled module that was carried along: gsplat asks for `gsplat.csrc` before it compiles.
  if [ -f "$WHEELS/gsplat_cuda.so" ]; then
    cp "$WHEELS/gsplat_cuda.so" "$site/gsplat/"
    cp benchmarks/load_compiled_gsplat.py "$site/gsplat/csrc.py"
  fi
  python=$PYTHON
  path=$site
else
  if [ ! -f "$VENV/installed" ]; then
    "$PYTHON" -m venv "$VENV"
    if has_cuda_torch; then
      # A torch with CUDA takes gigabytes: use the one that is there. --system-site-packages would
      # miss it where $PYTHON is a virtual environment itself.
      "$PYTHON" -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
        >"$("$VENV/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/parent.pth"
    else
      "$VENV/bin/python" -m pip install --quiet "$TORCH"
    fi
    "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check -e '.[cuda,test]'
    touch "$VENV/installed"
  fi
  python=$VENV/bin/python
  path=
  # gsplat compiles with the ninja of the environment.
  export PATH="$PWD/$VENV/bin:$PATH"
fi

# gsplat compiles with the toolkit of CUDA_HOME. `nvcc` on the PATH may be a wrapper in a folder
# without CUDA's headers, so look for a whole toolkit.
if [ -z "${CUDA_HOME:-}" ]; then
  for toolkit in /usr/local/cuda /usr/local/cuda-*; do
    if [ -x "$toolkit/bin/nvcc" ] && [ -f "$toolkit/include/cuda_runtime.h" ]; then
      export CUDA_HOME=$toolkit
    fi
  done
fi
export MAX_JOBS=${MAX_JOBS:-$(nproc)} PYTHONUNBUFFERED=1
export PYTHONPATH="$path${path:+:}src:tests/support:tests/render:benchmarks${PYTHONPATH:+:$PYTHONPATH}"
"$python" benchmarks/gpu.py "$@"

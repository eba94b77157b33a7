#!/usr/bin/env bash
# Fetches the wheels that benchmarks/gpu.sh takes to a machine with a GPU and no network.
#
#     bash benchmarks/fetch_gpu_wheels.sh [FOLDER=.whl]
#
# They are for Python 3.12 on Linux, beside what the machine has: a torch with CUDA, numpy, scipy,
# numba, OpenCV, scikit-image, jaxtyping, pytest, transformers and huggingface_hub. The folder is
# ignored by git: nothing of it is ever committed.
set -euo pipefail
cd "$(dirname "$0")/.."
FOLDER=${1:-.whl}
PYTHON=${PYTHON:-python3}
# pip compares platform names as they are: each version of glibc has to be listed.
platforms=(--platform any --platform manylinux2014_x86_64)
for version in 17 24 27 28 34 35; do
  platforms+=(--platform "manylinux_2_${version}_x86_64")
done
mkdir -p "$FOLDER"
fetch() {
  "$PYTHON" -m pip download --quiet --only-binary=:all: --python-version 3.12 \
    --implementation cp "${platforms[@]}" -d "$FOLDER" "$@"
}
# These two need exact versions of others, so pip adds what they need.
fetch pydantic tyro
# These would bring numpy and torch, which the machine has.
fetch --no-deps gsplat==1.5.3 zstandard plyfile beartype 'diffusers>=0.41,<0.43' importlib-metadata zipp
du -sh "$FOLDER"

# gscompleter on NVIDIA GPUs. `make dist` first; then, in the root of the repository:
#   docker build -f docker/cuda.Dockerfile -t gscompleter:cuda .
# Not built where this was written: no container engine was at hand.
# gsplat compiles its CUDA kernels for the architectures of ARCHITECTURES, which needs nvcc but no GPU.
FROM nvidia/cuda:12.8.1-devel-ubuntu24.04

RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends python3-venv ninja-build g++ python3-dev \
    && rm -rf /var/lib/apt/lists/*
ENV NUMBA_CACHE_DIR=/var/cache/gscompleter/kernels \
    GSCOMPLETER_HOME=/var/cache/gscompleter \
    TORCH_EXTENSIONS_DIR=/var/cache/gscompleter/extensions \
    PIP_NO_CACHE_DIR=1 \
    PATH=/opt/gscompleter/bin:$PATH
COPY dist/*.whl /tmp/
# The build of torch has to be of the CUDA version of the image.
RUN python3 -m venv /opt/gscompleter \
    && pip install torch torchvision --index-url https://download.pytorch.org/whl/cu128 \
    && pip install "gscompleter[cuda,evaluation,film,models,poses] @ file://$(ls /tmp/*.whl)" \
    && rm /tmp/*.whl
ARG ARCHITECTURES="7.5;8.0;8.6;8.9;9.0;12.0+PTX"
RUN TORCH_CUDA_ARCH_LIST="$ARCHITECTURES" python -c "from gsplat.cuda._backend import _C; assert _C"
RUN gscompleter warmup \
    && mkdir -p /var/cache/gscompleter/extensions \
    && chmod -R a+rwX /var/cache/gscompleter

WORKDIR /work
ENTRYPOINT ["gscompleter"]
CMD ["--help"]

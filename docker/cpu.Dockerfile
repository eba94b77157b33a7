# gscompleter on CPUs. `make dist` first; then, in the root of the repository:
#   docker build -f docker/cpu.Dockerfile -t gscompleter .
# Not built where this was written: no container engine was at hand.
FROM python:3.12-slim

# Kernels are compiled into a folder that any user of the container may write to.
ENV NUMBA_CACHE_DIR=/var/cache/gscompleter/kernels \
    GSCOMPLETER_HOME=/var/cache/gscompleter \
    PIP_NO_CACHE_DIR=1
COPY dist/*.whl /tmp/
RUN pip install torch torchvision --index-url https://download.pytorch.org/whl/cpu \
    && pip install "gscompleter[evaluation,film,models,poses] @ file://$(ls /tmp/*.whl)" \
    && rm /tmp/*.whl
RUN gscompleter warmup && chmod -R a+rwX /var/cache/gscompleter && gscompleter doctor

WORKDIR /work
ENTRYPOINT ["gscompleter"]
CMD ["--help"]

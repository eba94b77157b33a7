# `make demo` and `make test` do all their own set-up; they need Python >= 3.10 and nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
TORCH ?= torch==2.13.0
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu
# Without a GPU the CPU build of torch saves gigabytes of CUDA packages. It comes first, so that
# nothing that depends on torch pulls another build.
TORCH_INDEX := $(shell command -v nvidia-smi >/dev/null 2>&1 || echo --extra-index-url $(TORCH_CPU_INDEX))
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: demo test test-slow lint format types evaluate bench clean

demo: $(VENV)/installed
	$(BIN)/gscompleter demo --out demo --overwrite

test: $(VENV)/installed-test
	$(BIN)/python -m pytest

test-slow: $(VENV)/installed-test
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/installed-dev
	$(BIN)/mypy

# Compares methods on every case of a cases.json: make evaluate CASES=path/to/cases.json METHODS=all
CASES ?= ../shared/data/cases.json
METHODS ?= context full paper
RESULTS ?= results
evaluate: $(VENV)/installed-evaluation
	$(BIN)/gscompleter evaluate $(CASES) --methods $(METHODS) --out $(RESULTS)

# Ours beside what else a user has. Holes are filled on photographs that are held back: name a CASES.
bench: $(VENV)/installed-test
	for script in $(filter-out %/bench_inpaint.py,$(wildcard benchmarks/bench_*.py)); do \
		$(BIN)/python $$script || exit 1; done
	$(BIN)/python benchmarks/bench_inpaint.py $(CASES)

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "gscompleter needs Python 3.10 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/torch: | $(VENV)/bin/python
	$(PIP) --no-deps --retries 1 $(TORCH_INDEX) $(TORCH)
	touch $@

$(VENV)/installed: pyproject.toml | $(VENV)/torch
	$(PIP) -e .
	touch $@

$(VENV)/installed-evaluation: pyproject.toml | $(VENV)/torch
	$(PIP) -e '.[evaluation]'
	touch $@ $(VENV)/installed

$(VENV)/installed-test: pyproject.toml | $(VENV)/torch
	$(PIP) -e '.[test]'
	touch $@ $(VENV)/installed

$(VENV)/installed-dev: pyproject.toml | $(VENV)/torch
	$(PIP) -e '.[test,dev]'
	touch $@ $(VENV)/installed $(VENV)/installed-test

clean:
	rm -rf $(VENV) demo results build dist .pytest_cache .mypy_cache .ruff_cache

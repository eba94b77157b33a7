# `make demo` and `make test` do all their own set-up; they need Python >= 3.10 and nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
TORCH ?= torch==2.13.0
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu
# A GPU is used where nvcc is as well: gsplat, the renderer on a GPU, compiles its kernels. Otherwise
# the CPU build of torch saves gigabytes of CUDA packages. torch comes first, so that nothing that
# depends on it pulls another build.
NVIDIA := $(shell command -v nvidia-smi 2>/dev/null)
NVCC := $(shell command -v nvcc 2>/dev/null || ls "$$CUDA_HOME/bin/nvcc" 2>/dev/null)
GPU := $(and $(NVIDIA),$(NVCC))
# --index-url, not --extra-index-url: where that index is out of reach, pip would take the build for CUDA
# from the other one without a word.
TORCH_INDEX := $(if $(GPU),,--index-url $(TORCH_CPU_INDEX))
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS)

# Not installed, as most tests are about machines without them: tests of the code for GPUs read the
# wheels.
GPU_WHEELS := $(VENV)/wheels/fetched

# Tests start hundreds of processes, which would compile all modules again. (Empty is not set.)
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo set-up kernels test test-core test-slow pages check golden check-golden lint format types docs dist release-check fuzz evaluate reproduce development held-out results-pages bench gpu clean

demo: $(VENV)/installed
ifneq ($(NVIDIA),)
ifeq ($(NVCC),)
	@echo 'There is a GPU but no nvcc (CUDA_HOME): the demo runs on the CPU. See docs/install.md.'
endif
endif
	$(BIN)/gscompleter demo --out demo --overwrite

# All that the tests and the checks need, in one go.
set-up: $(VENV)/installed-dev $(GPU_WHEELS)

# Compiled once, instead of in each process of the tests. They need nothing but the package itself, so
# that `make --jobs=2 set-up kernels` compiles them while pip, which works on one core, goes on.
kernels: $(VENV)/installed
	$(BIN)/gscompleter warmup --quiet

# A process for each core, up to four: most tests wait for one core, and files share what they set up.
# Longest files come first, as tests/conftest.py says; pytest-xdist would begin with the most tests.
test: $(VENV)/installed-test $(GPU_WHEELS) kernels
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

# What a contributor to the method needs, in about a minute on two cores.
test-core: $(VENV)/installed-test kernels
	$(BIN)/python -m pytest -n auto --maxprocesses 4 tests/stages tests/guards tests/trust \
		tests/generators tests/config tests/test_parts.py tests/test_types.py

test-slow: $(VENV)/installed-test $(GPU_WHEELS)
	$(BIN)/python -m pytest -m slow

# What is written from the code: tables of pages, and help texts as they are recorded.
pages: $(VENV)/installed
	$(BIN)/python docs/make_tables.py
	$(BIN)/python benchmarks/golden.py record --only texts

# What a new generator, splat format or guard has to pass, in some minutes; .ci/run runs all tests.
check: lint types $(VENV)/installed-test kernels
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder tests/generators \
		tests/splats tests/guards tests/config tests/project tests/apps/test_options.py \
		tests/apps/test_cli.py tests/apps/test_help_pages.py

# The net under a restructuring: `make golden` before it, `make check-golden` after it. ONLY=scenes|room|texts.
golden: $(VENV)/installed
	$(BIN)/python benchmarks/golden.py record $(if $(ONLY),--only $(ONLY))

check-golden: $(VENV)/installed
	$(BIN)/python benchmarks/golden.py check $(if $(ONLY),--only $(ONLY))

# Thousands of odd calls, damaged files and commands; an hour. SEED=1 for others.
SEED ?= 0
fuzz: $(VENV)/installed-test
	$(BIN)/python tests/support/fuzz_python.py --calls 3000 --files 5000 --seed $(SEED)
	$(BIN)/python tests/support/fuzz.py --count 1500 --seed $(SEED)

# The last line prints how dense the source is: figures to read, without a limit.
lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/python tests/support/density.py

format: $(VENV)/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/installed-dev
	$(BIN)/mypy

# The documentation site, in site/; a warning is an error.
docs: $(VENV)/installed-test
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Wheel and sdist, in dist/, as they can be uploaded. The same sources give the same bytes.
dist: $(VENV)/installed-dist
	rm -rf dist
	$(BIN)/python -m hatchling build -d dist
	$(BIN)/python -m twine check --strict dist/*

# The wheel and every extra in an empty environment of each Python; gigabytes and an hour.
PYTHONS ?= python3.10 python3.11 python3.12 python3.13
release-check: $(VENV)/installed-test
	$(BIN)/python tests/support/release_check.py $(PYTHONS) --extras

# Compares methods on every case of a cases.json: make evaluate CASES=path/to/cases.json METHODS=all
# Real photographs; tests on them are skipped where there are none.
export GSCOMPLETER_DATA ?= $(abspath ../shared)
# What it keeps apart is left out unless APART=--apart is given, which is written down
# (benchmarks/apart_uses.md).
CASES ?= benchmarks/development.json
APART ?=
METHODS ?= context full paper
RESULTS ?= results
evaluate: $(VENV)/installed-evaluation
	$(BIN)/gscompleter evaluate $(CASES) $(APART) --methods $(METHODS) --out $(RESULTS)

# Tables, figures and claims of the paper on the same photographs; the slow baselines run on few
# cases. docs/reproduce.md explains them. SCENES are a file of scenes, or a folder of them.
REPRODUCED ?= $(RESULTS)/paper
SCENES ?= $(if $(filter benchmarks/%,$(CASES)),benchmarks/scenes.json,$(dir $(CASES)))
SEQUENCES ?= $(if $(filter benchmarks/%,$(CASES)),$(GSCOMPLETER_DATA)/data,$(SCENES))/open3d_rgbd
reproduce: $(VENV)/installed-evaluation
	@echo 'This takes about 75 minutes on two idle cores; stopped, the same command goes on.'
	$(BIN)/gscompleter evaluate $(CASES) $(APART) --table models --figure qualitative --out $(REPRODUCED)
	$(BIN)/gscompleter evaluate $(CASES) $(APART) --one-per-scene --out $(REPRODUCED) --figure seams \
		--table ablation refinement time dof alignment rotation
	$(BIN)/gscompleter evaluate $(CASES) $(APART) --limit 4 --out $(REPRODUCED) --table paradigms \
		--figure densification registration
	$(BIN)/gscompleter evaluate $(SCENES) $(APART) --one-per-scene --resolution 256 256 --out $(REPRODUCED) \
		--table spans stress --protocol n-2 n-4 n-8 stress-12-39
	$(BIN)/gscompleter evaluate $(SEQUENCES) $(APART) --resolution 256 256 --out $(REPRODUCED) \
		--table sequence --figure sequence --protocol sequence-1-steps-2

# The cases on which settings were chosen, all of them, for reports. Each use of what is kept apart is
# written down.
DEVELOPED ?= $(RESULTS)/development
development: $(VENV)/installed-evaluation
	$(BIN)/gscompleter evaluate benchmarks/development.json --apart --methods context full paper --out $(DEVELOPED)

# The cases on which no setting was chosen (benchmarks/choose_held_out.py has the rule). For reports
# only: whoever chooses a setting by them has to choose new ones. Each use is written down.
HELD_OUT ?= $(RESULTS)/held-out
held-out: $(VENV)/installed-evaluation
	$(BIN)/gscompleter evaluate benchmarks/held_out.json --apart --methods context full paper --out $(HELD_OUT)

# The figures of docs/reproduce.md, docs/results.md and README.md, from the outputs of all three.
results-pages: $(VENV)/installed
	$(BIN)/python benchmarks/write_results.py --reproduced $(REPRODUCED) --development $(DEVELOPED) --held-out $(HELD_OUT)

# Ours beside what else a user has. Holes are filled on photographs that are held back: name a CASES.
# What completions take comes first (docs/performance.md); without its scenes, name another PERFORMANCE.
PERFORMANCE ?= benchmarks/performance.json
bench: $(VENV)/installed-test
	$(BIN)/python benchmarks/measure_completions.py --cases $(PERFORMANCE) --out $(RESULTS)/bench --overwrite
	for script in $(filter-out %/bench_inpaint.py,$(wildcard benchmarks/bench_*.py)); do \
		$(BIN)/python $$script || exit 1; done
	$(BIN)/python benchmarks/bench_inpaint.py $(CASES)

# What needs a GPU, within nine minutes, into docs/gpu.md and docs/gpu.json. The torch of $(PYTHON) is
# used where it sees the GPU. Without a network: bash benchmarks/fetch_gpu_wheels.sh, then carry .whl.
GPU_VENV ?= .venv-gpu
GPU_SECONDS ?= 530
gpu:
	PYTHON=$(PYTHON) GPU_VENV=$(GPU_VENV) TORCH='$(TORCH)' bash benchmarks/gpu.sh --seconds $(GPU_SECONDS)

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "gscompleter needs Python 3.10 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/torch: | $(VENV)/bin/python
	$(PIP) --no-deps --retries 1 $(TORCH_INDEX) $(TORCH)
	touch $@

$(VENV)/installed: pyproject.toml | $(VENV)/torch
	$(PIP) -e '.$(if $(GPU),[cuda])'
	touch $@

$(VENV)/installed-evaluation: pyproject.toml | $(VENV)/torch
	$(PIP) --retries 1 $(TORCH_INDEX) $(TORCH) torchvision  # that of the same index
	$(PIP) -e '.[evaluation]'
	touch $@ $(VENV)/installed

$(VENV)/installed-test: pyproject.toml | $(VENV)/installed
	$(PIP) -e '.[test]'
	touch $@ $(VENV)/installed

$(VENV)/installed-dist: pyproject.toml | $(VENV)/bin/python
	$(PIP) 'hatchling>=1.26' 'twine>=6'
	touch $@

$(GPU_WHEELS): | $(VENV)/bin/python
	-$(BIN)/python -m pip download --quiet --disable-pip-version-check --no-deps -d $(@D) \
		gsplat==1.5.3 metal-gauss==0.2.1 && touch $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/installed
	$(PIP) -e '.[test,dev]'
	touch $@ $(VENV)/installed $(VENV)/installed-test

clean:
	rm -rf $(VENV) $(GPU_VENV) demo results build dist site .pytest_cache .mypy_cache .ruff_cache

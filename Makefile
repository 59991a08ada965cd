# Every target sets up what it needs; CI and people call the same ones.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: help check test test-all docs demo bench
help:      ## list the targets
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*##/ -/'

.venv/.core: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) --editable .
	@touch $@
.venv/.dev: .venv/.core
	$(PIP) --editable '.[test,docs,train]'
	@touch $@

demo: .venv/.core      ## reconstruct a real sweep, tracked and sensorless: demo/report.html
	$(BIN)/sonosweep demo -o demo --force
test: .venv/.dev       ## fast tests
	$(BIN)/python -m pytest -n 2 -m 'not slow' -q
test-all: .venv/.dev   ## slow and GPU tests too
	$(BIN)/python -m pytest -q
check: .venv/.dev      ## format, lint, types, layers, pinned dependencies, documentation
	$(BIN)/ruff format --check . && $(BIN)/ruff check . && $(BIN)/mypy && $(BIN)/lint-imports --no-cache
	$(BIN)/python -m pip check
	$(MAKE) --no-print-directory docs
docs: .venv/.dev       ## build the documentation; warnings are errors
	$(BIN)/sphinx-build -q -W --keep-going docs docs/_build
.venv/.bench: .venv/.dev
	$(PIP) --editable '.[bench]'
	@touch $@
bench: .venv/.bench    ## time the main steps against peers, plain NumPy and the machine's limits
	$(BIN)/python benchmarks/compounding.py && $(BIN)/python benchmarks/decorrelation.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/simulation.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/beamforming.py

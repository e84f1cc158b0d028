# Every target prepares what it needs in .venv and does so once: a stamp says which extra is installed.
PYTHON ?= python3
ARGS ?=

BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help run test test-all test-lowest lint bench bench-gpu docs clean

help: ## Show this list.
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1|\2/p' Makefile | awk -F'|' '{ printf "%-14s %s\n", $$1, $$2 }'
	@echo 'Variables: PYTHON=python3.12 (the interpreter .venv is made with), ARGS="..." (more arguments).'

run: .venv/.installed-core ## Simulate and reconstruct the example experiment into runs/.
	@$(BIN)/thincam run configs/fza_superresolution.yaml --out runs/fza_superresolution $(ARGS)

# Python's compiled files are written whatever the shell says: the tests' take ten seconds a worker.
test test-all test-lowest: export PYTHONDONTWRITEBYTECODE =
test: .venv/.installed-test ## Run the tests, e.g. make test ARGS="tests/test_units.py -k angle".
	@$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

test-all: .venv/.installed-test ## Run all tests, the thorough ones too (75 minutes on two quiet cores).
	@$(BIN)/python -m pytest -n 2 --dist loadfile -m "not full_size" $(ARGS)

# The bounds of pyproject.toml as constraints; only other packages' deprecations are new then.
test-lowest: .venv-lowest/.installed ## Run the tests with the oldest releases that are allowed.
	@.venv-lowest/bin/python -m pytest -n 2 --dist loadfile -W ignore::DeprecationWarning $(ARGS)

.venv-lowest/.installed: pyproject.toml
	@$(PYTHON) -m venv .venv-lowest
	@sed -n 's/^ *"\([^>"]*\)>=\([0-9.]*\).*/\1==\2/p' pyproject.toml | sort -u > .venv-lowest/constraints.txt
	@.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check \
	    -c .venv-lowest/constraints.txt -e '.[test]'
	@touch $@

lint: .venv/.installed-dev ## Check the style, the formatting and the types.
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright --pythonpath $(BIN)/python

bench: .venv/.installed-bench ## Measure speed and accuracy.
	@$(BIN)/python -m pytest benchmarks --benchmark-columns=min,median,stddev,rounds $(ARGS)

bench-gpu: .venv/.installed-bench ## Measure a GPU beside the processor; needs JAX's plugin for the GPU.
	@JAX_PLATFORMS= $(BIN)/python -m pytest benchmarks/test_gpu.py -rs --benchmark-columns=min,median,stddev,rounds $(ARGS)

docs: .venv/.installed-docs ## Build the documentation into docs/_build; FAST=1 executes no script.
	@$(BIN)/python -m sphinx -q -W --keep-going docs docs/_build
	@echo 'Documentation: docs/_build/index.html'

clean: ## Remove build outputs and caches; .venv and runs/ stay.
	@rm -rf build dist docs/_build docs/gallery docs/api/generated .pytest_cache .ruff_cache .hypothesis .benchmarks
	@find . -name __pycache__ -type d -not -path './.venv/*' -not -path './.git/*' -prune -exec rm -rf {} +

.venv/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	    echo 'thincam_jax needs Python 3.11 or newer, and $(PYTHON) is not: make PYTHON=python3.11 ...' >&2; exit 1; }
	@echo 'Making .venv'
	@$(PYTHON) -m venv .venv
	@touch $@

# Written only after pip has succeeded. Versions come from requirements.lock, as constraints.
.venv/.installed-core: pyproject.toml requirements.lock | .venv/.made
	@echo 'Installing thincam_jax'
	@$(PIP) -c requirements.lock -e .
	@touch $@

.venv/.installed-%: pyproject.toml requirements.lock | .venv/.made
	@echo 'Installing thincam_jax[$*]'
	@$(PIP) -c requirements.lock -e '.[$*]'
	@touch $@

# Two commands do everything on a fresh machine: `make sitl` flies, `make test` checks.

VENV  ?= .venv
BIN   := $(VENV)/bin
STAMP := $(VENV)/.installed

# pybullet has wheels for CPython 3.10 and 3.11 only.
PYTHON := $(shell scripts/find-python)

.DEFAULT_GOAL := help

.PHONY: help
help:  ## Show the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-8s %s\n", $$1, $$2}'

$(STAMP): pyproject.toml constraints.txt scripts/find-python
	@test -n "$(PYTHON)" || { scripts/find-python --explain; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	    --constraint constraints.txt --editable '.[sim,dev]'
	@touch $@

.PHONY: install
install: $(STAMP)  ## Create .venv and install everything needed to fly and test

.PHONY: sitl
sitl: $(STAMP)  ## Fly three episodes: airl-sitl --vehicle quad
	$(BIN)/airl-sitl --vehicle quad

.PHONY: lint
lint: $(STAMP)  ## Format, lint, types, import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

.PHONY: test
test: lint  ## Everything CI checks
	$(BIN)/python -m pytest -n auto --dist loadgroup

.PHONY: bench
bench: $(STAMP)  ## Measure: ray caster, real-time factor of the stack
	$(BIN)/python benchmarks/bench_depth.py
	$(BIN)/python benchmarks/bench_stack.py

.PHONY: clean
clean:  ## Remove the environment and everything generated
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

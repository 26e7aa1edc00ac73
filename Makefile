# Two commands do everything on a fresh machine: `make sitl` flies, `make test` checks.

VENV  ?= .venv
BIN   := $(VENV)/bin
# What flies, and what trains and tests: torch is large, and no flight needs it.
FLY   := $(VENV)/.installed-sim
ALL   := $(VENV)/.installed-all
# All, and Ray, whose tests run every night.
RAY   := $(VENV)/.installed-ray

# One more than there are cores: tests that fly mostly wait.
WORKERS := $(shell expr $$(nproc) + 1)
# Tests that share something stay together, in the order of tests/conftest.py.
SPREAD := --dist loadgroup --no-loadscope-reorder

comma := ,

# PYTHON=python3.12, given to make or in the environment, says which one. pybullet has wheels for
# CPython 3.10 and 3.11 only; with a newer one the kernel plant flies.
INTERPRETER := $(shell PYTHON='$(PYTHON)' scripts/find-python)

# Containers often set it: every process would then compile every module that it imports, of the
# installed packages too, where one process could have kept what it compiled.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help

.PHONY: help
help:  ## Show the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

# The versions and hashes of requirements/, which scripts/lock writes. torch alone has none: its builds
# for machines without a GPU are on another index.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
LOCKED := $(PIP) --no-deps --require-hashes --requirement requirements

# The pip that comes with CPython 3.10 and 3.11 takes twice the time to install the same.
define install
	@test -n "$(INTERPRETER)" || { PYTHON='$(PYTHON)' scripts/find-python --explain; exit 1; }
	@test -x $(BIN)/python || $(INTERPRETER) -m venv $(VENV)
	$(LOCKED)/build.txt
	$(LOCKED)/$(1).txt
	$(if $(2),$(PIP) $(shell grep '^$(2)==' constraints.txt))
	$(PIP) --no-deps --no-build-isolation --editable .
	@touch $@
endef

$(FLY): pyproject.toml requirements/sim.txt scripts/find-python
	$(call install,sim)

$(ALL): pyproject.toml requirements/all.txt scripts/find-python
	$(call install,all,torch)
	@touch $(FLY)

$(RAY): $(ALL)
	$(call install,sim$(comma)train$(comma)dev$(comma)ray)

.PHONY: install
install: $(ALL)  ## Create .venv and install everything needed to fly, train and test

.PHONY: sitl
sitl: $(FLY)  ## Fly three episodes: airl-sitl --vehicle quad
	$(BIN)/airl-sitl --vehicle quad

.PHONY: lint
lint: $(ALL)  ## Format, lint, types, import contracts, budgets
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python scripts/check_budgets.py

.PHONY: budgets
budgets: $(ALL)  ## Lower scripts/budgets.toml to what is measured now, calls per tick included
	$(BIN)/python scripts/check_budgets.py --lower --calls

# What every worker of the tests would compile for itself: kernels, and modules. Kernels need what
# flies and nothing else; while pip installs the package once more, it is found by its place.
.PHONY: kernels-plant kernels-gym modules
kernels-plant kernels-gym: kernels-%: $(FLY)
	PYTHONPATH=$(CURDIR) $(BIN)/python scripts/compile_kernels.py $*

modules: $(ALL)
	$(BIN)/python -m pytest --collect-only --quiet --quiet > $(VENV)/.collected

# Workers share the cores: threads of torch's that wait for each other would take them in vain.
test nightly: export OMP_NUM_THREADS := 1

# Two at a time, as pip, mypy and a compiler are one thread each. What flies is installed first: its
# kernels are compiled while pip unpacks the rest, which is larger.
.PHONY: test
test: $(FLY)  ## Everything CI checks
	@$(MAKE) --no-print-directory --jobs 2 --output-sync kernels-plant lint kernels-gym modules
	$(BIN)/python -m pytest -n $(WORKERS) $(SPREAD) -m "not nightly" --durations 25

.PHONY: nightly
nightly: $(RAY)  ## All tests, with the long ones of stops and kills, and those of Ray
	$(BIN)/python -m pytest -n $(WORKERS) $(SPREAD)

.PHONY: docs
docs: $(ALL)  ## Build the documentation site into site/ (no network needed)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

.PHONY: audit
audit: $(ALL)  ## Check licences, and known vulnerabilities (needs pip-audit)
	$(BIN)/python scripts/licences.py
	pip-audit --requirement requirements/all.txt --no-deps --disable-pip

.PHONY: release-check
release-check:  ## Build sdist and wheel, install each in a clean environment and fly
	scripts/check-release $(INTERPRETER)

.PHONY: results
results: $(ALL)  ## Fly again what is published and out of date (QUICK=1: few flights, unpublished)
	$(BIN)/python scripts/results.py fly $(if $(QUICK),--quick)

.PHONY: results-docs
results-docs: $(ALL)  ## Write the figures of pages and cards from results/*.json
	$(BIN)/python scripts/results.py docs

.PHONY: bench
bench: $(ALL)  ## Measure: ray caster, stack, environments (RIVALS="--pyflyt-python P ...")
	$(BIN)/python benchmarks/bench_depth.py
	$(BIN)/python benchmarks/bench_colour.py
	$(BIN)/python benchmarks/bench_stack.py
	$(BIN)/python benchmarks/bench_calls.py
	$(BIN)/python benchmarks/bench_policy.py
	$(BIN)/python benchmarks/bench_compensation.py
	$(BIN)/python benchmarks/bench_stamps.py
	$(BIN)/python benchmarks/bench_envs.py $(RIVALS)

.PHONY: clean
clean:  ## Remove the environment and everything generated
	rm -rf $(VENV) build dist site .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

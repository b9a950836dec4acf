# Needs Python >= 3.11 and make. Everything else goes into .venv, in the versions of requirements.lock.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/stamp
# Bytecode is kept: without it every process compiles the sources and the tests anew, which takes most of its start.
unexport PYTHONDONTWRITEBYTECODE
# Each process takes a stretch of the tests, so that what a module prepares is prepared once, and helps when it is done.
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal

.DEFAULT_GOAL := help
.PHONY: help setup demo test fast slow lint check lowest bench coverage dist docs clean

help:
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' Makefile

setup: $(STAMP) ## make .venv with the project and everything it needs (done once)

$(STAMP): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$(PYTHON) is older than Python 3.11; name a newer one: make PYTHON=python3.12 setup" >&2; exit 2; }
	@echo "setting up .venv, which is done once. 1 of 2: download and install the packages; pip says nothing for some minutes …"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --no-compile --constraint requirements.lock lazy-loader numba
	@# The largest kernels are compiled beside the rest, of which what is imported gets bytecode then.
	@$(BIN)/python -c 'import rbpf.kernels.landmarks' & \
	  $(BIN)/python -m pip install --quiet --no-compile --requirement requirements.lock && wait
	@$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@echo "2 of 2: compile the kernels, and try what is installed …"
	@$(BIN)/rbpf doctor
	@touch $@

demo: $(STAMP) ## simulate, filter and report into demo/
	$(BIN)/rbpf demo --out demo

test: $(STAMP) ## all tests
	$(PYTEST) $(COVER)

slow: $(STAMP) ## the tests that `make check` leaves out
	$(PYTEST) -m "slow or real_data"

fast: $(STAMP) ## the tests that take less than a second or so each
	$(PYTEST) -m "not slow and not real_data"

lint: $(STAMP) ## format, lint, spelling, types and import rules
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/typos
	$(BIN)/mypy
	$(BIN)/lint-imports

check: lint fast ## format, lint, spelling, types, import rules and the fast tests

lowest: ## the fast tests of what is computed, in the lowest versions of what the package needs (minutes)
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet --requirement requirements-lowest.txt
	NUMBA_CACHE_DIR=.venv-lowest/kernels .venv-lowest/bin/python -m pytest -m "not slow and not real_data" \
	  tests/core tests/maps tests/motion tests/sensors tests/systems tests/readers

bench: $(STAMP) ## run the benchmarks against their baselines
	$(BIN)/python -m benchmarks --gate

coverage: $(STAMP) ## all tests, with the fraction of lines that they run
	$(BIN)/python -m pytest -n 2 --cov --cov-report=term --cov-report=html:coverage

dist: $(STAMP) ## wheel and source distribution into dist/: of one commit always the same bytes (GNU tar)
	rm -rf dist build
	umask 022 && export SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) && $(BIN)/python -m build --no-isolation --sdist && cd dist && \
	  tar -xzf rbpf-*.tar.gz && rm rbpf-*.tar.gz && for folder in rbpf-*/; do name=$${folder%/}; chmod -R u=rwX,go=rX $$name && \
	  tar --sort=name --mtime=@$$SOURCE_DATE_EPOCH --owner=0 --group=0 --numeric-owner -cf - $$name | gzip -n9 > $$name.tar.gz && \
	  $(abspath $(BIN))/python -m build --no-isolation --wheel --outdir . $$name && rm -r $$name; done

# By one process: two take more than twice the processor time.
docs: $(STAMP) ## build the documentation into docs/_build
	$(BIN)/sphinx-build -W -b html docs docs/_build/html

clean: ## remove everything that make made, .venv included
	rm -rf .venv .venv-lowest demo build dist coverage .coverage *.egg-info docs/_build .mypy_cache .pytest_cache .ruff_cache \
	  .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# NMSS Lab: `make serve` shows the live pages, `make test` checks everything.
# Needs Python 3.11 or newer (PYTHON=...), make and the internet for the first run.

PYTHON ?= python3
PORT ?= 5006
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# Matrices are small and tests run side by side: threads inside BLAS only collide.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.PHONY: serve test lint lab lessons bench clean

serve: $(READY)
	@$(BIN)/nmss-lab serve --port $(PORT)

# One worker per file: cells of a notebook share a kernel, browser tests a server.
# `notebooks` includes notebooks/solutions.
test: lint
	$(BIN)/pytest -n $(WORKERS) --dist loadfile --nbval-lax --nbval-current-env \
	    --nbval-cell-timeout 300 tests nmss_lab notebooks

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

lab: $(READY)
	$(BIN)/jupyter lab notebooks

# The executed lessons as pages for any browser, without network or server.
lessons: $(READY)
	$(BIN)/python docs/site/build.py --workers $(WORKERS) --out build/lessons

# Times beside a baseline of the same run, written to benchmarks/RESULTS.md.
bench: $(READY)
	$(BIN)/nmss-lab bench

# The stamp is younger than what it was made from: a second run installs nothing.
# The package is installed in place, so that edits need no installation either.
$(READY): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and \
	    "NMSS Lab needs Python 3.11 or newer; choose one with PYTHON=...")'
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	    --no-deps --no-build-isolation --editable .
	@touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis

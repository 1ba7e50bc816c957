# One venv for everything; made anew where pyproject.toml changes.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Many tests wait for devices and processes: one more than the two cores of the smallest machine.
JOBS ?= 3

.PHONY: help demo test check docs clean

help:
	@echo "make demo   set up, then solve sessions/phantom from its raw frames and write out/phantom.rrd"
	@echo "make test   set up, with the tools of the tests, then run them"
	@echo "make check  set up, then lint, types, import layers, and a wheel in an empty environment"
	@echo "make docs   set up, then build the guide into out/site; links that lead nowhere fail it"
	@echo "make clean  remove the environment and all that was built"

# What the demo needs; the tools of tests and checks come on top of it.
$(VENV)/.ready: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "fgreg needs Python 3.11 or newer; try: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/.ready-%: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --editable . --group $*
	@touch $@

demo: $(VENV)/.ready
	@mkdir -p out
	$(BIN)/fgreg solve sessions/phantom --out out/phantom.yaml --rrd out/phantom.rrd
	@echo "Look at it with: $(BIN)/rerun out/phantom.rrd"

test: $(VENV)/.ready-test
	$(BIN)/python -m pytest -n $(JOBS)

check: $(VENV)/.ready-test $(VENV)/.ready-check
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/check_wheel.py

# Its own environment: the tests need none of it.
docs:
	$(PYTHON) -m venv $(VENV)-docs
	$(VENV)-docs/bin/python -m pip install --quiet --upgrade "pip>=25.1"
	$(VENV)-docs/bin/python -m pip install --quiet --group docs
	NO_MKDOCS_2_WARNING=1 $(VENV)-docs/bin/mkdocs build --strict --quiet --site-dir out/site
	@echo "Look at it with a browser: out/site/index.html"

clean:
	rm -rf $(VENV) $(VENV)-docs out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

# Everything from a fresh clone: `make demo` runs the main job, `make test` passes the tests.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Set this to an empty string to try newer libraries than those tested.
CONSTRAINTS ?= -c constraints.txt

.PHONY: demo test lint typecheck format docs clean

demo: $(VENV)/.installed
	$(BIN)/tab-marl evaluate --preset demo --out runs/demo

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -n 2

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python scripts/link_typecheck.py
	cd build/typecheck && ../../$(BIN)/lint-imports --config ../../pyproject.toml --no-cache

typecheck: $(VENV)/.installed-dev
	$(BIN)/python scripts/link_typecheck.py
	$(BIN)/mypy

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.installed-dev
	$(BIN)/python scripts/link_typecheck.py
	$(BIN)/mkdocs build --strict --clean
	@echo "open build/site/index.html"

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "tab_marl needs Python 3.11 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(CONSTRAINTS) torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(CONSTRAINTS) -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(CONSTRAINTS) -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build runs

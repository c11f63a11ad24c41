# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable
SOURCES := pyproject.toml constraints.txt native/CMakeLists.txt $(shell find native/src -type f)

.PHONY: setup demo test check bench clean

setup: $(VENV)/.installed-dev

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(SOURCES) | $(BIN)/python
	$(INSTALL) .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(INSTALL) '.[dev]'
	touch $@

demo: $(VENV)/.installed
	$(BIN)/toonifygb demo --out runs/demo

test: setup
	$(BIN)/python -m pytest

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

bench: setup
	$(BIN)/python -m benchmarks

clean:
	rm -rf build runs .pytest_cache .ruff_cache

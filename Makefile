# `make train` and `make test` do everything on a machine with Python >= 3.10 and make.
PYTHON ?= python3
SHELL := bash
.SHELLFLAGS := -o pipefail -c
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -q
SOURCES := sb3_chdp tests benchmarks docs examples
# Small networks are fastest on one thread
export OMP_NUM_THREADS ?= 1

.PHONY: train test test-all notebooks format lint type check-codestyle docs package hooks speed clean-env

$(STAMP): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .[zoo,render,plots,export,tests,docs]
	touch $(STAMP)

train: $(STAMP)
	$(BIN)/sb3-chdp train --env Platform-v0 --log-folder logs --progress --verbose 0 --eval-freq -1
	$(BIN)/sb3-chdp enjoy --env Platform-v0 --folder logs --no-render --n-timesteps 1000 | grep --invert-match "^Episode "

test: $(STAMP)
	$(PYTEST) tests

test-all: $(STAMP)
	$(PYTEST) -m "" tests

notebooks: $(STAMP)
	$(BIN)/python -m pytest -n 2 -q --nbmake notebooks

format: $(STAMP)
	$(BIN)/ruff check --select I --fix $(SOURCES)
	$(BIN)/black $(SOURCES)

check-codestyle: $(STAMP)
	$(BIN)/black --check $(SOURCES)

lint: $(STAMP)
	$(BIN)/ruff check $(SOURCES)

type: $(STAMP)
	$(BIN)/mypy

docs: $(STAMP)
	$(BIN)/mkdocs build --strict

package: $(STAMP)
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*

hooks: $(STAMP)
	$(BIN)/pre-commit install

speed: $(STAMP)
	$(BIN)/python benchmarks/speed.py

clean-env:
	rm -rf $(VENV)

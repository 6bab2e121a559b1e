# make demo, make test: all set-up included. The rest is for those who change things.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test test-slow test-train lint bench docs clean

demo: $(VENV)/.runtime  ## Run the cell once with a recording
	$(BIN)/twin run pick_line --record --out runs/demo; status=$$?; \
	  echo "watch it: $(BIN)/rerun runs/demo/recording.rrd"; exit $$status

test: $(VENV)/.dev  ## The whole suite
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: $(VENV)/.dev  ## Reference figures of full runs: two hours or more
	$(BIN)/python -m pytest -m slow

test-train: $(VENV)/.train  ## Loss, assignment and a short training; needs PyTorch, 5 GB
	$(BIN)/python -m pytest -m train

lint: $(VENV)/.dev  ## Style, types, layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: $(VENV)/.dev  ## Time of each part against its peers, and of the loop: a quarter of an hour
	$(BIN)/python -m evaluation.benchmarks.localisation
	$(BIN)/python -m evaluation.benchmarks.mapping
	$(BIN)/python -m evaluation.benchmarks.planning
	$(BIN)/python -m evaluation.benchmarks.beacons --cases 100000
	$(BIN)/twin run detect; $(BIN)/python -m evaluation.benchmarks.detection  # once it has pictures
	$(BIN)/python -m evaluation.benchmarks.loop

docs: $(VENV)/.runtime  ## Draw the figures of the README
	$(BIN)/python docs/frames.py
	$(BIN)/python docs/plant.py

$(VENV)/bin/python:
	PYTHON=$(PYTHON) .ci/system
	$(PYTHON) -m venv $(VENV)

$(VENV)/.runtime: $(VENV)/bin/python pyproject.toml constraints.txt
	PYTHON=$(PYTHON) .ci/system
	$(PIP) --editable .
	touch $@

$(VENV)/.dev: $(VENV)/bin/python pyproject.toml constraints.txt
	PYTHON=$(PYTHON) .ci/system
	$(PIP) --editable '.[dev]'
	touch $@

$(VENV)/.train: $(VENV)/.dev
	$(PIP) --editable '.[dev,train]'
	touch $@

clean:  ## Remove the environment and what tools leave; keeps runs/
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache

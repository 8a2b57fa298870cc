# make run    build the environment, fly the default scenario
# make test   the same environment, the whole test suite
# make check  what CI runs: test, lint, types, layers
# make fuzz   100 000 damaged logs of each format for the readers; takes hours, so CI has 100 of each among its tests
# make mutants  small faults in the safety-critical rooms, one by one: which of them does no test find?
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
EXTRAS := can,logs,plots,studies,dev

.PHONY: run test check lint types layers bench fuzz mutants clean
.DELETE_ON_ERROR:

run: $(READY)
	$(BIN)/fwav-hil run scenarios/flapper.toml

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal

check: test lint types layers

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

layers: $(READY)
	$(BIN)/lint-imports

bench: $(READY)
	$(BIN)/python -m benchmarks

fuzz: $(READY)
	$(BIN)/python -m tests.fuzz

mutants: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -c constraints-mutants.txt -e '.[$(EXTRAS),mutants]'
	nice $(BIN)/python -m tests.mutants

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "fwav-hil needs Python 3.11 or newer: call make with, for example, PYTHON=python3.12" >&2; exit 1; }
	@echo "creating the environment $(VENV) (some seconds)"
	@$(PYTHON) -m venv $(VENV)
	@echo "installing the packages of constraints.txt (1 GB; the first time one to three minutes, without output)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache

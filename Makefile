# make demo   the main job on the shipped weights
# make test   every check that CI runs
# make bench  speed, beside peers and the machine's limits, into benchmarks/results
# All set up their own virtual environment in .venv; the second time that takes no time.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt

.PHONY: demo test bench clean

demo: .venv/installed-evaluate
	$(BIN)/triform demo

test: .venv/installed-dev
	$(BIN)/ruff check src tests benchmarks
	$(BIN)/ruff format --check src tests benchmarks
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest

bench: .venv/installed-bench
	$(BIN)/python -m benchmarks

clean:
	rm -rf .venv demo build src/triform.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "triform needs Python 3.11 or newer; name it with: make PYTHON=/path/to/python" >&2; exit 1; }
	$(PYTHON) -m venv .venv || { rm -rf .venv; exit 1; }

.venv/installed-%: pyproject.toml constraints.txt | .venv/bin/python
	@echo "installing triform[$*] into .venv"
	@$(PIP) --editable '.[$*]'
	@touch $@

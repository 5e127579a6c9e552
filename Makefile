# `make demo` and `make test` set everything up themselves in .venv; nothing else on the machine is touched.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
READY_TO_TEST := $(VENV)/ready-to-test
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock
ASSETS ?=
TEST_ARGS ?=

.PHONY: demo test test-all lint setup figures clean

demo: $(READY)
	$(BIN)/python benchmarks/demo.py --out demo_out

test: $(READY_TO_TEST)
	$(BIN)/python -m pytest $(TEST_ARGS)

test-all: $(READY_TO_TEST)
	$(BIN)/python -m pytest -m "not gpu" $(TEST_ARGS)

lint: $(READY_TO_TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

setup: $(READY_TO_TEST)

$(READY): pyproject.toml requirements.lock
	@command -v $(PYTHON) >/dev/null || { echo "Python 3.11 is needed ($(PYTHON) was not found): install it or run make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info[:2] != (3, 11))" || { echo "$(PYTHON) is not Python 3.11, which bpy 5.0 needs: run make PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) -e ".[training,blender]"
	@$(BIN)/python -c "import bpy" || { echo "Blender's module did not load: install the system packages named in README.md"; exit 1; }
	touch $(READY)

$(READY_TO_TEST): $(READY)
	$(PIP_INSTALL) -e ".[training,blender,test]"
	touch $(READY_TO_TEST)

clean:
	rm -rf demo_out build dist

# `make demo` and `make test` set everything up themselves in .venv; nothing else on the machine is touched.
# `make help` prints the comments that begin with two #.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
READY_TO_TEST := $(VENV)/ready-to-test
PIP_INSTALL := $(BIN)/python -m pip install --disable-pip-version-check -c requirements.lock
ASSETS ?=
TEST_ARGS ?=

# Other versions of Blender, each a Python module in an environment of its own.
VENV45 := .venv45
VENV52 := .venv52
PYTHON313 ?= $(shell for python in python3.13 "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/3.13*/bin/python3.13; do \
	"$$python" -c "import sys, ensurepip; sys.exit(sys.version_info[:2] != (3, 13))" 2>/dev/null && echo "$$python" && break; done)

# Sizes of the environments in megabytes (`du -sm`), with torch's CPU build: missing disk space is reported before pip
# begins.
ROOM := sh scripts/enough_room.sh
VENV_MB := $(VENV):3700
VENV45_MB := $(VENV45):850
VENV52_MB := $(VENV52):1300

# One worker more than cores, since some tests wait for other processes, with one thread each: more would compete.
WORKERS := $(shell cores=$$(getconf _NPROCESSORS_ONLN || echo 2); echo $$((cores < 8 ? cores + 1 : 8)))
ONE_THREAD := OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE
# Rerun a test if Blender itself crashed (seen once in ed.undo_push), never if the test failed.
AGAIN_AFTER_A_CRASH := --reruns 1 --only-rerun "no exception says this"
PYTEST := -m pytest -n $(WORKERS) --dist worksteal $(AGAIN_AFTER_A_CRASH)
PYTEST_BLENDER := $(PYTEST) tests/blender --confcutdir tests/blender -m "not slow and not gpu and not any_blender"

# Containers set it, and hundreds of child processes would each compile the backend again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test test-5.0 test-4.5 test-5.2 test-all fuzz chaos lint setup clean

## demo: generate a human in Blender, walk it, render it: see demo_out/
demo: $(READY)
	$(BIN)/python benchmarks/demo.py --out demo_out

## help: this list
help:
	@awk '/^## / { name = $$2; sub(/:$$/, "", name); sub(/^## [^:]*: /, ""); printf "make %-11s%s\n", name, $$0 }' $(MAKEFILE_LIST)

## test: the tests on Blender 5.0, 4.5 and 5.2; options for pytest: make test TEST_ARGS="-x -k motion"
# Sequential, also with -j: they share the cores.
test:
	@$(ROOM) $(VENV_MB) $(VENV45_MB) $(if $(PYTHON313),$(VENV52_MB))
	$(MAKE) test-5.0
	$(MAKE) test-4.5
	$(MAKE) test-5.2

## test-5.0: all tests but the slow ones, on Blender 5.0
test-5.0: $(READY_TO_TEST)
	$(ONE_THREAD) $(BIN)/python $(PYTEST) $(TEST_ARGS)

## test-4.5: the tests that depend on Blender's version, on Blender 4.5
test-4.5: $(VENV45)/ready
	$(ONE_THREAD) $(VENV45)/bin/python $(PYTEST_BLENDER) $(TEST_ARGS)

## test-5.2: the same on Blender 5.2, if a Python 3.13 is found
# .venv52 has no torch: the backend's process runs in .venv.
ifeq ($(PYTHON313),)
test-5.2:
	@echo "Blender 5.2 was not tested: its module needs Python 3.13. Install it, or name it: make test PYTHON313=/path/to/python3.13"
else
test-5.2: $(VENV52)/ready $(READY_TO_TEST)
	$(ONE_THREAD) PRIMDIFFUSION_PYTHON=$(CURDIR)/$(BIN)/python $(VENV52)/bin/python $(PYTEST_BLENDER) $(TEST_ARGS)
endif

## test-all: all tests, with the slow ones, on Blender 5.0
test-all: $(READY_TO_TEST)
	$(BIN)/python -m pytest -m "not gpu" $(TEST_ARGS)

## fuzz: feed damaged files and messages to every reader for MINUTES=30, guided by coverage; see tests/fuzz
fuzz: $(READY_TO_TEST)
	$(ONE_THREAD) $(BIN)/python -m tests.fuzz --minutes $(MINUTES)

## chaos: kill programs, fill disks, break environments for MINUTES=30; see tests/chaos
MINUTES ?= 30
chaos: $(READY_TO_TEST)
	$(ONE_THREAD) $(BIN)/python -m tests.chaos --minutes $(MINUTES)

## lint: ruff, import contracts, types
lint: $(READY_TO_TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

## setup: the environment .venv, with what tests and lint need
setup: $(READY_TO_TEST)

$(READY): pyproject.toml requirements.lock
	@command -v $(PYTHON) >/dev/null || { echo "Python 3.11 is needed ($(PYTHON) was not found): install it or run make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info[:2] != (3, 11))" || { echo "$(PYTHON) is not Python 3.11, which bpy 5.0 needs: run make PYTHON=/path/to/python3.11"; exit 1; }
	@$(ROOM) $(VENV_MB)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing Blender's Python module, torch and other packages into $(VENV): this takes some minutes"
	$(PIP_INSTALL) -e ".[training,blender]"
	@$(BIN)/python -c "import bpy" || { echo "Blender's module did not load: install the system packages named in README.md"; exit 1; }
	touch $(READY)

$(READY_TO_TEST): $(READY)
	$(PIP_INSTALL) -e ".[training,blender,test]"
	touch $(READY_TO_TEST)

# Blender 4.5's module; everything else comes from .venv.
$(VENV45)/ready: $(READY_TO_TEST) Makefile
	@$(ROOM) $(VENV45_MB)
	test -x $(VENV45)/bin/python || $(BIN)/python -m venv --without-pip $(VENV45)
	$(BIN)/python -m pip --python $(VENV45)/bin/python install --disable-pip-version-check --no-deps bpy==4.5.15
	$(BIN)/python -c "import site; print('import site; site.addsitedir(%r)' % site.getsitepackages()[0])" > `echo $(VENV45)/lib/python3.*/site-packages`/zz_shared.pth
	touch $@

$(VENV52)/ready: requirements52.lock
	@$(ROOM) $(VENV52_MB)
	test -x $(VENV52)/bin/python || $(PYTHON313) -m venv $(VENV52)
	$(VENV52)/bin/python -m pip install --disable-pip-version-check --no-deps -r requirements52.lock
	touch $@

## clean: remove demo_out, build and dist
clean:
	rm -rf demo_out build dist

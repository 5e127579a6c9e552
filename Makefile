# Each target is one of scripts/setup.py, which does the same without make: python -m scripts.setup demo
# It sets everything up itself in .venv; nothing else on the machine is touched. `make help` lists the targets.
PYTHON ?= $(shell for python in python3.11 python3 .venv/bin/python; do "$$python" -c "" 2>/dev/null && echo "$$python" && break; done)
TARGETS := demo help test test-5.0 test-5.2 test-5.3 test-all lint types setup clean

.PHONY: $(TARGETS)
# Also with -j one after the other: they share the environments and the cores.
.NOTPARALLEL:

$(TARGETS):
	@command -v "$(PYTHON)" >/dev/null || { echo "Python 3.11 is needed ($(PYTHON) was not found): install it or run make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m scripts.setup $@

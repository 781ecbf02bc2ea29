# make demo   refine a small scene made by the package itself; pictures, mesh and errors go to demo_out/
# make test   run the test suite
# make check  what ruff and mypy say of the source (settings: ruff.toml, mypy.ini)
# make docs   the API reference, HTML in build/api, made from the docstrings
# Demo and test set everything up first: system libraries, .venv, the package, an OpenCL device for the CPU (PoCL).

PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check docs setup clean

demo: setup
	$(BIN)/pagas-cl demo --output demo_out

test: setup
	$(BIN)/python -m pytest

check: $(BIN)/ruff
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: $(BIN)/pdoc
	$(BIN)/python docs/api.py

# Already there in an environment named by BIN; else setup brings them.
$(BIN)/ruff $(BIN)/pdoc:
	$(MAKE) setup

setup: .venv/.installed

.venv/.installed: pyproject.toml .ci/setup
	@PYTHON=$(PYTHON) sh .ci/setup

clean:
	rm -rf .venv build dist demo_out *.egg-info

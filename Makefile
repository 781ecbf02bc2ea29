# make demo   refine a small scene made by the package itself; pictures, mesh and errors go to demo_out/
# make test   run the test suite
# Both set everything up first: system libraries, .venv, the package, an OpenCL device for the CPU (PoCL).

PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test setup clean

demo: setup
	$(BIN)/pagas-cl demo --output demo_out

test: setup
	$(BIN)/python -m pytest

setup: .venv/.installed

.venv/.installed: pyproject.toml .ci/setup
	@PYTHON=$(PYTHON) sh .ci/setup

clean:
	rm -rf .venv build dist demo_out *.egg-info

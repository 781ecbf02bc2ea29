# make demo    refine a small scene made by the package itself; pictures, mesh and errors go to demo_out/
# make test    all tests
# make quick   those that need no Open3D and little time: for every save
# make kernels those that touch kernels: for every device and way to build them; TESTS=tests/splat, those of a folder
# make check   what ruff and mypy say of the source (settings: ruff.toml, mypy.ini)
# make docs    the API reference, HTML in build/api, made from the docstrings
# Each sets up first what it needs (`make setup`): system libraries, .venv, the package, an OpenCL device that works. What
# is there is tried first; CPU=intel installs Intel's runtime for x86-64 processors, under Intel's licence.

PYTHON ?= python3
BIN := .venv/bin
# Three on two cores: some wait for processes that they have started. In the order of tests/conftest.py: long files first.
SIDE_BY_SIDE := -n 3 --dist loadfile --no-loadscope-reorder

.PHONY: demo test quick kernels check docs setup clean FORCE

demo: setup
	$(BIN)/pagas-cl demo --output demo_out

test: setup
	$(BIN)/python -m pytest $(SIDE_BY_SIDE)

quick: setup
	$(BIN)/python -m pytest -q $(SIDE_BY_SIDE) -m "not slow"

kernels: setup
	$(BIN)/python -m pytest -q $(SIDE_BY_SIDE) -m kernels $(TESTS)

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
	@PYTHON=$(PYTHON) CPU=$(CPU) sh .ci/setup

ifdef CPU
.venv/.installed: FORCE
endif
FORCE:

clean:
	rm -rf .venv build dist demo_out *.egg-info

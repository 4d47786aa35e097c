# Two commands set everything up: `make demo` and `make test`.  Both build .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Processes that share the tests, of one thread each.
JOBS ?= 2
# Python compiles what is imported when it is, which is a small part of what is installed.
INSTALL := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt

# What is imported is compiled once, not by each process, also where the environment says otherwise.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo demo-learn test test-slow lint docs bench clean

demo: $(VENV)/demo.stamp
	$(BIN)/pdcorrect compare examples/unseen_cross.toml --model torsion-exact --converged --frames 20 -o demo --overwrite

demo-learn: $(VENV)/learn.stamp
	rm -rf demo-learn
	OMP_NUM_THREADS=1 $(BIN)/pdcorrect train examples/training/tiny.toml --data datasets/tiny -o demo-learn --evaluate evaluation

# Kernels are compiled once and beside the linters, not by each process of the tests.
test: $(VENV)/dev.stamp
	$(MAKE) --jobs=3 kernels-trilinear kernels-modes lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" -n $(JOBS) --dist loadfile --no-loadscope-reorder

test-slow: $(VENV)/dev.stamp
	$(MAKE) --jobs=2 kernels-trilinear kernels-modes
	$(BIN)/python -m pytest -m slow

kernels-%: $(VENV)/dev.stamp
	-OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python tests/compile_kernels.py $*

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/python docs/tables.py --check

docs: $(VENV)/dev.stamp
	$(BIN)/python -m sphinx -W -b html docs docs/_build/html

bench: $(VENV)/dev.stamp
	$(BIN)/python benchmarks/run.py

clean:
	rm -rf $(VENV) demo demo-learn docs/_build

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/demo.stamp: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) -e ".[view,learn]"
	@touch $(VENV)/learn.stamp $@

$(VENV)/learn.stamp: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) -e ".[learn]"
	@touch $@

$(VENV)/dev.stamp: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) -e ".[view,learn,cluster,dev]"
	@touch $(VENV)/demo.stamp $(VENV)/learn.stamp $@

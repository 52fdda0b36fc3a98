# Every target sets up what it needs in an environment of its own: .venv, or .venv-python3.13 for `make PYTHON=python3.13 ...`.
# A stamp per set of extras remembers that it was installed; a change of pyproject.toml makes the stamps stale and pip brings the
# environment up to date. `rm -r .venv*` starts afresh.
PYTHON ?= python3
WORKERS ?= 2

VENV := .venv$(if $(filter-out python3,$(PYTHON)),-$(notdir $(PYTHON)))
BIN := $(VENV)/bin
# The interpreter by its name, else by that name among those of pyenv, whose shims fail for versions that are not switched on.
FIND_PYTHON = for python in "$(PYTHON)" "$$(pyenv root 2>/dev/null)"/versions/$(patsubst python%,%,$(notdir $(PYTHON))).*/bin/python; do \
	"$$python" -c "" 2>/dev/null && echo "$$python" && break; done
# Tests of one file go to one worker, so that what they share is computed once.
RUN := -m pytest -n $(WORKERS) --dist loadfile
PYTEST := $(BIN)/python $(RUN)
# The files with tests of native kernels: a run of those alone need not import the others.
NATIVE := $(shell grep -rl "mark.native" tests --include="test_*.py")
# The files that touch JAX's internals, dynamics, constraints and simulation, which the oldest versions run.
CORE := $(wildcard tests/compile/test_*.py $(patsubst %,tests/*/test_%.py,constrained constrained_kernels constrained_motion \
	constraints dynamics events explicit_steps fixed_steps kernels_of_mechanics package pages projection recursions recursions_kernels \
	reduced reverse rows sharding shared_numbers simulate stepper stiff traced users_functions variational))
# Most of a test of mechanics is compiling, by XLA and by LLVM. This leaves a third of that out, and changes no more than rounding
# (tests/conftest.py adds the flags of XLA that the installed version knows).
QUICK := JAXDYN_COMPILATION_OPTIONS=least

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help venv demo test test-ci test-all test-oldest coverage lint types bench figures docs notebooks wheel clean

help:  ## print the targets
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 14

venv: $(VENV)/.installed-dev  ## the environment for development

demo: $(VENV)/.installed-plot  ## simulate, check and plot a first example
	$(BIN)/python -m jaxdyn.demo

test: SELECTION := not slow and not long
test-ci: SELECTION := not slow
test: $(VENV)/.installed-test  ## the tests of each function, in minutes
test-ci: $(VENV)/.installed-test  ## those, and the tests that compile for seconds each
test test-ci:
	$(QUICK) $(PYTEST) -m "$(SELECTION) and not native"; mechanics=$$?; \
		$(PYTEST) -m "$(SELECTION) and native" $(NATIVE) && exit $$mechanics

test-all: $(VENV)/.installed-test  ## every test, on every robot, with XLA's own options
	$(PYTEST) --all-robots

test-oldest: .venv-oldest/.installed  ## the tests of mechanics with the lowest versions that pyproject.toml admits
	$(QUICK) .venv-oldest/bin/python $(RUN) -m "not slow and not native" $(CORE)
	.venv-oldest/bin/python $(RUN) -m "not slow and native" $(filter $(CORE),$(NATIVE))

coverage: $(VENV)/.installed-coverage  ## lines that test-ci runs, by module
	$(QUICK) $(PYTEST) -m "not slow and not native" --cov=jaxdyn --cov-report=
	$(PYTEST) -m "not slow and native" --cov=jaxdyn --cov-append --cov-report=term:skip-covered $(NATIVE)

lint: $(VENV)/.installed-dev  ## style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev  ## static types
	$(BIN)/pyright --pythonpath $(BIN)/python

bench: $(VENV)/.installed-bench  ## dynamics against peers, into out/; the other benchmarks: benchmarks/README.md
	$(BIN)/python -m benchmarks

figures: $(VENV)/.installed-bench  ## measure the tables of figures in the documents and write them in place: a quiet machine, hours
	$(BIN)/python -m benchmarks.figures

docs: $(VENV)/.installed-docs  ## the site, into out/site; pictures of the gallery that are missing are made first
	$(BIN)/python -m benchmarks.site

wheel: $(VENV)/.installed-test  ## build the wheel, install it elsewhere and try it without the repository
	$(BIN)/python -m benchmarks.wheel

notebooks: $(VENV)/.installed-notebook $(VENV)/.installed-test  ## run the notebooks, compare what they print, and write them with outputs into out/notebooks
	$(QUICK) $(PYTEST) tests/package/test_notebooks.py --durations=0
	$(BIN)/python -m nbconvert --to notebook --execute --output-dir out/notebooks notebooks/*.ipynb

clean:  ## remove outputs and caches, keep .venv
	rm -rf out build dist docs/gallery docs/notebooks .coverage .pytest_cache .ruff_cache .hypothesis
	find jaxdyn tests $(wildcard benchmarks notebooks) -name __pycache__ -prune -exec rm -rf {} +

# An interpreter without pip is what a failed set-up leaves behind, so it is removed.
$(BIN)/python:
	@python=$$($(FIND_PYTHON)); [ -n "$$python" ] || { echo "no interpreter $(PYTHON): neither on the PATH nor among pyenv's" >&2; exit 1; }; \
	"$$python" -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else \
	  f"jaxdyn needs Python 3.11 or newer, $(PYTHON) is {v.major}.{v.minor}: make PYTHON=python3.11 ...")' && \
	"$$python" -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(VENV)/.installed-%: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch $@

# pip has no resolution by lowest versions; uv has.
.venv-oldest/.installed: PYTHON := python3.11
.venv-oldest/.installed: pyproject.toml
	@python=$$($(FIND_PYTHON)); [ -n "$$python" ] || { echo "no interpreter python3.11" >&2; exit 1; }; \
	rm -rf .venv-oldest && "$$python" -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check uv
	.venv-oldest/bin/uv pip install --quiet --python .venv-oldest/bin/python --resolution lowest-direct -r pyproject.toml --extra test
	.venv-oldest/bin/uv pip install --quiet --python .venv-oldest/bin/python --no-deps --editable .
	@touch $@

# Every target sets up what it needs in .venv. A stamp per set of extras remembers that it was installed; a change of
# pyproject.toml makes the stamps stale and pip brings the environment up to date. `rm -r .venv` starts afresh.
PYTHON ?= python3
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
# Tests of one file go to one worker, so that what they share is computed once.
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile
# The files with tests of native kernels: a run of those alone need not import the others.
NATIVE := $(shell grep -l "mark.native" tests/test_*.py)
# Most of a test of mechanics is compiling, by XLA and by LLVM. These options leave a third of that out, and change no more than rounding.
QUICK = XLA_FLAGS="$$($(BIN)/python tests/xla_options.py)" \
	JAXDYN_COMPILATION_OPTIONS=least

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help venv demo test test-all lint types bench docs notebooks wheel clean

help:  ## print the targets
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 14

venv: $(VENV)/.installed-dev  ## the environment for development

demo: $(VENV)/.installed-plot  ## simulate, check and plot a first example
	$(BIN)/python -m jaxdyn.demo

test: $(VENV)/.installed-test  ## the tests, without the slow ones
	$(QUICK) $(PYTEST) -m "not slow and not native"; mechanics=$$?; $(PYTEST) -m "not slow and native" $(NATIVE) && exit $$mechanics

test-all: $(VENV)/.installed-test  ## every test, on every robot, with XLA's own options
	$(PYTEST) --all-robots

lint: $(VENV)/.installed-dev  ## style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev  ## static types
	$(BIN)/pyright

bench: $(VENV)/.installed-bench  ## dynamics against peers, into out/; the other benchmarks: benchmarks/README.md
	$(BIN)/python -m benchmarks

docs: $(VENV)/.installed-docs  ## the site, into out/site; pictures of the gallery that are missing are made first
	$(BIN)/python -m benchmarks.site

wheel: $(VENV)/.installed-test  ## build the wheel, install it elsewhere and try it without the repository
	$(BIN)/python -m benchmarks.wheel

notebooks: $(VENV)/.installed-notebook  ## run the notebooks, into out/notebooks
	$(BIN)/python -m nbconvert --to notebook --execute --output-dir out/notebooks notebooks/*.ipynb

clean:  ## remove outputs and caches, keep .venv
	rm -rf out build dist docs/gallery .pytest_cache .ruff_cache .hypothesis
	find jaxdyn tests $(wildcard benchmarks notebooks) -name __pycache__ -prune -exec rm -rf {} +

# An interpreter without pip is what a failed set-up leaves behind, so it is removed.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else \
	  f"jaxdyn needs Python 3.11 or newer, $(PYTHON) is {v.major}.{v.minor}: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(VENV)/.installed-%: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch $@

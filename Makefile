# Everything a newcomer needs: `make demo`, `make test`, `make check`. Each sets up what it needs first.
# Paths are relative, so that a checkout path with a space in it works.

PYTHON ?= python3
BIN := .venv/bin
GUIDED ?= 600
export OMP_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup browser usb demo test test-slow fuzz check docs format clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

.venv/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "extrinsic needs Python 3.11 or newer; set PYTHON=")'
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "setting up .venv (about two minutes on a fresh machine) ..."
	@$(BIN)/python -m pip install --quiet -e '.[dev]'
	@$(BIN)/python -m experiments.kernels
	@touch $@

setup: .venv/.installed  ## create .venv and install the project into it

browser:
	@if ! command -v chromium >/dev/null 2>&1 && ! command -v google-chrome >/dev/null 2>&1; then \
	  if command -v apt-get >/dev/null 2>&1 && [ "$$(id -u)" = 0 ]; then \
	    echo "installing chromium (the tests look at the report with it) ..."; \
	    (apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -yq --no-install-recommends chromium) >/dev/null 2>&1 \
	      || echo "could not install chromium; the tests that look at pages will be skipped"; \
	  else \
	    echo "the tests that look at pages need chromium and are skipped without it: sudo apt-get install chromium"; \
	  fi; \
	fi

usb:
	@if ! $(BIN)/python -c 'import pyrealsense2' 2>/dev/null && $(BIN)/python -m pip show -q pyrealsense2 2>/dev/null; then \
	  if command -v apt-get >/dev/null 2>&1 && [ "$$(id -u)" = 0 ]; then \
	    echo "installing libusb (the tests of the RealSense cameras need it) ..."; \
	    (apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -yq --no-install-recommends libusb-1.0-0) >/dev/null 2>&1 \
	      || echo "could not install libusb; the tests of the RealSense cameras will be skipped"; \
	  else \
	    echo "the tests of the RealSense cameras need libusb and are skipped without it: sudo apt-get install libusb-1.0-0"; \
	  fi; \
	fi

demo: setup  ## calibrate, plan, tip a pentagon over its corner and report, in a simulated laboratory
	@$(BIN)/extrinsic run experiments/demo.yaml --set world.profile=lab

test: setup browser usb  ## the default test suite
	@$(BIN)/python -m pytest -n 2 --max-worker-restart 0 --dist loadscope --no-loadscope-reorder -m 'not slow and not alone' tests/experiments tests  # the long ones first
	@$(BIN)/python -m pytest -m 'alone and not slow'  # in real time, beside an emulated robot: nothing else at a time

test-slow: setup browser usb  ## the long tests
	@$(BIN)/python -m pytest -m slow --timeout=1800

fuzz: setup  ## 100 000 cases per decoder, then the CDR and YAML paths by coverage (GUIDED seconds each)
	@EXTRINSIC_FUZZ_CASES=100000 $(BIN)/python -m pytest tests/fuzz --timeout=0
	@$(BIN)/python -m pip install --quiet -e '.[fuzz]'
	@for decoder in reading record message yaml model experiment; do \
	  $(BIN)/python -m tests.fuzz.coverage_guided $$decoder -max_total_time=$(GUIDED) || exit 1; done

check: setup  ## lint, types and the layers
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports
	@$(BIN)/pyright

docs: setup  ## the site of docs/, into build/docs, without the network
	@$(BIN)/python -m experiments.yaml_reference docs/yaml
	@PYTHONPATH=. $(BIN)/python docs/figures.py docs/images/concepts
	@$(BIN)/sphinx-build -W --keep-going -q -n -d build/docs-trees docs build/docs
	@echo "build/docs/index.html"

format: setup  ## format the code
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

clean:  ## remove what the targets made, but not runs/
	rm -rf .venv build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache

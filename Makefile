# `make` alone lists the targets. Everything is installed into .venv and nowhere else.

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# The first Python that is new enough. Another one: `make setup PYTHON=/usr/bin/python3.11` (after `make clean`).
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for p in python3.11 python3; do $$p -c '$(NEW_ENOUGH)' >/dev/null 2>&1 && { echo $$p; break; }; done)
PIP := $(BIN)/python -m pip -qq --disable-pip-version-check --no-input
PIP_TOOLS := pip-tools==7.6.2
WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-resume check format bench pages docs lock clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: $(READY) ## Create .venv with the locked packages and this project in it

# The stamp is in .venv, so that deleting .venv is enough to start again.
$(READY): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11 or newer found; name one with PYTHON=/path/to/python3.11" >&2; exit 1; }
	@"$(PYTHON)" -c '$(NEW_ENOUGH)' 2>/dev/null || { echo "error: $(PYTHON) does not run, or is older than Python 3.11" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip' 2>/dev/null || { echo "error: $(PYTHON) cannot make virtual environments (no ensurepip); on Debian or Ubuntu install its -venv package, or name another with PYTHON=" >&2; exit 1; }
	@if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then echo "Creating $(VENV) with $$("$(PYTHON)" --version)"; "$(PYTHON)" -m venv --clear $(VENV); fi
	@echo "Installing the locked packages into $(VENV) (the first time takes some minutes)"
	@$(PIP) install --require-hashes -r requirements.lock
	@echo "Installing this project, editable"
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@
	@echo "Ready. Try 'make demo', or '$(BIN)/ct-jax --help'."

demo: setup ## Train and evaluate a small Control Transformer on the point robot, and write a report
	@echo "Training the point robot into runs/demo (run it again to resume)"
	@$(BIN)/ct-jax train point --preset demo --out runs/demo --resume

test: setup ## Run the tests (ARGS="-k maze" to choose, WORKERS=8 for more processes)
	@echo "Running the tests in $(WORKERS) processes"
	@$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal $(ARGS)

test-resume: setup ## Kill runs twenty times; their results must equal those of uninterrupted runs (minutes)
	@$(BIN)/python -m pytest -m long $(ARGS) tests/test_resume.py tests/test_compilation.py

check: setup ## Lint, check the formatting and the types
	@echo "ruff: lint"
	@$(BIN)/ruff check .
	@echo "ruff: format"
	@$(BIN)/ruff format --check .
	@echo "pyright: types"
	@$(BIN)/pyright

format: setup ## Format the code and apply the linter's fixes
	@$(BIN)/ruff check --fix-only .
	@$(BIN)/ruff format .

# Determine the commit once, because the results of a benchmark would make it dirty.
bench: setup ## Run every benchmark (12 minutes on 2 cores); peers: .venv/bin/pip install -e '.[bench]'
	@export BENCH_COMMIT="$$(git describe --always --dirty 2>/dev/null)"; for script in $(filter-out benchmarks/scale.py,$(sort $(wildcard benchmarks/[a-z]*.py))) benchmarks/scale.py experiments/pages.py; do echo "== $$script"; $(BIN)/python "$$script" || exit 1; done

pages: setup ## Write the results pages and plots from the result files
	@$(BIN)/python experiments/pages.py

docs: setup ## Build the pages of docs/ as a site in site/; broken links and anchors are errors
	@$(BIN)/zensical build --strict
	@echo "Open site/index.html"

# pip-tools has its own environment, so that it is not locked and does not disturb locked packages.
lock: ## Remake requirements.lock (needs Python 3.11 on Linux x86-64)
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || { echo "error: the lock is made with Python 3.11; name one with PYTHON=" >&2; exit 1; }
	@test -x .make/lock/bin/pip-compile || { "$(PYTHON)" -m venv --clear .make/lock && .make/lock/bin/python -m pip -qq --disable-pip-version-check install $(PIP_TOOLS); }
	@echo "Resolving requirements.lock (versions already in it are kept; UPGRADE=--upgrade renews them)"
	@CUSTOM_COMPILE_COMMAND="make lock" .make/lock/bin/pip-compile --quiet $(UPGRADE) \
	    --generate-hashes --strip-extras --allow-unsafe --no-emit-options \
	    --extra dev --extra turtlebot3 --extra video --extra docs --build-deps-for editable --constraint .ci/constraints.txt \
	    --output-file requirements.lock pyproject.toml

clean: ## Remove .venv, builds and caches (runs/ stays)
	rm -rf $(VENV) .make build dist site .cache .pytest_cache .ruff_cache .hypothesis tests/.jax_cache
	find . -name __pycache__ -type d -not -path './runs/*' -prune -exec rm -rf {} +

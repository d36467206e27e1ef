# Everything runs in the virtual environment .venv.
PYTHON ?= python3
BIN := .venv/bin
EXTRAS ?= simulate,formats,export,drives,test
# EXTRAS that somebody gives are installed unless they were installed last.
AGAIN := $(if $(filter file,$(origin EXTRAS)),,$(if $(filter-out $(shell cat .venv/installed 2> /dev/null),$(EXTRAS)),again))
PIP := $(BIN)/python -m pip install --quiet --constraint constraints.txt
# Each processor runs one process with one thread. One process runs all tests of a file, because they share what they make.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile
# The least share of lines that `make test-full COVERAGE=1` must run, in percent: raise it to two points below what CI prints.
COVERAGE_FLOOR := 90
define NEXT
printf '%s\n' "type next:" "  source .venv/bin/activate   # once in each shell, so that it finds amvnet" \
    "  amvnet predict scan.bin     # label a scan of yours"
endef

# Said before anything is downloaded; pip would say it after PyTorch.
CHECK_PYTHON := import sys; sys.version_info >= (3, 11) or sys.exit("expected Python 3.11 or newer, found " + sys.version.split()[0] + "; make install PYTHON=python3.12")
# pip would take a misspelt extra for none.
CHECK_EXTRAS := import sys, tomllib; known = tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]; \
    wrong = {*"$(EXTRAS)".replace(" ", "").split(",")} - {"", *known}; \
    sys.exit("expected EXTRAS of " + ",".join(known) + ", found " + ",".join(sorted(wrong)) + "; make install EXTRAS=simulate,formats" if wrong else 0)

.PHONY: install demo test test-full all-tests bench gpu docs style lint format release clean again

install: .venv/installed  ## the package and all that its tests need, in .venv
	@$(NEXT)

demo: .venv/installed  ## simulate streets, segment and score them, and show all in demo/index.html
	$(BIN)/amvnet demo --out demo --overwrite
	@$(NEXT)

test: style  ## style, and the tests of each change: about 4 minutes on two cores
	$(PYTEST)

# mypy uses one processor for a minute, so it runs beside the tests. Each tool prints all that it found at once.
test-full: .venv/installed .venv/fleet  ## style, types and all tests, also of fleets, as CI runs them; COVERAGE=1 fails if they run too few lines
	@$(MAKE) --no-print-directory --jobs=2 lint all-tests

all-tests: .venv/installed .venv/fleet
	$(PYTEST) -m "full or not full" $(if $(COVERAGE),--cov=amvnet --cov=lidarstreets --cov-report=term:skip-covered --cov-fail-under=$(COVERAGE_FLOOR))

bench: .venv/installed  ## the time of a scan, and the gain by each optimisation, in half an hour; SCAN="--scan FILE" for a scan of yours
	$(BIN)/python benchmarks/performance.py $(SCAN) --engines torch,onnx,int8

gpu: .venv/installed  ## on a machine with a GPU: its tests and its tables, to paste into an issue; SCAN="--scan FILE" for a scan of yours
	$(BIN)/python -m pytest -m gpu -rs
	$(BIN)/python benchmarks/gpu.py $(SCAN)

docs: .venv/docs web/node_modules  ## the site of docs/, in site/
	@echo "building the site of docs/ in site/: up to five minutes on two slow cores"
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "site/ is built; python -m http.server --directory site serves it at http://localhost:8000"

style: .venv/installed
	$(BIN)/ruff check src ros2 docker tests benchmarks docs web .ci
	$(BIN)/ruff format --check src ros2 docker tests benchmarks docs/*.py web/*.py .ci

lint: style  ## style and types
	$(BIN)/mypy

format: .venv/installed
	$(BIN)/ruff check --fix src ros2 docker tests benchmarks docs web .ci
	$(BIN)/ruff format src ros2 docker tests benchmarks docs/*.py web/*.py .ci

release:  ## VERSION=1.2.3 sets and dates a version, commits and tags it; pushing the tag publishes it
	$(PYTHON) .ci/release.py $(VERSION)

# torch is installed first and alone, with a pinned version, so that no other build of it is installed.
.venv/installed: pyproject.toml constraints.txt $(AGAIN)
	@command -v $(PYTHON) > /dev/null || { echo "expected Python 3.11 or newer, found no $(PYTHON); make install PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c '$(CHECK_PYTHON)'
	@$(PYTHON) -c '$(CHECK_EXTRAS)'
	@echo "installing PyTorch in .venv: a minute, or several with a slow connection"
	@$(PYTHON) -m venv .venv
	@$(PIP) torch
	@echo "installing amvnet and what its tests need: a minute, or several with a slow connection"
	@$(PIP) --editable ".[$(EXTRAS)]"
	@echo "$(EXTRAS)" > $@

# These packages take 600 MB, so `make test` does not need them.
.venv/fleet: .venv/installed
	@echo "installing Ray and what the tests of fleets need: a minute, or several with a slow connection"
	@$(PIP) --editable ".[fleet]" "moto[server]>=5" duckdb "dask[dataframe]"
	@touch $@

.venv/docs: .venv/installed
	@echo "installing MkDocs: half a minute"
	@$(PIP) --editable ".[docs]"
	@touch $@

# The packages that the page try/ and its tests need. Without npm, the build reports that it leaves the page out.
web/node_modules: web/package-lock.json
	@if command -v npm > /dev/null; then echo "installing the packages of web/: a few seconds" && npm ci --prefix web --ignore-scripts --no-audit --no-fund --silent; fi

clean:
	rm -rf .venv demo site build web/node_modules

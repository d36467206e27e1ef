# Everything runs in the virtual environment .venv.
PYTHON ?= python3
BIN := .venv/bin
# Each processor runs one process with one thread. One process runs all tests of a file, because they share what they make.
SPREAD := OMP_NUM_THREADS=1
# The least share of lines that `make test COVERAGE=1` must run, in percent: raise it to two points below what CI prints.
COVERAGE_FLOOR := 90

.PHONY: install demo test run-tests test-slow bench gpu docs lint format release clean

install: .venv/installed  ## the package and all that its tests need, in .venv

demo: .venv/installed  ## simulate streets, segment and score them, and show all in demo/index.html
	$(BIN)/amvnet demo --out demo --overwrite

# Style and types are checked beside the tests, because mypy uses one processor for a minute. Each tool prints all that it found at once.
test: .venv/installed  ## style, types and the tests; COVERAGE=1 fails if they run too few lines
	@$(MAKE) --no-print-directory --jobs=2 lint run-tests

run-tests: .venv/installed
	$(SPREAD) $(BIN)/python -m pytest -n auto --dist loadfile $(if $(COVERAGE),--cov=amvnet --cov=lidarstreets --cov-report=term:skip-covered --cov-fail-under=$(COVERAGE_FLOOR))

test-slow: .venv/installed .venv/fleet  ## all tests, also the tests that take minutes and the tests of fleets
	$(SPREAD) $(BIN)/python -m pytest -n auto --dist loadfile -m "slow or not slow"

bench: .venv/installed  ## the time of a scan, and the gain by each optimisation, in half an hour; SCAN="--scan FILE" for a scan of yours
	$(BIN)/python benchmarks/performance.py $(SCAN) --engines torch,onnx,int8

gpu: .venv/installed  ## on a machine with a GPU: its tests and its tables, to paste into an issue; SCAN="--scan FILE" for a scan of yours
	$(BIN)/python -m pytest -m gpu -rs
	$(BIN)/python benchmarks/gpu.py $(SCAN)

docs: .venv/docs docs/try/node_modules  ## the site of docs/, in site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint: .venv/installed
	$(BIN)/ruff check src ros2 docker tests benchmarks docs .ci
	$(BIN)/ruff format --check src ros2 docker tests benchmarks docs/*.py .ci
	$(BIN)/mypy

format: .venv/installed
	$(BIN)/ruff check --fix src ros2 docker tests benchmarks docs .ci
	$(BIN)/ruff format src ros2 docker tests benchmarks docs/*.py .ci

release:  ## VERSION=1.2.3 sets and dates a version, commits and tags it; pushing the tag publishes it
	$(PYTHON) .ci/release.py $(VERSION)

# torch is installed first and alone, with a pinned version, so that no other build of it is installed.
.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[simulate,formats,export,test]"
	touch $@

# These packages take 600 MB, so `make test` does not need them.
.venv/fleet: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[fleet]" "moto[server]>=5" duckdb "dask[dataframe]"
	touch $@

.venv/docs: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

# The packages that the page docs/try and its tests need. Without npm, the build reports that it leaves the page out.
docs/try/node_modules: docs/try/package-lock.json
	if command -v npm > /dev/null; then npm ci --prefix docs/try --ignore-scripts --no-audit --no-fund --silent; fi

clean:
	rm -rf .venv demo site build docs/try/node_modules

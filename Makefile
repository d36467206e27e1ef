# Everything runs in a virtual environment of its own, .venv.
PYTHON ?= python3
BIN := .venv/bin
# A process for each processor, and one thread in each. The tests of a file share what they make, so one process runs them.
SPREAD := OMP_NUM_THREADS=1

.PHONY: install demo test test-slow bench gpu docs lint format release clean

install: .venv/installed  ## the package and all that its tests need, in .venv

demo: .venv/installed  ## simulate streets, segment and score them, and show all in demo/index.html
	$(BIN)/amvnet demo --out demo --overwrite

test: .venv/installed lint  ## style, types and the tests; COVERAGE=1 measures which lines they run
	$(SPREAD) $(BIN)/python -m pytest -n auto --dist loadfile $(if $(COVERAGE),--cov=amvnet --cov=lidarstreets --cov-report=term:skip-covered)

test-slow: .venv/installed .venv/fleet  ## the tests that take minutes, and those of fleets, too
	$(SPREAD) $(BIN)/python -m pytest -n auto --dist loadfile -m "slow or not slow"

bench: .venv/installed  ## the time of a scan, and what each optimisation gives: half an hour; SCAN="--scan FILE" for a scan of yours
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

# torch first and by itself: pinned, so that no other build is drawn in.
.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[simulate,formats,export,test]"
	touch $@

# 600 MB, so that `make test` does without.
.venv/fleet: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[fleet]" "moto[server]>=5" duckdb "dask[dataframe]"
	touch $@

.venv/docs: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

# What the page docs/try runs and is tested with. Without npm, the build says that it leaves the page out.
docs/try/node_modules: docs/try/package-lock.json
	if command -v npm > /dev/null; then npm ci --prefix docs/try --ignore-scripts --no-audit --no-fund --silent; fi

clean:
	rm -rf .venv demo site build docs/try/node_modules

# Two commands do all the set-up: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
MIN_VENV ?= .venv-min
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
MIN_STAMP := $(MIN_VENV)/.installed
PIP_INSTALL := pip install --quiet --disable-pip-version-check

.PHONY: demo test test-min check fuzz format reliability clean

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/$(PIP_INSTALL) torch==2.13.0
	$(BIN)/$(PIP_INSTALL) -c constraints.txt -e ".[dev,baselines,cluster,viz]"
	$(BIN)/hybridvo doctor  # compiles the kernels once; later runs load them from the cache
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/hybridvo demo --out runs/demo --overwrite

test: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

# The lowest versions that pyproject.toml promises, in a virtual environment of their own; numba
# keeps one version's kernels at a place, so these go elsewhere.
$(MIN_STAMP): pyproject.toml constraints-min.txt
	$(PYTHON) -m venv $(MIN_VENV)
	$(MIN_VENV)/bin/$(PIP_INSTALL) -c constraints-min.txt -e ".[dev,baselines,cluster,viz]"
	touch $(MIN_STAMP)

test-min: $(MIN_STAMP)
	NUMBA_CACHE_DIR=$(MIN_VENV)/numba $(MIN_VENV)/bin/hybridvo doctor
	NUMBA_CACHE_DIR=$(MIN_VENV)/numba OMP_NUM_THREADS=1 $(MIN_VENV)/bin/python -m pytest -n 2

check: $(STAMP) $(BIN)/pip-audit
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python tools/audit.py constraints.txt

$(BIN)/pip-audit: $(STAMP)
	$(BIN)/$(PIP_INSTALL) -c constraints.txt pip-audit

# The table of docs/reliability.md, from the outcome of every test
reliability: $(STAMP)
	$(BIN)/python tools/reliability.py --run

fuzz: $(STAMP)  # 20 s for each reader; findings in runs/fuzz
	$(BIN)/$(PIP_INSTALL) -c constraints.txt -e ".[fuzz]"
	$(BIN)/python tests/fuzz/fuzz.py --out runs/fuzz

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(MIN_VENV) build dist runs

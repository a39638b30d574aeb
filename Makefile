# Two commands do all the set-up: `make demo` and `make test`. TORCH: what pip installs of PyTorch;
# its CPU build needs the index option that PyTorch's start page names.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEVELOP := $(VENV)/.develop
TORCH ?= torch==2.13.0
DATA ?= ../shared/data
# the bytecode of a module is written when it is first imported: that of all of them takes a minute
PIP_INSTALL := pip install --quiet --disable-pip-version-check --no-compile
# what the modules of the kernels import
KERNELS_NEED := numba scipy opencv-python-headless pyyaml pydantic filelock
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

ROS_PACKAGES := python3-roslaunch python3-rosbag python3-message-filters python3-nav-msgs \
	python3-sensor-msgs python3-diagnostic-msgs python3-std-srvs python3-tf2-msgs \
	python3-visualization-msgs python3-rosservice python3-rostopic

.PHONY: demo test test-slow test-long test-ros golden golden-quick same-answers walk check format docs tables paper wheel release-check clean

# pip is brought to a version that knows groups of dependencies: 25.1
# the kernels are compiled on one core while pip installs the rest on the other
$(STAMP): pyproject.toml hybridvo_lab/pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m $(PIP_INSTALL) -c constraints.txt pip $(KERNELS_NEED)
	$(BIN)/python -m hybridvo.compiled hybridvo_lab/signatures.json & \
	$(BIN)/$(PIP_INSTALL) $(TORCH) && \
	$(BIN)/$(PIP_INSTALL) -c constraints.txt -e ".[all]" -e ./hybridvo_lab && wait
	touch $(STAMP)

# what the demo does without: the viewer, FFmpeg, dask, and the tools of developers
$(DEVELOP): $(STAMP)
	$(BIN)/$(PIP_INSTALL) -c constraints.txt --group dev -e ".[viz,kinect,cluster]"
	touch $(DEVELOP)

demo: $(STAMP)
	$(BIN)/hybridvo demo --out runs/demo --overwrite

test: $(DEVELOP)
	$(PYTEST) -n 2

test-slow: $(DEVELOP)  # what takes more than two seconds each; continuous integration runs it as well
	$(PYTEST) -n 2 -m slow

test-long: $(DEVELOP)  # minutes each: packages that are built, mutations of every constant, fuzzing
	$(PYTEST) -n 2 -m long

test-ros: $(DEVELOP)  # the node of ROS 1 with a master and a bag; as root on Debian 12
	apt-get install --yes --no-install-recommends $(ROS_PACKAGES)
	$(PYTEST) -m ros

golden: $(DEVELOP)  # what moved against the frozen figures, with the recordings of --data
	$(BIN)/python tools/golden.py

golden-quick: $(DEVELOP)  # the part that needs no data: a minute on two cores
	$(BIN)/python tools/golden.py --quick

same-answers: $(DEVELOP)  # BEFORE=<commit>: does a restructuring change no bit of an answer
	$(BIN)/python tools/same_answers.py $(BEFORE) --data $(DATA)

walk: $(DEVELOP)  # rooms, returns between them and record types of three tracked frames
	OMP_NUM_THREADS=1 $(BIN)/python tools/walk.py

check: $(DEVELOP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell
	$(BIN)/deptry hybridvo
	$(BIN)/deptry --config hybridvo_lab/pyproject.toml hybridvo_lab

format: $(DEVELOP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(DEVELOP)
	$(BIN)/$(PIP_INSTALL) -c constraints.txt --group docs
	$(BIN)/mkdocs build --strict -f configs/mkdocs.yml

tables: $(DEVELOP)  # every published figure at this commit: docs/results/README.md; leave the machine idle
	$(BIN)/python tools/tables.py --data $(DATA) $(if $(CLEAN_PYTHON),--clean-python $(CLEAN_PYTHON))

paper: $(DEVELOP)  # docs/paper.md from the rows that tools/ablation.py trained in runs/ablation
	$(BIN)/python tools/paper.py --ablation runs/ablation
	$(BIN)/python tools/make_docs.py

wheel: $(DEVELOP)  # two in dist/: Python files alone, and with kernels compiled for this system
	$(BIN)/python tools/build_wheel.py

# what is published: made from the sdists, installed where nothing else is, used outside of the clone
RELEASE := runs/release
define install_alone
	$(PYTHON) -m venv --clear $(RELEASE)/$(1)
	$(RELEASE)/$(1)/bin/$(PIP_INSTALL) $(TORCH)
	$(RELEASE)/$(1)/bin/$(PIP_INSTALL) $(2)
	$(RELEASE)/$(1)/bin/pip check
endef

release-check: docs
	$(BIN)/$(PIP_INSTALL) -c constraints.txt --group release
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m build --outdir dist hybridvo_lab
	$(BIN)/twine check --strict dist/*
	$(call install_alone,plain,dist/hybridvo-*.whl)
	cd $(RELEASE) && plain/bin/hybridvo doctor
	$(call install_alone,lab,dist/*.whl)
	cd $(RELEASE) && lab/bin/hybridvo demo --frames 3 --out demo --overwrite

clean:
	rm -rf $(VENV) build dist runs site

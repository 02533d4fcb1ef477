# Every target sets up what it needs in .venv by itself; results go to out/.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# All versions are locked, also those of the build tools (two names, for older and newer pip).
LOCK := requirements.lock
INSTALL := PIP_CONSTRAINT=$(LOCK) PIP_BUILD_CONSTRAINT=$(LOCK) $(BIN)/python -m pip install --quiet
# SysIdentPy asks for an older NumPy than the other packages, and works with this one.
SYSIDENTPY := $(BIN)/python -m pip install --quiet --no-deps sysidentpy==0.9.0
# With this variable set, Python caches no byte code, and every process compiles the package again.
unexport PYTHONDONTWRITEBYTECODE
# Use the packages of .venv, ROS 2 included, not those of a sourced ROS 2.
unexport PYTHONPATH AMENT_PREFIX_PATH
# Keep the loop on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

# How many seeds each experiment is run from: make studies SEEDS=5
SEEDS ?= 20

.PHONY: help learn demo demo-retrain demo-saddle walkthrough test test-machines lint models studies studies-sensors studies-robustness studies-late studies-acceptance studies-general studies-unstable studies-saddle studies-partial studies-records studies-export bench faults docs panel-pictures config lock clean

help:  ## show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo 'koopman_ros needs Python 3.11 or newer: make PYTHON=python3.12 ...'; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
	  { echo 'Python venv is missing: sudo apt-get install python3-venv'; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/run.stamp: setup.py $(LOCK) | $(BIN)/python
	$(INSTALL) --editable '.[ros,demo]'
	@touch $@

$(VENV)/test.stamp: setup.py $(LOCK) $(VENV)/run.stamp
	$(INSTALL) --editable '.[ros,learn,test,bench]'
	$(SYSIDENTPY)
	@touch $@

$(VENV)/train.stamp: setup.py $(LOCK) | $(BIN)/python
	$(INSTALL) --editable '.[learn]'
	@touch $@

$(VENV)/retrain.stamp: setup.py $(LOCK) $(VENV)/run.stamp
	$(INSTALL) --editable '.[ros,demo,train]'
	@touch $@

$(VENV)/mpc.stamp: setup.py $(LOCK) $(VENV)/run.stamp
	$(INSTALL) --editable '.[ros,demo,mpc]'
	@touch $@

$(VENV)/panel.stamp: setup.py $(LOCK) $(VENV)/run.stamp
	$(INSTALL) --editable '.[ros,demo,panel]'
	@touch $@

$(VENV)/docs.stamp: setup.py $(LOCK) | $(BIN)/python
	$(INSTALL) --editable '.[docs]'
	@touch $@

$(VENV)/bench.stamp: setup.py $(LOCK) $(VENV)/run.stamp
	$(INSTALL) --editable '.[ros,demo,train,bench]'
	@touch $@

demo: $(VENV)/$(if $(PANEL),panel,run).stamp  ## run a learned controller in closed loop: live table, bag, plot -> out/demo (PLANT=pendulum: out/demo-pendulum; PANEL=1: with the browser panel, until Ctrl-C; EXPORT=1: with its exported C code; DISTURBANCE=1: a step of the feed temperature with and without its measurement -> out/demo-disturbance)
	$(BIN)/python -m koopman_ros.demo $(if $(DISTURBANCE),disturbance) $(if $(PLANT),--plant $(PLANT)) $(if $(PANEL),--panel) $(if $(EXPORT),--export)

demo-retrain: $(VENV)/retrain.stamp  ## retrain the model of a plant that changes -> out/demo-retrain
	$(BIN)/python -m koopman_ros.demo retrain

demo-saddle: SEEDS = 5
demo-saddle: $(VENV)/bench.stamp  ## train on an unstable reactor under PI control, temperature measured only, and stabilise it; SEEDS=5, 15 min -> out/demo-saddle
	$(BIN)/python -m studies.saddle_act --seeds $(SEEDS)

walkthrough:  ## run the commands of README and tutorials, each in a clone of its own, 30 min
	$(PYTHON) test/walkthrough.py

# Types are checked in parallel with the tests. Tests with processes mostly wait, so there are two more
# workers than cores; the longest files come first (test/conftest.py). A killed worker is not replaced:
# its successor would get the same test again.
test: $(VENV)/test.stamp  ## lint, type checks and the whole test suite, on all cores
	$(BIN)/ruff check
	@$(BIN)/mypy > $(VENV)/mypy.log & types=$$!; \
	  $(BIN)/python -m pytest -n $$(($$(nproc) + 2)) --dist loadfile --no-loadscope-reorder \
	    --max-worker-restart 0 -o faulthandler_exit_on_timeout=true; \
	  tests=$$?; wait $$types || tests=1; cat $(VENV)/mypy.log; exit $$tests

test-machines: $(VENV)/test.stamp  ## numerical tests under each OpenBLAS kernel of this processor, one and two threads, 40 min (MACHINES=--quick: two other kernels, 3 min)
	$(BIN)/python test/machines.py $(MACHINES)

lint: $(VENV)/test.stamp  ## lint and type checks
	$(BIN)/ruff check
	$(BIN)/mypy

learn: $(VENV)/train.stamp  ## set up training from Python and the command line, without ROS

models: $(VENV)/bench.stamp  ## retrain the bundled models -> config/models
	$(BIN)/python -m studies.shipped_models

studies: $(VENV)/train.stamp  ## experiments of the paper, SEEDS=20: figures and report -> out/studies
	$(BIN)/python -m studies.paper --seeds $(SEEDS)

studies-sensors: $(VENV)/train.stamp  ## training on noisy sensor data, 10 seeds -> out/studies-sensors
	$(BIN)/python -m studies.paper --sensors --seeds 10

studies-robustness: $(VENV)/bench.stamp  ## margins, region of attraction, disturbances, noise, narrow data, 3 min -> out/studies-robustness
	$(BIN)/python -m studies.robustness

studies-late: $(VENV)/bench.stamp  ## dead times of 10 to 120 s, measured feed, learning a dead time, 2 min -> out/studies-late
	$(BIN)/python -m studies.late_reactor

studies-acceptance: SEEDS = 2
studies-acceptance: $(VENV)/bench.stamp  ## acceptance of models of 16 plants compared with the true plants, white and coloured noise, SEEDS=2, 40 min -> out/studies-acceptance
	$(BIN)/python -m studies.acceptance --seeds $(SEEDS)

studies-general: SEEDS = 10
studies-general: $(VENV)/bench.stamp  ## control of seven plants with models of each class, SEEDS=10 -> out/studies-general
	$(BIN)/python -m studies.general --seeds $(SEEDS)

studies-unstable: SEEDS = 10
studies-unstable: $(VENV)/bench.stamp  ## training on an unstable reactor under a pre-feedback, SEEDS=10, 6 min
	$(BIN)/python -m studies.unstable --seeds $(SEEDS)

studies-saddle: SEEDS = 10
studies-saddle: $(VENV)/bench.stamp  ## control of the unstable reactor, temperature measured only, SEEDS=10, 30 min
	$(BIN)/python -m studies.saddle --seeds $(SEEDS)

studies-export: $(VENV)/run.stamp  ## compare exported C code with the controller: bundled models and 50 random ones, 10,000 samples each, 1 h -> out/studies-export
	$(BIN)/python -m studies.exported_loops --output out/studies-export

studies-partial: SEEDS = 10
studies-partial: $(VENV)/bench.stamp  ## comparison with do-mpc and LQG on three partly measured plants, SEEDS=10, 5 min -> out/studies-partial
	$(BIN)/python -m studies.partly_measured --seeds $(SEEDS)

$(VENV)/records.stamp: setup.py $(LOCK) $(VENV)/bench.stamp
	$(INSTALL) --editable '.[learn,bench]'
	$(SYSIDENTPY)
	@touch $@

studies-records: SEEDS = 3
studies-records: RECORDS = records
studies-records: $(VENV)/records.stamp  ## learning from measured records, compared with ARX, N4SID, NARX and EDMDc; RECORDS=folder, SEEDS=3, 30 min -> out/studies-records
	$(BIN)/python -m studies.records --records $(RECORDS) --seeds $(SEEDS)

bench: $(VENV)/bench.stamp  ## time of a plan of the law mpc, compared with do-mpc and casadi, some minutes (BENCH=--quick: 1 min) -> out/bench
	$(BIN)/python -m benchmarks $(BENCH)

faults: $(VENV)/mpc.stamp  ## inject 191 faults into running loops of six plants, run three of them for a day, 60 min (FAULTS=--quick: 1 min; FAULTS=two_tanks: one plant) -> out/faults
	$(BIN)/python -m studies.faults $(FAULTS)

docs: $(VENV)/docs.stamp  ## build the documentation with the Python API reference, 30 s -> out/docs
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --fresh-env \
	  --doctree-dir out/docs/.doctrees docs out/docs

panel-pictures: $(VENV)/test.stamp  ## take the pictures of the panel, a minute -> docs
	$(BIN)/python docs/panel_pictures.py

config: $(VENV)/run.stamp  ## write config/*.yaml and the SROS2 policy from the parameter tables
	$(BIN)/python -m koopman_ros.ros.node_descriptions

lock: | $(BIN)/python  ## lock the newest versions allowed by setup.py -> requirements.lock
	$(BIN)/python -m pip install --quiet uv
	UV_CUSTOM_COMPILE_COMMAND='make lock' $(BIN)/python -m uv pip compile --quiet --universal --upgrade \
	  --python-version 3.11 --all-extras --no-annotate setup.py --output-file $(LOCK)

clean:  ## remove the environment and the results
	rm -rf $(VENV) out build install log docs/api

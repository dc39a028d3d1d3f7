# SPDX-License-Identifier: Apache-2.0
# Each target does its own set-up: .venv in this folder, packages from PyPI, Debian packages where one is missing.

# Name an interpreter for .venv with PYTHON=python3.12 (3.10 or newer; default: the .venv there is, else python3).
export PYTHON

# Nobody else's plant moves: ROS 2 talks on this machine only, unless told otherwise.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

# A ROS 2 install that the shell has sourced would mix its packages with those of .venv.
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONHOME PYTHONPATH RMW_IMPLEMENTATION

BIN := .venv/bin
SETUP := tools/setup requirements.txt constraints.txt $(wildcard src/*/package.xml src/*/setup.py src/*/setup.cfg)

# Look again when the tree was moved or copied, or an interpreter is named.
ifneq ($(CURDIR)$(PYTHON),$(shell cat .venv/.tree 2>/dev/null))
.PHONY: .venv/.runtime .venv/.dev
endif

.DEFAULT_GOAL := help
.PHONY: help demo live test bench blind real habits sensitivity regression soak fuzz coverage lint clean distclean

help: ## show this
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' Makefile | expand -t 20

demo: .venv/.runtime ## run a plant with a hidden effect and name it (EFFECT=coulomb_friction pins one, ARGS="--help")
	$(BIN)/demo $(if $(EFFECT),--effect $(EFFECT)) $(ARGS)

live: .venv/.runtime ## run a plant that changes and watch it in the browser (ARGS="--effect cable_torque")
	$(BIN)/live $(ARGS)

test: .venv/.dev ## build and test with colcon in a temporary folder, then run every test (ARGS="-k plant")
	tools/setup test
	$(MAKE) -C firmware
	tools/test $(ARGS)

bench: .venv/.dev ## measure speed beside C, scipy, pysindy and rosbags (ARGS=--quick; ARGS=--docs writes docs/results/bench.md)
	tools/setup compiler
	tools/setup firmware
	$(BIN)/python -m evaluation.bench $(ARGS)

blind: .venv/.dev ## diagnose recordings of withheld effects, then open their labels (ARGS="--count 60 --seed 7")
	$(BIN)/python -m evaluation.blind $(ARGS)

real: .venv/.dev ## diagnose recordings of real rigs beside a grey box (DATA=folder with rigs.csv, ARGS="--only a b")
	$(BIN)/python -m evaluation.real $(DATA) $(ARGS)

habits: .venv/.dev ## import tables in the habits of other people (ARGS="--count 200 --seed 1001")
	$(BIN)/python -m evaluation.habits $(ARGS)

sensitivity: .venv/.dev ## diagnose with each decision threshold at 70 and 130 % (ARGS="--minutes 20"; ARGS=--docs)
	$(BIN)/python -m evaluation.sensitivity $(ARGS)

regression: .venv/.dev ## compare the results of this tree with those of another (ARGS="--help")
	$(BIN)/python -m evaluation.regression $(ARGS)

soak: .venv/.runtime ## run a loop for 30 minutes under load, then with faults (ARGS="--minutes 5 --seed 3")
	tools/setup firmware
	$(BIN)/python -m evaluation.soak $(ARGS)

fuzz: .venv/.dev ## try commands with recordings of arbitrary values (ARGS="--command import --minutes 10 --seed 1")
	$(BIN)/python -m evaluation.fuzz $(ARGS)

coverage: .venv/.dev ## tell which lines no test without nodes reaches
	$(BIN)/python -m pytest -q -n auto --dist loadscope -m "not live" --cov --cov-report=term-missing:skip-covered $(ARGS)

lint: .venv/.dev ## check style and types
	$(BIN)/ruff check
	$(BIN)/mypy

clean: ## remove what building and testing left
	rm -rf build install log .mypy_cache .pytest_cache .ruff_cache .hypothesis src/*/build src/*/*.egg-info firmware/build
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean ## remove .venv too
	rm -rf .venv

.venv/.runtime: $(SETUP)
	tools/setup runtime

.venv/.dev: $(SETUP) requirements-dev.txt
	tools/setup dev

# make demo    install everything, then an arm goes round obstacles: what it does, a summary, a plot, a log
# make demo-rover    install everything, then a rover goes round four worlds over MAVLink
# make test    install everything, lint, all tests
# make lint    ruff, mypy, import floors
# make bench   the speed figures on this machine
# make stress  500 random scenarios over the robots, judged by pybullet: about an hour
# make benchmark DATA=FILE,...  problems of MotionBenchMaker, see docs/benchmark.md
# make mutants small changes of what decides about torque, each of which a test must notice: about an hour
# make fuzz    every decoder against bytes that others choose: nine minutes
# make ordeal  100000 random steps with a daemon and its drives, judged from outside: some hours
# make soak    rover and arm for a day of their own time, and the arm for an hour of ours: memory, queues, logs; a day
# make docs    the site of documents, into out/site
# make pictures    every picture of docs anew, and the numbers that their captions name
# make wheels      the wheel in clean environments of Python 3.11 to 3.13
# make lock    resolve requirements.lock anew from pyproject.toml

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SYSTEM := $(VENV)/.system
WARM := $(VENV)/.warm
PYTEST_FLAGS ?=
WORKERS ?= 3

# A program's bytecode is kept when it first runs; without that each start translates all of the sources anew.
unexport PYTHONDONTWRITEBYTECODE

.DELETE_ON_ERROR:
.PHONY: demo demo-rover test lint bench benchmark stress mutants docs pictures wheels fuzz ordeal soak install lock clean

demo: install
	$(BIN)/python -m tools.demo

demo-rover: install
	$(BIN)/python -m tools.demo_rover

test: install lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile $(PYTEST_FLAGS)

lint: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: install
	$(BIN)/python -m tools.bench

stress: install
	$(BIN)/python -m rtctl campaign run tools.stress.source --count 500 --out out/stress

benchmark: install
	$(BIN)/python -m tools.benchmark --data "$(DATA)" $(BENCHMARK_FLAGS)

mutants: install
	$(BIN)/python -m tools.mutants

fuzz: install
	$(BIN)/python -m tools.fuzz

ordeal: install
	$(BIN)/python -m tools.ordeal

soak: install
	$(BIN)/python -m tools.soak --minutes 1440
	$(BIN)/python -m tools.soak --arm --minutes 1440
	$(BIN)/python -m tools.soak --arm --minutes 60 --realtime

docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

pictures: install
	$(BIN)/python -m tools.pictures

wheels: install
	$(BIN)/python -m tools.wheels --sim

install: $(INSTALLED) $(SYSTEM) $(WARM)

$(INSTALLED): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "rtctl needs Python 3.11 or newer: make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

# Done once where it succeeds; where it may not install, it names the command and is asked again next time.
$(SYSTEM): tools/setup.sh | $(INSTALLED)
	@if sh tools/setup.sh; then touch $@; fi

# Compiled ahead, so that the first start is a quick one; a start does it by itself where this did not.
$(WARM): $(shell find rtctl -name '*.py') | $(INSTALLED)
	-$(BIN)/rtctl warm
	@touch $@

lock: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-tools
	CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/python -m piptools compile --quiet --upgrade --generate-hashes \
		--strip-extras --allow-unsafe --extra test --extra campaign --no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
		--output-file requirements.lock pyproject.toml

clean:
	rm -rf $(VENV) build dist out .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

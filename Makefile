# Every target makes the environment it needs; `make eval` and `make test` work on a fresh machine.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export MUJOCO_GL ?= egl
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# WANDB_MODE=online sends runs to your account; nothing is sent unless you say so.
export WANDB_MODE ?= offline
# Model weights come from this repository or from a path you give, never from a hub.
export HF_HUB_OFFLINE ?= 1
XDIST := -n auto --maxprocesses=4 --dist=worksteal
EXTRAS := smplx==0.1.28 xgrammar==0.2.8 apache-tvm-ffi==0.1.15.post2 holosoma-retargeting==0.1.0 bitsandbytes==0.50.2
QUICK := tests/configs tests/interface tests/model tests/planners tests/report \
  $(addprefix --ignore=tests/,$(addprefix report/test_,export.py figures.py notebook.py reconstruction.py tokenizer.py video.py) \
  $(addprefix planners/,chat/dag_plan/test_episode.py scripted/test_planner.py test_released.py))

.PHONY: setup eval test test-slow extras test-extras quick check mutants release-check serve motions lock pictures docs reproduce third-party clean

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python >= 3.11 is needed, this is " + sys.version.split()[0])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

eval: $(STAMP)
	$(BIN)/python -m sim doctor quiet=true
	$(BIN)/python eval.py planner=proprio robot=h1

# The tests but those marked `slow`, on all cores up to four.
test: $(STAMP)
	$(BIN)/python -m pytest $(XDIST) -m "not slow" $(PYTEST_ARGS)

test-slow: $(STAMP)
	$(BIN)/python -m pytest $(XDIST) -m slow $(PYTEST_ARGS)

extras: $(STAMP)
	$(BIN)/python -m pip install --quiet --no-deps --upgrade --target $(VENV)/extras $(EXTRAS)

# The tests of what the environment goes without: SMPL-X, grammar-constrained replies, real motion clips, layers in 4 bits.
test-extras: extras
	PYTHONPATH=$(VENV)/extras $(BIN)/python -m pytest $(XDIST) $(PYTEST_ARGS) \
	  $(addprefix tests/,data/test_amass.py data/test_omomo.py data/test_retarget.py backends/test_grammar.py model/test_four_bit.py)

# What needs no simulator, for the minute between two edits.
quick: $(STAMP)
	$(BIN)/python -m pytest $(XDIST) -m "not slow" $(QUICK) $(PYTEST_ARGS)

check: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	$(BIN)/python tools/structure.py --check

# Which bugs, put in one by one, the tests notice; an hour of a core, and it goes on where it was killed.
mutants: $(STAMP)
	$(BIN)/python benchmarks/mutants.py

# What a release needs beyond the tests: tasks come from their seeds, certificates are of the present physics.
release-check: $(STAMP)
	$(BIN)/python -m sim benchmark release=true

# The released tiny base model of version 0.1, which answers prompts, behind OpenAI's chat API on http://127.0.0.1:8377/v1, or another: SERVE_ARGS="weights=... port=...".
serve: $(STAMP)
	$(BIN)/python -m proprio_mllm serve $(SERVE_ARGS)

# Real human motion (two OMOMO clips, five climbing clips), data only: 100 MB, used by tests marked `motions`.
motions: $(STAMP)
	$(BIN)/python -m pip install --quiet --no-deps $(filter holosoma%,$(EXTRAS))

# Re-pins the environment from pyproject.toml. torch stays at the version that has a CPU build.
lock: $(STAMP)
	$(BIN)/python tools/lock.py > requirements.lock.tmp && mv requirements.lock.tmp requirements.lock

clean:
	rm -rf $(VENV) outputs site

# The pictures of rooms and robots in the docs, and the film of the README.
pictures: $(STAMP)
	$(BIN)/python tools/pictures.py

# The documentation as a site that opens from its folder: site/index.html. Links that lead nowhere are errors.
docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --editable ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

# A table of the paper: runs what is missing, says how long that takes first. TABLE=main, replanning, ablation, failures, distributions
reproduce: $(STAMP)
	$(BIN)/python -m tools.reproduce table=$(or $(TABLE),main)

third-party: $(STAMP)
	$(BIN)/python tools/third_party.py > THIRD_PARTY.md

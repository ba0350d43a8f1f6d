# Everything works from a bare clone: each target makes .venv first if it is missing.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt
# Index of PyTorch's builds: for the CPU; of another one, or a mirror: make clean test TORCH_INDEX=URL, such as
# https://download.pytorch.org/whl/cu128 for a GPU.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

# What `make test` runs.
QUICK := not slow and not browser and not extra

.PHONY: demo test test-extras test-slow test-browser test-explore fuzz lint format docs docs-pages clean

# An interrupted demo resumes.
demo: $(READY)
	$(BIN)/dsrc demo --out demo

# Compiled modules are kept whatever the environment says: the tests start some hundred processes.
test: $(READY)
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile -m '$(QUICK)'

# Tests that need optional packages: ONNX, Ray, MCAP, stable-baselines3, optuna, those that write the files of others.
test-extras: $(READY)
	$(INSTALL) --editable '.[dev,onnx,ray,argoverse,ros,mcap,rl,notebook,pettingzoo,osi,foreign,search]'
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto -m 'extra and not slow and not browser' \
	    $$(grep -rl --include 'test_*.py' importorskip tests)

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow --timeout 1800

test-browser: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile -m 'browser and not slow' tests/dsrc/review

# Property tests on new random examples.
test-explore: $(READY)
	$(BIN)/python -m pytest --hypothesis-profile explore $$(grep -rl --include 'test_*.py' hypothesis tests)

# Broken files for every reader, 3,000 of a new seed; the last line counts stack traces and hangs.
fuzz: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz.run --inputs 3000

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers auto

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The site in docs/_site; a warning is an error.
docs: $(READY)
	$(INSTALL) --editable '.[docs]'
	rm -rf docs/_site
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going docs docs/_site

# The same with review pages of some scenarios; minutes.
docs-pages: docs/_pages/four_way.html docs/_pages/ima_queue.html docs/_pages/helsinki.html
	$(MAKE) docs

docs/_pages/%.html: $(READY)
	mkdir -p $(@D)
	$(BIN)/dsrc generate $* --seed 1 --frames 20 --interval-s 0.2 --out runs/docs/$*
	$(BIN)/dsrc view runs/docs/$* --checkpoint dsrc/checkpoints/small-dsrc.pt --frames 20 --out $@

# An index that cannot be reached is left out: the packages then come from the registry alone.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(INSTALL) --retries 1 --extra-index-url $(TORCH_INDEX) --no-deps torch
	$(INSTALL) --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv demo runs/docs docs/_site docs/_pages

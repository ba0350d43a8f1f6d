# Everything works from a bare clone: each target makes .venv first if it is missing.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt
# Builds of PyTorch for the CPU; on Linux the registry's build brings gigabytes of CUDA. For a GPU:
# make clean test TORCH_INDEX=https://pypi.org/simple
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

.PHONY: demo results tables test test-slow test-browser test-explore fuzz lint format docs clean

# An interrupted demo resumes.
demo: $(READY)
	$(BIN)/dsrc demo --out demo

# All trainings of docs/results.md, then its tables; days on two cores, and an interrupted one resumes. `make tables`
# measures the trainings that are kept in the repository; three hours, estimated.
SMALL := docs/results/dsrc-sim-small
KEPT := $(SMALL)/kept
BENCHMARK := OMP_NUM_THREADS=1 $(BIN)/dsrc benchmark --docs docs/results.md --partial --workers 2
results: $(READY)
	$(BIN)/dsrc dataset build dsrc-sim --out data/dsrc-sim
	$(BIN)/dsrc dataset build dsrc-sim-vulnerable --out data/dsrc-sim-vulnerable
	$(BIN)/python examples/campaign.py --data data/dsrc-sim --out runs --kept $(KEPT) --past G2
	cp runs/trainings.csv $(SMALL)
	$(MAKE) tables

tables: $(READY)
	$(BIN)/dsrc dataset build dsrc-sim --out data/dsrc-sim
	mkdir -p runs
	for one in $(KEPT)/*/; do [ -e runs/$$(basename $$one) ] || cp -r $$one runs || exit 1; done
	$(BENCHMARK) $(SMALL)/benchmark.toml --out runs/benchmark
	$(BENCHMARK) $(SMALL)/twins.toml --out runs/twins
	$(BENCHMARK) $(SMALL)/sweeps.toml --out runs/sweeps
	$(BIN)/python examples/score_thresholds.py runs/twins --docs docs/results.md
	$(BIN)/python examples/score_thresholds.py runs/benchmark --docs docs/results.md --scores 0.2 0.25 0.3 \
		--baseline F-Cooper V2VNet V2X-ViT CoBEVT Where2comm CoAlign ERMVP MRCNet-style
	$(BIN)/python examples/road_users.py --data data/dsrc-sim/test --frames 368 --docs docs/results.md \
		--checkpoint vulnerable-alone=runs/vulnerable-alone/student/detector.pt vulnerable=runs/vulnerable/student/detector.pt
	$(BIN)/python examples/zoo.py $(KEPT) --docs docs/zoo.md

test: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow --timeout 1800

test-browser: $(READY)
	$(BIN)/python -m pytest -m browser tests/dsrc/review

# Property tests on new random examples.
test-explore: $(READY)
	$(BIN)/python -m pytest --hypothesis-profile explore $$(grep -rl --include 'test_*.py' hypothesis tests)

# Broken files for every reader, ten minutes of new ones; the last line says how many.
fuzz: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -W ignore -m tests.fuzz.run --seconds 600

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The site in docs/_site, with review pages of some scenarios; a warning is an error.
docs: $(READY) docs/_pages/four_way.html docs/_pages/ima_queue.html docs/_pages/helsinki.html
	$(INSTALL) --editable '.[docs]'
	rm -rf docs/_site
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going docs docs/_site

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

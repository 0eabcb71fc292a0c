# `make demo` and `make test` need Python 3.11 to 3.13 with pip, make and git, and nothing else.
PYTHON ?= python3
BIN := .venv/bin
PYTEST := $(BIN)/python -m pytest

.PHONY: demo test test-slow test-mjx test-cluster test-onnx test-trackers test-sb3 test-playground test-warp test-browser torture check lint types docs notebooks results bench bench-peers bench-compare clean

demo: .venv/ready  ## train MAPG (M = 10) on Pendulum and score it over 100 episodes
	$(BIN)/mapg train --env pendulum --heads 10 --steps 40000 --evaluate-every 2000

test: .venv/ready  ## the tests, under 12 minutes on 2 cores
	$(PYTEST) -n 2 --dist worksteal -m "not mjx and not slow and not cluster and not onnx and not trackers and not sb3 and not playground and not warp and not browser"

test-slow: .venv/ready  ## every algorithm resumes, learns and goes in lockstep; training by Brax; lowering; experiments in full; about 20 minutes on 2 cores
	XLA_FLAGS= $(PYTEST) -n 2 -m "slow and not mjx"

test-mjx: .venv/ready  ## the tests that compile every task for MJX, about 15 minutes on 2 cores
	$(PYTEST) -m mjx

test-cluster: .venv/ready  ## several hosts that make one run, and sweeps by Slurm (Debian's slurm-wlm and munge) and Ray
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,ray,slurm]'
	$(PYTEST) -m cluster

test-trackers: .venv/ready  ## Weights & Biases and MLflow, without a network
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,wandb,mlflow]'
	$(PYTEST) -m trackers

test-onnx: .venv/ready  ## policies as ONNX, read by onnxruntime
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,export,onnx]'
	$(PYTEST) -m onnx

test-sb3: .venv/ready  ## our environments in Stable-Baselines3
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,sb3]'
	$(PYTEST) -m sb3

test-playground: .venv/ready  ## MuJoCo Playground's environments
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,playground]'
	$(PYTEST) -m playground

test-warp: .venv/ready  ## the physics engine mjx-warp
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,warp]'
	$(PYTEST) -m warp

test-browser: .venv/ready docs  ## pages in a browser: Debian's chromium and chromium-driver
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,browser]'
	$(PYTEST) -m browser

torture: .venv/ready  ## breaks runs on purpose, and counts what is lost; goes on from the last time
	$(BIN)/python -m benchmarks.torture

check: lint types test  ## all that is asked of a change

lint: .venv/ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: .venv/ready
	$(BIN)/pyright

results: .venv/ready  ## results/README.md and its pictures, from the committed CSV files
	$(BIN)/mapg paper all --no-train

bench: .venv/ready  ## speed, against peers where they are installed
	$(BIN)/python -m benchmarks

PAGES := README.md CHANGELOG.md CONTRIBUTING.md CODE_OF_CONDUCT.md SECURITY.md LICENSE CITATION.cff docs results \
	experiments/protocol.md benchmarks/results.md benchmarks/notes.md $(wildcard benchmarks/*.png benchmarks/*.csv) zoo

docs: .venv-docs/ready  ## the site, in .site/html, which opens without a network
	rm -rf .site && mkdir -p .site/source
	cp -r --parents $(PAGES) .site/source
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --quiet --strict -f docs/mkdocs.yml

notebooks: .venv/ready  ## the tutorials, executed in their smallest form
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,notebooks]'
	MAPG_SMALL=1 $(PYTEST) --nbmake docs/tutorials

bench-peers: .venv-peers/ready  ## installs the peers for `make bench`

bench-compare: .venv/ready  ## speed against another checkout: make bench-compare OTHER=../before
	$(BIN)/python -m benchmarks.compare $(OTHER)

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; (3, 11) <= v <= (3, 13) or sys.exit(f"Python {v[0]}.{v[1]} found, 3.11 to 3.13 needed: make PYTHON=python3.12")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

.venv-docs/ready: docs/requirements.txt
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m pip install --quiet --requirement docs/requirements.txt
	touch $@

.venv-peers/ready: benchmarks/peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet --requirement benchmarks/peers.txt
	touch $@

clean:
	rm -rf .venv .venv-docs .venv-peers .site

.PHONY: setup demo test lint docs help lock

# What `lerobot-wmrl-demo` gets besides its preset: make demo DEMO_FLAGS="--seed=1 --output_dir=outputs/demo-1"
DEMO_FLAGS ?=
# Two processes suit two cores: a test starts commands of its own, and each process loads a simulator. xdist would
# put files with few tests last, which are the longest here.
PYTEST_FLAGS ?= --numprocesses=2 --dist=loadfile --no-loadscope-reorder

setup:  ## an interpreter, .venv, the locked packages, this project, a renderer: does only what is missing
	@tools/setup.sh

demo: setup  ## the whole loop, then outputs/demo/report.html
	.venv/bin/lerobot-wmrl-demo --preset=demo --output_dir=outputs/demo $(DEMO_FLAGS)

test: setup
	@tools/ensure_browser.sh
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest $(PYTEST_FLAGS)

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

docs: setup  ## docs/results.md from docs/results/*.json, docs/reference from the stored pages of --help
	.venv/bin/python -m experiments.tables
	.venv/bin/python tools/reference_pages.py

help: setup  ## the stored pages of `--help`, after a change of flags or their explanations
	.venv/bin/python tools/write_help_pages.py

UV ?= $(or $(wildcard .uv/bin/uv),uv)

lock:  ## requirements.lock: every package pinned and hashed, no address, so any mirror serves it
	$(UV) pip compile pyproject.toml --extra dev --extra maniskill --universal --python-version 3.12 \
		--no-header --no-annotate --generate-hashes -o requirements.lock

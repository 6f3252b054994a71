# Two commands, nothing to prepare: 'make demo' and 'make test'. All set up .venv first (Python >= 3.11, a C++ compiler).
#   make demo            encode the recording that ships with gsstream; says where the pictures are and how to open it
#   make test            lint, types, import rules and all tests
#   make check           the same with the quick tests alone: for every change, in a minute or two on two cores
#   make docs            the reference pages that are made from the code, in docs/reference/; after make demo the gallery, too
#   make gallery         the demo's stream on a page, with what it costs beside it, in runs/gallery/: static files to host
#   make film            the film at the head of the README, from a run of the demo (minutes); its page needs node and Chromium
#   make dist            every distribution, as source archive and wheel, in dist/
#   make PYTHON=python3.12 test    choose the interpreter .venv is made with
#   make clean           remove .venv and what was built

PYTHON ?= python3
# make itself presets CXX to g++, which a machine with clang alone does not have.
ifeq ($(origin CXX),default)
CXX := c++
endif
VENV := .venv
BIN := $(VENV)/bin
DEMO_METHOD ?= s2gs-edge
# Half of the usual iterations of frame 0, for somebody who waits: half a decibel less (docs/results/index.md, the demo).
DEMO_SETTINGS ?= --set first_frame.max_iterations=1000
DEMO_OUT ?= runs/demo
WORKERS ?= $(shell echo $$(( $$(nproc) < 4 ? $$(nproc) + 1 : 4 )))

# The stamps carry a checksum of what they were made from, so a change of contents, not of dates, sets up again.
LISTS := requirements.txt $(wildcard pyproject.toml plugins/*/pyproject.toml)
NATIVE := $(wildcard plugins/cpu_render/CMakeLists.txt plugins/cpu_render/pyproject.toml plugins/cpu_render/src/cpp/*/*)
checksum = $(firstword $(shell cat $(1) | cksum))
INSTALLED := $(VENV)/.installed-$(call checksum,$(LISTS))
BUILT := $(VENV)/.built-$(call checksum,$(NATIVE))

.PHONY: demo test check test-live docs gallery film dist setup clean
.DEFAULT_GOAL := demo

demo: setup
	$(BIN)/gsstream run --method $(DEMO_METHOD) $(DEMO_SETTINGS) --source demo --out $(DEMO_OUT) --overwrite
	@echo "The stream, its measurements and the pictures are in $(abspath $(DEMO_OUT)):"
	@ls -1 $(DEMO_OUT)
	@echo "See it move: $(BIN)/gsstream open $(DEMO_OUT)"

# The workers of pytest and the hundreds of processes that tests start read the same modules: whoever is first compiles
# them for all, whatever the environment says.
unexport PYTHONDONTWRITEBYTECODE

# Every check runs even when an earlier one failed. mypy, a minute of one core, works beside the tests and speaks last.
# conftest.py puts the longest files first, and one worker more than cores fills the time in which a test waits.
check: PYTEST_ARGS := -m "quick and not slow"
test check: setup
	@status=0; \
	$(BIN)/mypy > $(VENV)/mypy.log 2>&1 & types=$$!; trap "kill $$types" INT TERM; \
	for check in "ruff check ." "ruff format --check --quiet ." "lint-imports"; do \
	  echo "== $$check"; $(BIN)/$$check || { echo "== FAILED: $$check"; status=1; }; \
	done; \
	echo "== pytest"; $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS) || status=1; \
	echo "== mypy"; wait $$types || { echo "== FAILED: mypy"; status=1; }; cat $(VENV)/mypy.log; \
	exit $$status

# Network cameras in real time: a minute, and a machine that is not busy.
test-live: setup
	$(BIN)/python -m pytest -m live plugins/capture

docs: setup
	$(BIN)/python -m tools.reference
	$(BIN)/python -m tools.figures
	@if test -f $(DEMO_OUT)/stream.gss; then $(MAKE) --no-print-directory gallery; fi

gallery: $(DEMO_OUT)/stream.gss
	$(BIN)/python -m tools.gallery $(DEMO_OUT) --out runs/gallery

film: setup
	$(BIN)/python -m tools.film --out docs/images/film.webp

$(DEMO_OUT)/stream.gss:
	@$(MAKE) --no-print-directory demo

dist: setup
	$(BIN)/python -m tools.dist --out dist

setup: $(BUILT)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "gsstream needs Python 3.11 or newer; '$(PYTHON)' is: $$($(PYTHON) --version 2>&1)."; \
	  echo "Name another one: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { \
	  echo "Could not make a virtual environment (on Debian and Ubuntu: apt install python3-venv)."; rm -rf $(VENV); exit 1; }

# Plugins of pure Python are built by the hatchling that is installed by then. For each that is built in an environment of
# its own, pip installs one there, which takes three times as long as the rest.
$(INSTALLED): $(BIN)/python
	@echo 'int main() { return []<class T>(T x) { return x; }(0); }' | $(CXX) -std=c++20 -x c++ -fsyntax-only - 2>/dev/null || { \
	  echo "gsstream builds its renderer with a C++20 compiler; '$(CXX)' is missing or too old."; \
	  echo "Install one (on Debian and Ubuntu: apt install g++) or name another: make CXX=clang++"; exit 1; }
	@rm -f $(VENV)/.installed-* $(VENV)/.built-*
	@grep -v '^-e plugins/' requirements.txt > $(VENV)/first.txt
	@grep '^-e plugins/' requirements.txt | grep -v cpu_render > $(VENV)/pure.txt
	CXX=$(CXX) $(BIN)/python -m pip install --disable-pip-version-check -r $(VENV)/first.txt -e plugins/cpu_render
	$(BIN)/python -m pip install --disable-pip-version-check --no-build-isolation -r $(VENV)/pure.txt
	@touch $(INSTALLED) $(BUILT)

# Only the native sources changed: build the renderer again and leave everything else alone.
$(BUILT): $(INSTALLED)
	@test -e $(BUILT) || { rm -f $(VENV)/.built-*; \
	  CXX=$(CXX) $(BIN)/python -m pip install --disable-pip-version-check --no-deps -e plugins/cpu_render; }
	@touch $(BUILT)

clean:
	rm -rf $(VENV) plugins/cpu_render/build

# make demo       refine a sample shot and say where the layer, the report and the picture are
# make test       every check, and the fast tests
# make test-all   every check, and all tests
# make site       the documentation as a site, in build/site
# make blender    the solver, and the add-on for Blender that runs it, as a zip, build/physgraph_usd-blender.zip
# make films      the films of README.md and the gallery and the pictures of tune; SHOTS=folder has the real shots
# make format     let ruff rewrite what it can
# make newest     the demo and the fast tests with the newest release of each dependency, in .venv-newest
# SOLVER=PATH makes the add-on run a command physgraph-usd that is installed elsewhere.
# PYTHON=python3.12 picks the interpreter of the environment; JOBS=8 the number of test processes.
# TORCH=auto takes torch's build for this machine's card, TORCH=cu128 the one for that CUDA, TORCH=pip the one on pip's
# index; else its CPU build.

PYTHON ?= python3
TORCH ?= cpu
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin
UPGRADE :=
PIP := $(BIN)/python -m pip install --disable-pip-version-check --quiet --quiet $(UPGRADE)
TESTED := $(if $(UPGRADE),,-c constraints.txt)
DEMO := out/demo
ADDON := build/physgraph_usd-blender.zip
# A process begins with tests of its own files, so that what a file solves once is solved once, and helps out at the end.
TESTS := $(BIN)/pytest -n $(JOBS) --dist worksteal

.PHONY: demo site blender films test test-all fast all lint style types format newest clean

demo: $(VENV)/.demo
	@mkdir -p $(DEMO)
	@shot=$$($(BIN)/physgraph-usd sample sleeve -o $(DEMO) --overwrite) && \
	$(BIN)/physgraph-usd refine $$shot -o $(DEMO)/sleeve.refined.usdc --report $(DEMO)/sleeve.json --overwrite >/dev/null && \
	$(BIN)/physgraph-usd preview $(DEMO)/sleeve.refined.usdc --shot $$shot -o $(DEMO)/sleeve.png --overwrite >/dev/null && \
	printf '\nshot     %s\nlayer    %s\nreport   %s\npicture  %s\n' \
		$$shot $(DEMO)/sleeve.refined.usdc $(DEMO)/sleeve.json $(DEMO)/sleeve.png

# Types are checked beside the tests, which leave a core idle now and then.
test: style
	@$(MAKE) --no-print-directory -j 2 types fast

test-all: style
	@$(MAKE) --no-print-directory -j 2 types all

fast: $(VENV)/.dev
	$(TESTS) -m "not slow"

all: $(VENV)/.dev
	$(TESTS)

site: $(VENV)/.dev
	$(BIN)/mkdocs build --strict

# The files stand at the top of the zip, as Blender wants them; solver.txt holds the path of the command.
blender: $(if $(SOLVER),,$(VENV)/.demo)
	@mkdir -p $(dir $(ADDON))
	@printf '%s\n' '$(or $(SOLVER),$(CURDIR)/$(BIN)/physgraph-usd)' >$(dir $(ADDON))solver.txt
	@cd plugins/blender && $(PYTHON) -m zipfile -c $(abspath $(ADDON)) *.py *.toml README.md \
		$(abspath $(dir $(ADDON)))/solver.txt
	@echo $(ADDON)

# Takes the program ffmpeg and a browser.
films: $(VENV)/.dev
	$(BIN)/python -m benchmarks.films docs/films $(if $(SHOTS),--folder $(SHOTS))
	$(BIN)/python -m docs.tables
	$(BIN)/python -m benchmarks.tune --pictures docs

lint: style types

style: $(VENV)/.dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports

types: $(VENV)/.dev
	$(BIN)/pyright --pythonpath $(BIN)/python

format: $(VENV)/.dev
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# pip says which versions there are that the bounds in pyproject.toml leave out.
newest:
	@rm -f .venv-newest/.torch .venv-newest/.demo .venv-newest/.dev
	@$(MAKE) --no-print-directory VENV=.venv-newest DEMO=out/newest UPGRADE='--upgrade --upgrade-strategy eager' demo fast
	.venv-newest/bin/python -m pip list --disable-pip-version-check --outdated

clean:
	rm -rf $(VENV) .venv-newest out build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' || \
		{ echo 'error: $(PYTHON) is not Python 3.11 to 3.14; choose one with make PYTHON=python3.12'; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	@touch $@

# uv knows where torch's builds are, and takes all else from pip's index. Its errors are kept in a file.
$(VENV)/.torch: $(VENV)/.python
ifeq ($(TORCH),pip)
	@echo "installing torch from pip's index"
else
	@echo "installing the $(TORCH) build of torch from torch's own index"
	@index=$${PIP_INDEX_URL:-$$($(BIN)/python -m pip config get global.index-url 2>/dev/null)}; \
	{ $(PIP) uv && $(BIN)/uv pip install --quiet --python $(BIN)/python --torch-backend $(TORCH) \
		$(if $(UPGRADE),--upgrade,-c constraints.txt) $${index:+--default-index "$$index"} -r pyproject.toml; } 2>$(VENV)/uv.log || \
	echo "not available here ($(VENV)/uv.log says why): installing torch from pip's index, on Linux 5.6 GB instead of 1.8"
endif
	@touch $@

$(VENV)/.demo: pyproject.toml $(VENV)/.torch
	$(PIP) $(TESTED) -e '.[usd,preview]'
	@touch $@

$(VENV)/.dev: pyproject.toml $(VENV)/.torch
	$(PIP) $(TESTED) -e '.[dev]'
	$(PIP) --upgrade --no-deps --target $(VENV)/pyblish 'pyblish-base>=1.8,<2'
	@touch $@ $(VENV)/.demo

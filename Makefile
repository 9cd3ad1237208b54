# Everything runs in .venv, which is made when it is missing. Installing is repeated only when
# pyproject.toml or constraints.txt change. Other Python: make demo PYTHON=python3.12
PYTHON ?= python3
JOBS ?= 2

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install -qq -c constraints.txt
SPECS := pyproject.toml constraints.txt
PEERS := $(VENV)-peers
CONSTRAINED_PYTHONS ?= python3.11 python3.12

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-slow lint docs release constraints clean
.PHONY: bench bench-peers

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' Makefile | awk -F'|' '{ printf "make %-14s %s\n", $$1, $$2 }'

demo: $(VENV)/main.stamp ## Play with a trained pendulum while T-MCL trains on Pendulum, in minutes
	@$(BIN)/headway play & trap "kill $$! 2>/dev/null" EXIT; \
		$(BIN)/headway train pendulum --preset quick --seed 0 --run-dir runs/demo

test: $(VENV)/test.stamp ## Run the tests; JOBS=4 runs four at a time
	@$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder -m "not slow"

test-slow: $(VENV)/test.stamp $(VENV)/docs.stamp ## Run the tests that take minutes each
	@$(BIN)/python -m pytest -m slow

lint: $(VENV)/test.stamp $(VENV)/lint.stamp ## Check style, types and import rules
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright
	@$(BIN)/lint-imports

bench: $(VENV)/test.stamp $(VENV)/bench.stamp ## Time planning, fitting and environments; wants an idle machine
	@$(BIN)/python -m pytest benchmarks -o python_files='bench_*.py' -p no:xdist --benchmark-quiet

bench-peers: $(VENV)/main.stamp $(PEERS)/peers.stamp ## Time a plan of mbrl-lib beside Headway's; installs PyTorch
	@$(BIN)/python benchmarks/peers/compare.py --peer-python $(PEERS)/bin/python

docs: $(VENV)/main.stamp $(VENV)/docs.stamp ## Write the site, guides and API reference, to site/
	@$(BIN)/python -m mkdocs build -q -d site
	@echo "The site is in site/index.html"

release: $(VENV)/test.stamp ## Build wheel and sdist; try the wheel in a fresh environment
	@rm -rf dist $(VENV)-release
	@$(BIN)/python -m hatchling build -d dist
	@$(PYTHON) -m venv $(VENV)-release
	@$(VENV)-release/bin/python -m pip install -qq -c constraints.txt "$$(echo dist/*.whl)[lab]"
	@cd $(VENV)-release && bin/headway train pendulum --preset smoke --run-dir try
	@$(VENV)-release/bin/headway report $(VENV)-release/try -o $(VENV)-release/report.html
	@rm -rf $(VENV)-release
	@ls dist

constraints: ## Rewrite constraints.txt from fresh installs of the newest versions
	@for python in $(CONSTRAINED_PYTHONS); do \
		venv=$(VENV)-constraints/$$(basename $$python) && rm -rf $$venv && echo "$$python: installing" && \
		$$python -m venv $$venv && $$venv/bin/python -m pip install -qq --upgrade pip && \
		$$venv/bin/python -m pip install -qq '.[lab,play]' --group test --group bench --group lint --group docs && \
		$$venv/bin/python -m pip freeze --all --exclude headway --exclude setuptools \
			| LC_ALL=C sort > $$venv.txt || exit 1; \
	done
	@cd $(VENV)-constraints && set -- $(notdir $(CONSTRAINED_PYTHONS)) && { \
		LC_ALL=C comm -12 $$1.txt $$2.txt; \
		LC_ALL=C comm -23 $$1.txt $$2.txt | sed 's/$$/; python_version < "3.12"/'; \
		LC_ALL=C comm -13 $$1.txt $$2.txt | sed 's/$$/; python_version >= "3.12"/'; \
	} | LC_ALL=C sort -f > pins.txt
	@sed -n '/^#/p' constraints.txt | cat - $(VENV)-constraints/pins.txt > $(VENV)-constraints/new.txt
	@mv $(VENV)-constraints/new.txt constraints.txt

clean: ## Remove caches and build leftovers; keeps .venv, runs and saved results
	@rm -rf build dist site .pytest_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks
	@rm -rf $(VENV)-constraints benchmarks/latest MUJOCO_LOG.TXT
	@find src tests benchmarks results -name __pycache__ -type d -prune -exec rm -rf {} +

# pip exists only where venv succeeded; a .venv that somebody else made is used as it is.
$(VENV)/main.stamp: $(SPECS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and \
		"error: Python %d.%d is too old, allowed: 3.11 or newer; use make PYTHON=python3.11" \
		% sys.version_info[:2])'
	@test -x $(BIN)/pip || { echo "Creating $(VENV)"; $(PYTHON) -m venv $(VENV); }
	@echo "Installing headway into $(VENV)"
	@$(INSTALL) --editable '.[lab,play]'
	@touch $@

# A pip of 2025 or newer, because only that knows dependency groups.
$(VENV)/%.stamp: $(VENV)/main.stamp
	@echo "Installing what $* needs"
	@$(INSTALL) --upgrade pip
	@$(INSTALL) --group $*
	@touch $@

# mbrl-lib pins a Hydra that Python 3.11 cannot import and an OmegaConf that pip 24.1 refuses, so
# newer ones are installed beside it. Where there is no CPU build of PyTorch it is the CUDA build.
$(PEERS)/peers.stamp: benchmarks/peers/constraints.txt
	@test -x $(PEERS)/bin/pip || $(PYTHON) -m venv $(PEERS)
	@echo "Installing mbrl-lib into $(PEERS)"
	@$(PEERS)/bin/python -m pip install -qq -c $< torch numpy hydra-core gymnasium termcolor tqdm packaging
	@$(PEERS)/bin/python -m pip install -qq -c $< --no-deps mbrl
	@touch $@

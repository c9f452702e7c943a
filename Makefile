# Every target installs what it needs into .venv; ARGS passes further arguments to its command:
#     make landing ARGS="--preset textbook --seed 1"
#     make test ARGS="-k relax -x"

PYTHON ?= python3
VENV   := .venv
OLDEST := .venv-oldest
BIN    := $(VENV)/bin
ARGS   ?=

# One thread: the matrices are small, and threads cost more than they give (measured: 150 x 150
# factorisations are ten times slower with two threads on a busy two-core machine).
export OPENBLAS_NUM_THREADS ?= 1
export MPLBACKEND ?= Agg
export PIP_DISABLE_PIP_VERSION_CHECK ?= 1

NOTEBOOKS  := $(wildcard notebooks/build.py)
BENCHMARKS := $(wildcard benchmarks/peers.py benchmarks/scaling.py benchmarks/correlated.py)

.DEFAULT_GOAL := help
.PHONY: .venv help landing test lint format types notebooks notebooks-check book book-check bench \
	mutation mutation-score test-oldest clean

help: ## list the targets (the default)
	@awk -F ':.*## ' '/^[.a-z-]+:.*## / { printf "make %-16s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

# --- environments: a stamp file a set of requirements, made anew when the requirements change ---

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

.venv: $(VENV)/.dev ## the environment for all but notebooks and benchmarks

# What landing.py needs: the modules, figures and progress bars.
$(VENV)/.run: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[landing]'
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $(VENV)/.run $@

# $(VENV)/.notebooks, $(VENV)/.browser and $(VENV)/.benchmarks
$(VENV)/.%: pyproject.toml constraints.txt | $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$*]'
	@touch $@

# --- the experiment ---

landing: $(VENV)/.run ## the drone-landing experiment (ARGS="--help" lists its options)
	$(BIN)/python landing.py $(ARGS)

# --- checks ---

# A file is one process's work, for what its tests share.
test: $(VENV)/.dev ## the tests, on all cores, with branch coverage
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile $(ARGS) --cov

lint: $(VENV)/.dev ## style: ruff's rules and its formatter
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/.dev ## let ruff mend what lint finds
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/.dev ## mypy, strict
	$(BIN)/mypy

# --- notebooks ---

notebooks: $(if $(NOTEBOOKS),$(VENV)/.notebooks) ## execute the notebooks and write them
	$(if $(NOTEBOOKS),$(BIN)/python $(NOTEBOOKS) $(ARGS),@echo "no notebooks yet")

notebooks-check: $(if $(NOTEBOOKS),$(VENV)/.notebooks) ## fail if a notebook is stale or broken
	$(if $(NOTEBOOKS),$(BIN)/python $(NOTEBOOKS) --check $(ARGS),@echo "no notebooks yet")

book: $(if $(NOTEBOOKS),$(VENV)/.notebooks) ## the notebooks as a web book that works offline
	$(if $(NOTEBOOKS),$(BIN)/python $(NOTEBOOKS) --book $(ARGS),@echo "no notebooks yet")

# What needs a browser is skipped, with the reason, where there is no Chromium or no chromedriver.
book-check: $(VENV)/.browser ## open the book in a browser: no error, sliders move, nothing is fetched
	$(BIN)/python -m pytest tests/test_book.py -rs $(ARGS)

# --- slow ones, not part of the checks above ---

bench: $(if $(BENCHMARKS),$(VENV)/.benchmarks) ## time our solvers beside others
	$(if $(BENCHMARKS),set -e; for script in $(BENCHMARKS); do $(BIN)/python $$script $(ARGS); done,@echo "no benchmarks yet")

mutation: export HYPOTHESIS_PROFILE = mutation
mutation: $(VENV)/.dev ## plant mistakes and count those that tests catch (hours; ARGS="'*[37]'": a fifth)
	$(BIN)/mutmut run $(ARGS)
	@$(MAKE) --no-print-directory mutation-score

# A mutant that makes a test hang counts as caught; `mutmut results` lists the survivors.
mutation-score: $(VENV)/.dev ## the score of the mutants tested so far, by module
	@$(BIN)/mutmut results --all true | awk -F '[.:] *' '\
		NF == 3 && $$3 != "not checked" { sub(/^ +/, "", $$1); all[$$1]++; \
			caught[$$1] += ($$3 == "killed" || $$3 == "timeout") } \
		END { for (m in all) printf "%-12s %5d mutants, %5d caught: %.1f%%\n", m, all[m], caught[m], 100 * caught[m] / all[m] }'

# Needs Python 3.11 or 3.12: NumPy 2.0 has no wheel for later ones.
test-oldest: $(OLDEST)/.dev ## the tests with the oldest supported NumPy, SciPy and Matplotlib
	$(OLDEST)/bin/python -m pytest $(ARGS)

$(OLDEST)/.dev: pyproject.toml
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip install --quiet --editable '.[dev]' \
		'numpy==2.0.*' 'scipy==1.13.*' 'matplotlib==3.9.*' 'tqdm==4.66.*'
	@touch $@

clean: ## remove all that was made: both environments, figures, book, caches
	rm -rf $(VENV) $(OLDEST) figures book build mutants htmlcov .coverage .coverage.* *.egg-info \
		.hypothesis .pytest_cache .mypy_cache .ruff_cache __pycache__ */__pycache__

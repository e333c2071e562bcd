# make demo   environment, install, one log processed, and what came of it
# make view   that result in the viewer
# make test   lint, types and tests, as .ci/run does
# make docs   the documentation as a web site, in site/
# make clean  the environment and everything built
#
# PYTHON chooses the interpreter (3.11 or later), VENV where the environment goes.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
SAMPLE := sample_data/two_people_crossing.mcap
RESULT := $(SAMPLE:.mcap=.hiros.mcap)
CODE   := hiros_mcap cli schemas viewer tests benchmarks docs
# On a terminal pip shows what it downloads, elsewhere only what goes wrong.
INSTALL = $(BIN)/python -m pip install --disable-pip-version-check $(if $(MAKE_TERMERR),,--quiet)
# Says each minute that what follows goes on: pip is silent while it unpacks. Ends with it.
EACH_MINUTE = @n=0; while sleep 60 >/dev/null 2>&1; do n=$$((n+1)); echo "still installing after $$n min" >&2; done & \
	  minutes=$$!; trap "kill $$minutes" EXIT;

.PHONY: demo view test lint types tests docs format dist clean

demo: $(VENV)/.installed
	$(BIN)/hiros process $(SAMPLE)
	@printf '\nlook at it with\n    $(BIN)/hiros view $(RESULT)\n'

view: $(RESULT)
	$(BIN)/hiros view $(RESULT)

$(RESULT):
	@$(MAKE) --no-print-directory demo

# Side by side: mypy uses one core.
test: lint
	@$(MAKE) --no-print-directory -j2 types tests

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)

types: $(VENV)/.installed-dev
	$(BIN)/mypy

tests: $(VENV)/.installed-dev
	$(BIN)/hiros warmup
	$(BIN)/pytest -n auto --dist worksteal --durations 15

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "open site/index.html"

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/ruff format $(CODE)

dist: $(VENV)/.installed-build
	$(BIN)/python -m build

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "hiros needs Python 3.11 or later; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || echo missing)." >&2; \
	  echo "Name another one: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { \
	  echo "Python could not make an environment; on Debian and Ubuntu: apt install python3-venv" >&2; \
	  rm -rf $(VENV); exit 1; }

$(VENV)/.installed: $(BIN)/python pyproject.toml
	@echo "1/2 installing hiros and its libraries into $(VENV): 1.3 GB, 3 to 15 minutes; half of it is for viewer and plots"
	$(EACH_MINUTE) $(INSTALL) -e .
	@echo "2/2 compiling the kernels for this machine, once"
	$(BIN)/hiros warmup
	@touch $@

$(VENV)/.installed-dev: $(BIN)/python pyproject.toml
	@echo "installing hiros and the development tools into $(VENV): 2.6 GB, 5 to 20 minutes"
	$(EACH_MINUTE) $(INSTALL) -e '.[dev]'
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-build: $(BIN)/python
	$(EACH_MINUTE) $(INSTALL) 'build>=1.2'
	@touch $@

$(VENV)/.installed-docs: $(BIN)/python pyproject.toml
	@echo "installing hiros and the tools for the site into $(VENV)"
	$(EACH_MINUTE) $(INSTALL) -e '.[docs]'
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) site dist build .mypy_cache .pytest_cache .ruff_cache .hypothesis

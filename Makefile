# Each target sets up what it needs on a fresh machine. PYTHON=python3.12 chooses another interpreter, VENV another folder
# for the environment.
PYTHON ?= python3
VENV ?= .venv
BENCH := $(VENV)/bin/wbc-bench
# Episodes of each of the 3 replicates in `make ablation`: minutes on two cores with all controllers of the study.
EPISODES ?= 50

.PHONY: ablation ablation-full reach rebuild test lint bench docs ci

ablation: $(VENV)/installed  ## live, EPISODES x 3 episodes per controller, into build/ablation
	$(BENCH) ablation --replicates 3 --episodes $(EPISODES) --out build/ablation

ablation-full: $(VENV)/installed  ## live, all 3 x 1000 episodes per controller; resumes when interrupted
	$(BENCH) ablation --replicates 3 --out build/ablation-full

reach: $(VENV)/installed  ## live, the vertical reach of the IK controller; resumes when interrupted
	$(BENCH) reach --controller ik --out build/reach

rebuild: $(VENV)/installed  ## every table, figure and the report, from the committed records
	$(BENCH) report --results results

test: $(VENV)/installed
	$(VENV)/bin/python -m pytest

lint: $(VENV)/installed
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check . && $(VENV)/bin/pyright

bench: $(VENV)/installed  ## solve time of the IK controller beside other packages
	$(BENCH) bench

docs: $(VENV)/installed  ## the documentation, into site/
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict

ci:
	PYTHON=$(PYTHON) .ci/run

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV) && $(VENV)/bin/pip install -q -c constraints.txt -e '.[test,bench,docs]' && touch $@

# Each target sets up what it needs on a fresh machine. PYTHON=python3.12 chooses another interpreter.
PYTHON ?= python3
BENCH := .venv/bin/wbc-bench
# Episodes of each of the 3 replicates in `make ablation`: minutes on two cores with all four controllers.
EPISODES ?= 50

.PHONY: ablation ablation-full reach rebuild test lint bench docs ci

ablation: .venv/installed  ## live, EPISODES x 3 episodes a controller, into build/ablation
	$(BENCH) ablation --seeds 3 --episodes $(EPISODES) --out build/ablation

ablation-full: .venv/installed  ## live, all 3 x 1000 episodes a controller; resumes when interrupted
	$(BENCH) ablation --seeds 3 --out build/ablation-full

reach: .venv/installed  ## live, the vertical reach of the IK controller; resumes when interrupted
	$(BENCH) reach --controller ik --out build/reach

rebuild: .venv/installed  ## every table, figure and the report, from the committed records
	$(BENCH) report --results results

test: .venv/installed
	.venv/bin/python -m pytest

lint: .venv/installed
	.venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/pyright

bench: .venv/installed  ## solve time of the IK controller beside other packages
	$(BENCH) bench

docs: .venv/installed  ## the documentation, into site/
	.venv/bin/mkdocs build --strict

ci:
	PYTHON=$(PYTHON) .ci/run

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv && .venv/bin/pip install -q -c constraints.txt -e '.[test,bench,docs]' && touch $@

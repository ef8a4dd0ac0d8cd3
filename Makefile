# Every target sets up what it needs; `make` alone lists them.
#   make evaluate AGENT=random ARGS="--quick"
#   make test ARGS="-k laws"
.DEFAULT_GOAL := help
.PHONY: help setup docs evaluate test test-long test-rllib test-benchmarl lint format leaderboard bench bench-peers golden freeze clean

BIN := .venv/bin
READY := .venv/.ready
READY_FOR_TESTS := .venv/.tests-ready
READY_FOR_DOCS := .venv/.docs-ready
CORES ?= $(shell nproc)
AGENT ?= mappo_minhealth
ARGS ?=

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 16

setup: $(READY) ## virtual environment, pinned packages, libraries for video

$(READY): pyproject.toml constraints.txt scripts/setup.sh
	scripts/setup.sh

$(READY_FOR_TESTS): $(READY) scripts/setup.sh
	scripts/setup.sh --tests

$(READY_FOR_DOCS): $(READY) scripts/setup.sh
	scripts/setup.sh --docs

docs: $(READY_FOR_DOCS) ## the documentation site, in build/site; ARGS="serve" shows it while you write
	NO_MKDOCS_2_WARNING=1 DISABLE_MKDOCS_2_WARNING=true $(BIN)/mkdocs $(or $(ARGS),build)

evaluate: $(READY) ## score an agent on the standard suite, with films
	$(BIN)/hipg-bench evaluate --agent $(AGENT) $(ARGS)

test: $(READY) $(READY_FOR_TESTS) ## the tests, some minutes, on all cores; says what was skipped and why
	$(BIN)/pytest -n $(CORES) --dist loadscope $(ARGS)

test-rllib: ## the RLlib adapter, in an environment of its own
	scripts/test_beside.sh rllib $(ARGS)

test-benchmarl: ## the BenchMARL plug-in, in an environment of its own
	scripts/test_beside.sh benchmarl $(ARGS)

lint: $(READY) ## style, types, layers, spelling
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	$(BIN)/codespell -D - -D scripts/old_words.txt

format: $(READY) ## fix style automatically
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

leaderboard: $(READY) ## write the page of leaderboard/ to site/
	$(BIN)/hipg-bench leaderboard build --out site $(ARGS)

bench: $(READY) ## speed and memory, beside what bounds them; ARGS="--full --plot speed.png" for all of it
	$(BIN)/hipg-bench bench $(ARGS)

bench-peers: $(READY) ## our speed beside VMAS, JaxMARL, PettingZoo, MaMuJoCo and TorchRL, in .venv-peers
	scripts/bench_peers.sh $(ARGS)

test-long: $(READY) ## what takes long: evaluations killed twenty times, whole suites twice
	$(BIN)/pytest -m long $(ARGS)

freeze: $(READY) ## after a wanted change: the golden episodes must hold, then the suite version is frozen again
	$(BIN)/pytest tests/test_golden.py --strict-golden
	$(BIN)/hipg-bench suite freeze

golden: $(READY) ## record the golden episodes again, after a wanted change of behaviour
	$(BIN)/pytest tests/test_golden.py --record-golden

clean: ## remove caches and builds; the virtual environment and runs/ stay
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis .benchmarks .import_linter_cache
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +

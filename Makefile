# `make help` lists the targets. Everything goes into .venv, what builds the documentation into .venv-docs, and the tests'
# browser where scripts/need_browser.sh puts it.

PYTHON ?= python3
PORT ?= 5006
VENV := .venv
BIN := $(VENV)/bin

# One BLAS thread: at the sizes of the observers two are slower.
export OPENBLAS_NUM_THREADS ?= 1
# Bytecode is kept: the tests start hundreds of processes, each of which would compile all modules first.
unexport PYTHONDONTWRITEBYTECODE
# Without this, pyright asks for its newest version at each start.
export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1

# Stamps carry the checksum of what they were made from, so that nothing runs twice and no change is missed.
# An environment works in one place only, so that the place counts as well.
PLACE := $(firstword $(shell echo "$(CURDIR)" | cksum))
PINS := $(PLACE)-$(firstword $(shell cat pyproject.toml packages/*/pyproject.toml requirements*.txt | cksum))
MADE := $(VENV)/.made-$(PLACE)
RUN := $(VENV)/.run-$(PINS)
TEST := $(VENV)/.test-$(PINS)
BENCH := $(VENV)/.bench-$(PINS)
DOCS := $(VENV)-docs/.docs-$(PINS)
PEERS := pyrtc hcipy
# A browser waits as often as it computes.
BROWSERS := $(shell echo $$(($$(nproc) * 3 / 2)))

# $(call install,requirements[,packages]): these pins and the project itself with its packages, editable; stamps of other pins go.
define install
@echo "Installing $(1) in $(VENV) ..."
@find $(VENV) -maxdepth 1 -name '.[rtb]*-*' ! -name '*-$(PINS)' -delete
@$(PIP) install --quiet -r $(1)
@$(PIP) install --quiet --no-build-isolation --no-deps --editable . $(2:%=--editable packages/%)
@$(PIP) check
@touch $@ $(RUN)
endef
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: help run test setup check wheel wheel-check load container-check bench docs notebooks clean test-fast test-peers

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*##/\1\t/p' Makefile

run: $(RUN)  ## serve the dashboard on localhost:5006 (another port: make run PORT=5007)
	@$(BIN)/wfsobs serve --port $(PORT)

test: setup  ## run all tests, then those in a browser
	@status=0; \
	$(BIN)/python -m pytest -n auto --dist worksteal || status=1; \
	$(BIN)/python -m pytest -n $(BROWSERS) --dist loadfile --no-loadscope-reorder tests/browser || status=1; \
	exit $$status

test-fast: $(TEST)  ## the quick tests alone: no dashboard, no report, none marked as slow
	@$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow" tests wfsobs packages --ignore=tests/app --ignore=tests/report --ignore=wfsobs/app

test-peers: $(PEERS:%=test-peer-%)  ## run the tests in pyRTC and HCIPy, each in an environment of its own (make test-peer-specula, test-peer-oopao, test-peer-soapy: in those)

test-peer-%: $(VENV)-%/.made-$(PINS)
	@$(VENV)-$*/bin/python -m pytest tests/peers/test_$*.py

setup: $(TEST)  ## install all that the tests need, the browser included
	@scripts/need_browser.sh $(VENV)

check: $(TEST)  ## ruff, pyright, names, the walls between the rooms, circles, calls that go up, and how much is typed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python scripts/check_names.py
	$(BIN)/pyright
	$(BIN)/lint-imports --no-logo --no-cache
	$(BIN)/python scripts/count_circles.py
	$(BIN)/python scripts/count_jumps.py
	$(BIN)/python scripts/check_types.py

wheel: $(TEST)  ## build dist/*.tar.gz, and from it dist/*.whl
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist

wheel-check: wheel  ## install that wheel in an empty environment elsewhere; build it from a zip, a clone without links and the sdist
	scripts/check_sources.sh $(BIN)/python
	scripts/check_wheel.sh "$(PYTHON)" dist/*.whl

load: $(TEST)  ## a load and abuse run against the served dashboard, about four minutes
	$(BIN)/python scripts/load.py

container-check:  ## run the steps of the Dockerfile in an empty environment, without a container
	scripts/prove_dockerfile.sh "$(PYTHON)"

bench: $(BENCH)  ## time the observers, and compare them with other libraries
	$(BIN)/python -m benchmarks

docs: $(DOCS)  ## build this documentation in build/site, its notebooks run
	PYTHONPATH=. $(VENV)-docs/bin/properdocs build --strict --quiet --config-file mkdocs.yml
	$(VENV)-docs/bin/python docs/scripts/check_site.py build/site

notebooks: $(VENV)-notebooks/.made-$(PINS)  ## open the tutorials in JupyterLab
	PYTHONPATH=. $(VENV)-notebooks/bin/python -m jupyterlab docs/tutorials

clean:  ## remove .venv and all that was built
	rm -rf $(VENV) $(VENV)-* build dist *.egg-info .pytest_cache .ruff_cache .hypothesis test-output
	find docs packages scripts tests wfsobs -name __pycache__ -prune -exec rm -rf {} +

$(MADE):
	@scripts/make_venv.sh "$(PYTHON)" $(VENV)
	@touch $@

$(RUN): | $(MADE)
	$(call install,requirements.txt)

$(TEST): | $(MADE)
	$(call install,requirements-test.txt,wfsobs-arena)

$(BENCH): | $(MADE)
	$(call install,requirements-bench.txt)

.PRECIOUS: $(VENV)-%/.made-$(PINS)
$(VENV)-%/.made-$(PINS):
	@echo "Installing requirements-$*.txt in $(VENV)-$* ..."
	@scripts/make_venv.sh "$(PYTHON)" $(VENV)-$*
	@$(VENV)-$*/bin/python -m pip --disable-pip-version-check install --quiet -r requirements-$*.txt
	@touch $@

$(DOCS):
	@echo "Installing requirements-docs.txt in $(VENV)-docs ..."
	@scripts/make_venv.sh "$(PYTHON)" $(VENV)-docs
	@$(VENV)-docs/bin/python -m pip --disable-pip-version-check install --quiet -r requirements-docs.txt
	@touch $@

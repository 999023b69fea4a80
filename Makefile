# Everything starts here; nothing is needed but python3 (3.11 or newer) and make.
#   make demo    set up and run the demonstration       make test    set up and run the tests
#   make lint    style, formatting, types, security     make docs-check    run the commands of the documents
#   make docs    set up and build the documentation as a site, into out/site
#   make test-fast PART=maps    the quick tests of one folder of tests/, or of one file
#   make mutants PART=maps      do the tests of a part notice 200 small changes? about an hour
#   make bench   compare with the committed baseline    make clean   remove what make made
#   make browser    a Chromium, for the tests of the server's page, which are skipped without one
#   make experiments    whole experiments, most on the recordings in ../shared/data, minutes long
#   make results    compute docs/results.md and its pages again, about a day in the background; goes on where it was ended
# Use another interpreter or folder with `make PYTHON=python3.12 VENV=/somewhere/venv test`.
PYTHON ?= python3
VENV ?= .venv
OUT ?= out/demo
# Tests run in this many processes, up to six: one a core, and one more, since tests of servers and of live wires wait an
# eighth of the time. One that is done takes tests from the others. Each begins with its own part of the folders, so that
# few wait for a kernel that another one compiles. Matrices are small: more threads of BLAS than cores only wait.
# Bytecode is kept even where the environment switches it off, as images of Python do: without it every process would
# compile our modules and rewrite the assertions of all tests again.
PROCESSES ?= $(shell n=$$(($$(nproc 2>/dev/null || echo 2) + 1)); echo $$((n > 6 ? 6 : n)))
PYTEST = PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(VENV)/bin/python -m pytest --numprocesses $(PROCESSES) --dist worksteal
BYTECODE ?= --compile
PIP_INSTALL = $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check $(BYTECODE)
# uv unpacks packages beside each other, in a quarter of pip's time or less. It asks the index that pip is told to ask;
# where pip finds no uv, or uv does not get what it is asked for, pip installs.
UV_INSTALL = test -x $(VENV)/bin/uv && UV_DEFAULT_INDEX="$${PIP_INDEX_URL:-$$($(VENV)/bin/python -m pip config get global.index-url 2>/dev/null)}" \
  UV_HTTP_TIMEOUT=20 UV_HTTP_RETRIES=1 $(VENV)/bin/uv pip install --quiet --no-config --python $(VENV)/bin/python $(BYTECODE)
install = { $(UV_INSTALL) $(1) 2>$(VENV)/uv.txt; } || $(PIP_INSTALL) $(1)
RUNTIME = $(VENV)/.stamp-runtime
DEVELOPMENT = $(VENV)/.stamp-development
DOCUMENTATION = $(VENV)/.stamp-documentation

.DEFAULT_GOAL := help
.PHONY: help setup setup-dev demo browser chromium test test-fast mutants test-slow test-all experiments results lint audit format docs docs-check bench lock clean

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | head -n 11

setup: $(RUNTIME)
setup-dev: $(DEVELOPMENT)

demo: $(RUNTIME)
	$(VENV)/bin/evermap demo --out $(OUT) --force

test: $(DEVELOPMENT)
	$(PYTEST)

PART ?= maps
test-fast: $(DEVELOPMENT)
	$(PYTEST) tests/$(PART:tests/%=%)

mutants: $(DEVELOPMENT)
	$(VENV)/bin/python -m benchmarks.mutants $(PART)

# A browser and axe-core, for tests/server/test_page.py; where we may not install one, it says how.
browser: chromium $(DEVELOPMENT)
	@$(VENV)/bin/python -m pip download --quiet --disable-pip-version-check --no-deps --dest out/browser axe-playwright-python==0.1.8
	@$(VENV)/bin/python -m zipfile --extract out/browser/axe_playwright_python-0.1.8-*.whl out/browser

# not beside an installation of python3-venv: dpkg serves one at a time
chromium: | $(VENV)/bin/python
	@command -v chromium-headless-shell >/dev/null || command -v chromium >/dev/null || command -v google-chrome >/dev/null \
	  || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
	       && echo "installing chromium-headless-shell" && apt-get -qq -o Acquire::Retries=0 -o Acquire::http::Timeout=20 update >/dev/null \
	       && DEBIAN_FRONTEND=noninteractive apt-get -qq install --yes --no-install-recommends chromium-headless-shell >/dev/null; } \
	  || { echo "the tests of the page need a Chromium; on Debian: sudo apt-get install chromium-headless-shell" >&2; exit 1; }

# What is slow, but for whole experiments.
test-slow: $(DEVELOPMENT)
	$(PYTEST) -m "slow and not experiment" --durations=8

test-all: $(DEVELOPMENT)
	$(PYTEST) -m "slow or not slow" --hypothesis-profile=whole

experiments: $(DEVELOPMENT)
	$(VENV)/bin/python -m pytest -m experiment

# One study after the other at the lowest priority, with the commands of their pages; what is done is in out/results, and
# is not run again until that folder is removed.
results: $(DEVELOPMENT)
	OPENBLAS_NUM_THREADS=1 nice -n 19 $(VENV)/bin/python docs/gen/results.py --all out/results

lint: $(DEVELOPMENT)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

# Known flaws of the pinned versions. Its database is in the internet, so it is no part of the continuous integration.
audit: $(DEVELOPMENT)
	@$(PIP_INSTALL) --constraint requirements-dev.lock pip-audit
	@$(VENV)/bin/pip-audit --strict --vulnerability-service osv --disable-pip --no-deps --progress-spinner off \
	  --requirement requirements-dev.lock --requirement requirements-docs.lock 2>$(VENV)/audit.txt || { \
	  grep -q ConnectionError $(VENV)/audit.txt \
	    && echo "make audit asks https://api.osv.dev for known flaws of the pinned versions: it needs the internet" >&2 \
	    || cat $(VENV)/audit.txt >&2; exit 1; }

format: $(DEVELOPMENT)
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

# Nothing is loaded from elsewhere, neither here nor by a reader: open out/site/index.html from the file system.
docs: $(RUNTIME) $(DOCUMENTATION)
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict --quiet

# What the pages tell to type, the longest first, and the notebooks; blocks that are marked as nightly are in
# `make test-slow`, all else of tests/docs is in `make test`.
docs-check: $(DEVELOPMENT)
	$(PYTEST:worksteal=load) --maxschedchunk 1 tests/docs -m "slow and not nightly"

bench: $(DEVELOPMENT)
	$(VENV)/bin/evermap bench

# A virtual environment. Debian keeps `venv` in a package of its own: install it where we may, else say so in a line.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "evermap needs Python 3.11 or newer; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) >/dev/null 2>&1 \
	  || { rm -rf $(VENV); $(PYTHON) -m virtualenv --quiet $(VENV) >/dev/null 2>&1; } \
	  || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
	       && echo "installing python3-venv" && apt-get -qq -o Acquire::Retries=0 -o Acquire::http::Timeout=20 update >/dev/null \
	       && DEBIAN_FRONTEND=noninteractive apt-get -qq install --yes python3-venv >/dev/null \
	       && rm -rf $(VENV) && $(PYTHON) -m venv $(VENV); } \
	  || { rm -rf $(VENV); echo "evermap needs Python's venv module; on Debian: sudo apt-get install python3-venv" >&2; exit 1; }
	@$(PIP_INSTALL) --only-binary :all: uv==0.13.9 2>/dev/null || true

# The lock files pin every version; the project itself is installed in place, without resolving anything.
$(RUNTIME): requirements.lock pyproject.toml studies/pyproject.toml packages/evermap-score/pyproject.toml | $(VENV)/bin/python
	@$(call install,--requirement requirements.lock)
	@$(call install,--no-deps --no-build-isolation --editable . --editable ./studies --editable ./packages/evermap-score)
	@touch $@

$(DEVELOPMENT): requirements-dev.lock pyproject.toml studies/pyproject.toml packages/evermap-score/pyproject.toml | $(VENV)/bin/python
	@$(call install,--requirement requirements-dev.lock)
	@$(call install,--no-deps --no-build-isolation --editable . --editable ./studies --editable ./packages/evermap-score)
	@touch $(RUNTIME) $@

$(DOCUMENTATION): requirements-docs.lock | $(VENV)/bin/python
	@$(call install,--requirement requirements-docs.lock)
	@touch $@

# For maintainers: renew the pins, under the oldest Python that users have (Debian's 3.11.2), which newer packages may
# refuse. Index addresses are kept out of the files: they are the machine's business.
# evermap itself, which the studies need, is in no index
COMPILE = PIP_FIND_LINKS=$(VENV)/wheels $(VENV)/bin/pip-compile --unsafe-package evermap --quiet --upgrade --strip-extras --no-header --annotation-style=line \
          --no-emit-index-url --no-emit-find-links --no-emit-trusted-host
lock: $(DEVELOPMENT)
	$(PIP_INSTALL) pip-tools
	$(VENV)/bin/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir $(VENV)/wheels .
	$(COMPILE) --extra rerun --extra ros --extra live --extra server --extra cluster --extra dev --build-deps-for editable --output-file requirements-dev.lock pyproject.toml studies/pyproject.toml
	$(COMPILE) --extra rerun --extra ros --extra live --extra server --build-deps-for editable --constraint requirements-dev.lock --output-file requirements.lock pyproject.toml studies/pyproject.toml
	$(VENV)/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"], sep="\n")' \
	  | $(COMPILE) --constraint requirements-dev.lock --output-file requirements-docs.lock -

clean:
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src studies packages tests -name __pycache__ -type d -prune -exec rm -rf {} +

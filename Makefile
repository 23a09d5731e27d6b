# lumiloop: every job a person or a CI machine does, by name. `make help` lists them.
# System packages (Debian/Ubuntu): python3 (>= 3.11) python3-venv make

# A distribution's own interpreter is built with profile-guided optimisation; one that pyenv compiled is not, and costs
# the daemon a third more of the processor. Nor is one in a home folder seen by a hardened service.
GOOD   := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for p in /usr/bin/python3 python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c '$(GOOD)' 2>/dev/null && echo $$p && exit; done; echo python3)
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.dev-stamp
PEERS  := $(VENV)/.bench-stamp
SITE   := $(VENV)/.docs-stamp
RUN    := $(BIN)/python -W default

.DEFAULT_GOAL := help

# Asserts rewritten by pytest are kept as bytecode, or each of five suites rewrites 400 files anew: 20 s each.
unexport PYTHONDONTWRITEBYTECODE

# Suites share the processors, and what is judged against the wall clock wants them alone: no two at once, -j or not.
.NOTPARALLEL:

.PHONY: help venv demo check quick test cover test-system test-all bless hooks bench bench-vm experiments install uninstall deb lock docs clean fuzz slowest soak soak-hour arm

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

$(STAMP): requirements/dev.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "lumiloop needs Python >= 3.11; set PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "the venv module is missing: apt-get install python3-venv"; exit 1; }
	@echo "installing the locked packages into $(VENV); this takes about a minute"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

venv: $(STAMP)  ## make .venv with everything at the locked versions

demo: venv  ## the daemon on a simulated robot under coded lamps; each sensor fails once; results in out/demo
	$(RUN) -m tools.demo $(ARGS)

.PHONY: pictures
pictures: venv  ## the README's picture and animation, from simulated drives in virtual time (a few minutes)
	$(RUN) -m tools.docs.drives $(ARGS)

check: venv  ## formatting, lint, strict types
	$(BIN)/ruff format --check --quiet .
	$(BIN)/ruff check --quiet .
	$(BIN)/mypy

QUICK := not slow and not system
quick: venv  ## the tests that directly import what has changed since main (<= 60 s; ARGS=--list only names them)
	$(RUN) -m tools.ci.quick --marks "$(QUICK)" $(ARGS)

test: venv  ## everything quick (no root, <= 12 minutes)
	@$(BIN)/python -c "from daemon.runtime.warmup import load; load()" & warm=$$!; trap "kill $$warm" INT TERM; \
	$(MAKE) --no-print-directory check; checked=$$?; wait $$warm && exit $$checked  # each keeps one processor busy
	$(BIN)/python -m pytest -q -n auto --dist loadfile -m "$(QUICK)" $(ARGS)

# Compiled kernels are invisible to coverage, so the estimator is also run without the compiler, beside the compiling;
# that row is silent unless it fails. Of the rest only what is traced (tests/conftest.py) is run once more.
COVER := $(BIN)/python -m coverage
cover: venv  ## the floors of coverage, and the estimator without the compiler
	@mkdir -p out; rm -f .coverage .coverage.* out/plain.coverage
	@NUMBA_DISABLE_JIT=1 $(COVER) run --data-file=out/plain.coverage -m pytest -q -p no:cacheprovider \
		-m "not jit and $(QUICK)" tests/estimator > out/plain.txt 2>&1 & plain=$$!; trap "kill $$plain" INT TERM; \
	$(BIN)/python -c "from daemon.runtime.warmup import load; load()" && \
	$(BIN)/python -m pytest -q -n auto --dist loadfile --cov --cov-report= -m "$(QUICK) and not no_cover"; tests=$$?; \
	wait $$plain; plain=$$?; echo "the estimator without the compiler:"; \
	if [ $$plain = 0 ]; then grep -h " passed" out/plain.txt; else cat out/plain.txt; fi; \
	exit $$(( tests || plain ))
	@$(COVER) combine -q --append out/plain.coverage
	$(BIN)/python -m tools.ci.floors

# What is judged against the wall clock has the machine to itself. ARGS may choose none of one half (5).
ORDERLY := system and not slow
# Only files with such tests are read, unless ARGS names others.
ONLY_IN = $(if $(findstring tests/,$(ARGS)),,$$(grep -rlE 'mark\.(system|realtime)|"(system|realtime)"' tests --include='test_*.py' | sort))
NONE = $(if $(ARGS),|| [ $$? = 5 ])
test-system: venv  ## real processes, real ttys, real time, fault and fuzz samples (root, <= 20 minutes)
	$(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder -m "$(ORDERLY) and not realtime" $(ONLY_IN) $(ARGS) $(NONE)
	$(BIN)/python -m pytest -q -m "$(ORDERLY) and realtime" $(ONLY_IN) $(ARGS) $(NONE)

LONG = $(BIN)/python -m pytest -q --durations=15
test-all: test cover test-system  ## all of it, the long ones included (root, about three quarters of an hour)
	$(LONG) -n auto --dist load -m "slow and not realtime" $(ARGS) $(NONE)
	$(LONG) -m "slow and realtime" $(ARGS) $(NONE)

bless: venv  ## make today's trajectories the golden ones: REASON="why they have changed", ARGS="NAME ..." for some logs
	@test -n "$$REASON" || { echo 'say why the trajectories have changed: make bless REASON="..."'; exit 1; }
	$(RUN) -m tests.logs.bless --reason "$$REASON" $(ARGS)

.PHONY: power-cuts
power-cuts: venv  ## 120 power cuts on a block device in starts, saves and an upgrade (root; ARGS="24": so many)
	$(RUN) -m tests.faults.power $(ARGS)

hooks: venv  ## run the checks of `make check` before each commit (git hook of pre-commit)
	$(BIN)/pre-commit install

$(PEERS): $(STAMP) requirements/bench.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/bench.lock
	@touch $@

bench: $(PEERS)  ## figures as a table and as out/bench/*.json, ratios against peers in the same run
	$(RUN) -m tools.bench $(ARGS)

bench-vm: venv  ## the package in an emulated Debian with real kernel interfaces (root for the first run; docs/bench.md)
	$(RUN) -m tools.bench.vm $(ARGS)

# `make test` plays the same examples every time; here each run searches others.
PROPERTIES = $$(grep -rl 'from hypothesis' tests --include='test_*.py' | grep -v tests/fuzz/test_parsers.py | sort)
fuzz: venv  ## damaged bytes to every parser, a tenth of the full size, and new examples for every property (ARGS="-m slow", "-k log")
	$(BIN)/python -m pytest -q tests/fuzz/test_parsers.py -m "not slow" $(ARGS) $(NONE)
	$(BIN)/python -m pytest -q -n auto --dist loadfile --hypothesis-profile=search -m "$(QUICK)" $(PROPERTIES) $(ARGS) $(NONE)

.PHONY: fuzz-together
fuzz-together: venv  ## a minute of damage at every port, socket and line of the real processes at once (ARGS="600": ten)
	$(RUN) -m tests.fuzz.together $(ARGS)

slowest: venv  ## the slowest tests of `make test`, and why they are slow (ARGS="tests/daemon")
	$(BIN)/python -m pytest -q -n auto --dist loadfile -p tools.ci.slowest -m "$(QUICK)" $(ARGS)

soak: venv  ## a simulated day, or ARGS="--days 30": do memory, threads, descriptors, files or cycle times grow?
	$(RUN) -m tools.soak $(ARGS)

soak-hour: venv  ## the same of the real processes at 40 Hz, for an hour (ARGS="--real 240": four)
	$(RUN) -m tools.soak --real 60 $(ARGS)

arm: venv  ## kernels and decoder for 64-bit ARM under qemu: the same numbers? (qemu-user-static, mmdebstrap)
	$(RUN) -m tools.bench.system.aarch64 $(ARGS)

experiments: venv  ## every figure and table of the paper and ours into docs/results (recordings: LUMILOOP_DATA)
	$(RUN) -m tools.experiments $(ARGS)

$(SITE): $(STAMP) requirements/docs.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/docs.lock
	@touch $@

docs: $(SITE)  ## regenerate the pages that come from code, and build the site: out/site/index.html
	$(RUN) -m daemon.publish.document docs
	$(RUN) -m daemon --reference > docs/configuration.md
	$(RUN) -m tools.docs.commands > docs/commands.md
	$(RUN) -m tools.docs.topics > docs/topics.md
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean
	@echo "open out/site/index.html"

install:  ## into /opt/lumiloop with its units, rules and example configuration (root; DESTDIR=, PREFIX=, PYTHON=)
	systemd/install.sh install

uninstall:  ## remove that; configuration and maps stay unless PURGE=1
	systemd/install.sh uninstall

deb:  ## the same as two Debian packages, in out/: lumiloop and lumiloop-taps
	systemd/package.sh

EXTRAS  := --extra plot --extra images --extra mcap --extra foxglove --extra view --extra zenoh
COMPILE := uv pip compile --universal --python-version 3.11 --generate-hashes --no-header --no-annotate --no-strip-extras --quiet --upgrade
lock:  ## renew the lock files (needs uv)
	$(COMPILE) pyproject.toml -o requirements/core.lock
	$(COMPILE) --allow-unsafe $(EXTRAS) --group dev pyproject.toml -o requirements/dev.lock
	$(COMPILE) --allow-unsafe $(EXTRAS) --group dev --group bench pyproject.toml -o requirements/bench.lock
	$(COMPILE) -c requirements/dev.lock --group docs -o requirements/docs.lock

clean:  ## remove what the targets above made
	rm -rf $(VENV) out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

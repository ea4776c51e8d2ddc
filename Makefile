# Every target sets up what it needs in .venv; a second run installs nothing.

PYTHON ?= $(firstword $(foreach name,python3 python3.14 python3.13 python3.12 python3.11,\
	$(shell $(name) -c 'import sys; sys.version_info >= (3, 11) and print("$(name)")' 2>/dev/null)))
POLICY := policies/lpac_l2_k3_n10_512
# Tests start hundreds of programs: each would compile all that it loads.
unexport PYTHONDONTWRITEBYTECODE
RUN := .venv/bin/python -m

.PHONY: help demo fly setup check check-lowest test redteam lint hooks bench docs export image lock \
	deploy start stop status fleet-demo screenshots clean
.DEFAULT_GOAL := help

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' Makefile

demo: .venv/sim ## ten robots cover an unknown world: out/demo/demo.png (no torch needed)
	.venv/bin/lpac demo --out out/demo

fly: .venv/sim ## ten robot programs, or as many as this machine carries, fly simulated PX4s: out/fly/flight.png
	.venv/bin/lpac sim --vehicle mavlink --seed 5 --duration 50 --out out/fly

setup: .venv/sim .venv/export .venv/fleet .venv/ground .venv/foxglove ## install what a workstation needs: simulator, plots, torch, onnx, deployment, ground control, Foxglove

# Files that take long come first; tests of one file share what they fly.
BY_FILE := --dist loadfile --no-loadscope-reorder
QUICK := --numprocesses auto $(BY_FILE) tests/sim tests/unit
check: lint ## style, types, and the quick tests: what a commit has to pass, in two and a half minutes on two cores
	.venv/bin/pytest $(QUICK) -m 'not slow'

LOWEST := out/lowest
# Old releases warn of what their own dependencies have deprecated since.
check-lowest: $(LOWEST)/installed ## unit and sim tests with Python 3.11 and the lowest versions that pyproject.toml allows
	$(LOWEST)/bin/pytest -W ignore::DeprecationWarning $(QUICK)

test: .venv/test ## style, types, and every test; as root with real robot hosts too: 19 minutes on two cores
	@$(RUN) tests.quiet
	@$(MAKE) --no-print-directory lint
	@tests/all.sh $(BY_FILE)

redteam: .venv/test ## attacks on a fleet with keys and on one without: docs/security.md, "Attacks that were tried"
	.venv/bin/pytest -v --tries 1000 tests/sim/ground/test_attacks.py tests/process/sim/test_attacks.py \
		tests/sim/ground/test_late.py tests/process/drivers/test_zenoh_link.py \
		tests/process/drivers/test_multicast.py tests/process/cli/test_enemy_files.py tests/unit/identity tests/unit/messages \
		tests/unit/core/test_lateness.py

lint: .venv/test ## style, and strict types of the product and its tests
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy --num-workers auto

hooks: .venv/test ## each git commit then checks style and types of what it holds
	.venv/bin/pre-commit install

bench: .venv/test ## measure against torch: a table, and out/bench/*.json
	$(RUN) bench

docs: .venv/docs ## the documentation as a site, with its reference: out/site/index.html
	$(RUN) handbook

export: .venv/export ## rebuild the shipped policy's bundle from its checkpoint
	.venv/bin/lpac export $(POLICY).pt --params $(POLICY).toml -o $(POLICY)

ARCH ?= arm64
image: | .venv/bin/pip ## the robot's image for ARM (or ARCH=amd64), and its size: out/image
	@deploy/docker/image.sh $(ARCH)
	@cd out/image && du -sh --apparent-size $(ARCH)/root lpac-edge-$(ARCH).tar.gz && \
		du -h -d1 --apparent-size $(ARCH)/root/usr/lib/python3/dist-packages | sort -rh | head -n 9
	@! command -v systemd-analyze > /dev/null || \
		systemd-analyze security --offline=yes systemd/lpac-robot.service | tail -n 1

LOCK := .venv/bin/uv pip compile --quiet --python-version 3.11 --generate-hashes \
	--python-platform aarch64-manylinux_2_28 --only-binary :all: --upgrade \
	--custom-compile-command 'make lock'

lock: | .venv/bin/uv ## pin the image's packages to the newest versions, with their hashes
	$(LOCK) pyproject.toml --output-file deploy/docker/requirements.lock
	echo 'hatchling>=1.27' | $(LOCK) - --output-file deploy/docker/build.lock
	.venv/bin/python deploy/docker/lock_debian.py

FLEET ?= $(or $(LPAC_FLEET),fleet.toml)
deploy: .venv/fleet ## image, policy and configuration to the robots of FLEET=fleet.toml, proven there
start: .venv/fleet ## start the robots' programs
stop: .venv/fleet ## stop the robots' programs; a robot in flight refuses
status: .venv/fleet ## what each robot has, and how it is
deploy start stop status:
	@.venv/bin/lpac fleet $@ --fleet '$(FLEET)'

fleet-demo: .venv/sim .venv/fleet ## three robot computers on this machine to try it on, until Ctrl-C (root)
	@mkdir -p out
	$(if $(filter-out 0,$(shell id -u)),sudo) .venv/bin/lpac hosts -n 3 --out out/fleet-demo

screenshots: .venv/test ## the pictures of ground control in docs/, from a simulated flight (chromium): docs
	PATH="$(CURDIR)/.venv/bin:$$PATH" docs/screenshots.sh

clean: ## remove .venv and everything made
	rm -rf .venv out build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

# Stamps: .venv/EXTRA is newer than pyproject.toml when that extra is installed.
.venv/%: pyproject.toml | .venv/bin/pip
	@echo "installing what '$*' needs into .venv: this can take some minutes"
	.venv/bin/pip install --disable-pip-version-check --editable '.[$*]'
	@touch $@

# uv chooses the versions, pip installs: from where .venv has its packages, torch among them.
$(LOWEST)/installed: pyproject.toml | .venv/bin/uv
	.venv/bin/uv venv --quiet --clear --seed --python 3.11 $(LOWEST)
	.venv/bin/uv pip compile --quiet --python $(LOWEST)/bin/python --resolution lowest-direct \
		--extra test pyproject.toml --output-file $(LOWEST)/constraints.txt
	$(LOWEST)/bin/pip install --disable-pip-version-check --constraint $(LOWEST)/constraints.txt \
		--editable '.[test]'
	@touch $@

.venv/bin/uv: | .venv/bin/pip
	.venv/bin/pip install --quiet --disable-pip-version-check uv

.venv/bin/pip:
	@test -n '$(PYTHON)' || { echo 'make: Python 3.11 or newer is needed: sudo apt install python3'; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo 'make: the venv module is missing: sudo apt install python3-venv'; exit 1; }
	$(PYTHON) -m venv .venv

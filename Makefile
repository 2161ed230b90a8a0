# make demo   build everything and play an avatar of the built-in head
# make test   build everything and run the tests
# Both do all their own set-up (a virtual environment in .venv; Debian packages through apt when root) and are quick the second time.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip --disable-pip-version-check --quiet
APT_PACKAGES := g++ python3-venv python3-dev libegl1 libgl1 libgl1-mesa-dri mesa-vulkan-drivers libvulkan1 xvfb xauth
CPP := CMakeLists.txt pyproject.toml $(wildcard src/cpp/*)

.PHONY: demo test bench lint clean
.DELETE_ON_ERROR:

demo: $(VENV)/built
	$(BIN)/cap4d demo --out out

test: $(VENV)/built
	$(BIN)/python -m pytest

bench: $(VENV)/built
	$(BIN)/python -m pytest -m bench -s tests/bench

lint: $(VENV)/built
	$(BIN)/ruff check .

$(VENV)/system:
	@mkdir -p $(VENV)
	@dpkg -s $(APT_PACKAGES) >/dev/null 2>&1 || \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(APT_PACKAGES); \
	  else echo "cap4d needs these Debian packages, or your system's equals: $(APT_PACKAGES)"; fi
	@touch $@

# torch goes first and pinned: asked for as a range by another package it would become the newest CUDA build.
# mediapipe goes without its dependencies: its metadata asks for old numpy and protobuf, which it does not need.
$(VENV)/installed: pyproject.toml constraints.txt | $(VENV)/system
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' || { echo "cap4d builds with Python 3.11 or 3.12; set PYTHON=..."; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt torch
	$(PIP) install -c constraints.txt $$($(BIN)/python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; o = p["optional-dependencies"]; print(*sorted({"".join(r.split()) for r in sum((o[e] for e in ("capture", "track", "fit", "dev")), p["dependencies"]) if not r.startswith("cap4d")}))')
	$(PIP) install --no-deps -c constraints.txt mediapipe
	@touch $@

$(VENV)/built: $(VENV)/installed $(CPP)
	$(PIP) install --no-build-isolation --no-deps --editable .
	@touch $@

clean:
	rm -rf build out $(VENV)

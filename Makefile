# make demo   build everything and play an avatar of the built-in head
# make test   build everything and run the tests
# make sanitize   run what exercises the C++ under AddressSanitizer and UndefinedBehaviorSanitizer (GCC), on each instruction set
# They do all their own set-up (a virtual environment in .venv; Debian packages through apt when root) and are quick the second time.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip --disable-pip-version-check --quiet
APT_PACKAGES := g++ python3-venv python3-dev libegl1 libgl1 libgl1-mesa-dri mesa-vulkan-drivers libvulkan1 xvfb xauth
TEST_APT_PACKAGES := xdotool chromium
CPP := CMakeLists.txt pyproject.toml $(wildcard src/cpp/*)

# The C++ again with every access and every conversion checked, in an environment of its own that borrows the packages of the first.
# Python itself is not built so: the checkers are loaded before it, and its own leaks are none of our business.
SANITIZED := build/sanitize
SANITIZERS := -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all -fno-omit-frame-pointer -g -O1
SANITIZED_TESTS := $(wildcard tests/property/test_hard_*.py) $(addprefix tests/,$(addsuffix .py,property/test_splatting_gradients \
  $(addprefix parity/test_,float_answers player quantized_answers splatting) \
  $(addprefix unit/test_,avatar_bound avatar_similarity bench_floor bind fast_deformer float_unet mesh player_avatar player_tiers quantized_unet \
  raster render sort splatter synth_hair synth_studio)))

.PHONY: demo test bench lint sanitize sanitize-base sanitize-v3 sanitize-v4 sanitize-threads clean
.DELETE_ON_ERROR:

demo: $(VENV)/built
	$(BIN)/cap4d demo --out out

test: $(VENV)/built $(VENV)/test_system
	$(BIN)/python -m pytest

bench: $(VENV)/built
	$(BIN)/python -m pytest -m bench -s tests/bench

lint: $(VENV)/built
	$(BIN)/ruff check .

# What only the tests drive is left out of the demo's set-up.
$(VENV)/system: PACKAGES := $(APT_PACKAGES)
$(VENV)/test_system: PACKAGES := $(TEST_APT_PACKAGES)
$(VENV)/test_system: | $(VENV)/system
$(VENV)/system $(VENV)/test_system:
	@mkdir -p $(VENV)
	@dpkg -s $(PACKAGES) >/dev/null 2>&1 || \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(PACKAGES); \
	  else echo "cap4d needs these Debian packages, or your system's equals: $(PACKAGES)"; fi
	@touch $@

# torch goes first and pinned: asked for as a range by another package it would become the newest CUDA build.
# mediapipe goes without its dependencies: its metadata asks for old numpy and protobuf, which it does not need.
$(VENV)/installed: pyproject.toml constraints.txt | $(VENV)/system
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' || { echo "cap4d builds with Python 3.11 or 3.12; set PYTHON=..."; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -c constraints.txt torch
	$(PIP) install -c constraints.txt $$($(BIN)/python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; o = p["optional-dependencies"]; print(*sorted({"".join(r.split()) for r in sum((o[e] for e in ("live", "webcam", "capture", "track", "fit", "dev")), p["dependencies"]) if not r.startswith("cap4d")}))')
	$(PIP) install --no-deps -c constraints.txt mediapipe
	@touch $@

$(VENV)/built: $(VENV)/installed $(CPP)
	$(PIP) install --no-build-isolation --no-deps --editable .
	@touch $@

sanitize: $(SANITIZED)/built
	@$(MAKE) --no-print-directory -j2 --output-sync=target $(addprefix sanitize-,base v3 v4 threads)

# Captured at sys level: what the checkers write last must not end in pytest's temporary file.
sanitize-base sanitize-v3 sanitize-v4: sanitize-%: $(SANITIZED)/built
	LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libstdc++.so.6)" ASAN_OPTIONS=detect_leaks=0 \
	  UBSAN_OPTIONS=print_stacktrace=1 OMP_NUM_THREADS=1 CAP4D_ISA=$* $(SANITIZED)/bin/python -m pytest -p no:cacheprovider --capture=sys \
	  -k "not hard_cases_hold_on and not reference_gradients" $(SANITIZED_TESTS)

sanitize-threads: $(SANITIZED)/thread_pool
	$<

$(SANITIZED)/built: $(VENV)/installed $(CPP) Makefile
	$(BIN)/python -m venv --without-pip $(SANITIZED)
	$(BIN)/python -c 'import sys; print(*(p for p in sys.path if p.endswith("site-packages")), sep="\n")' \
	  > "$$($(SANITIZED)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/borrowed.pth"
	CXX=$(CXX) $(PIP) --python $(SANITIZED)/bin/python install --no-build-isolation --no-deps --editable . \
	  --config-settings=build-dir=$(SANITIZED)/cmake --config-settings=cmake.build-type=Sanitize --config-settings=install.strip=false \
	  --config-settings=cmake.define.CMAKE_CXX_FLAGS="$(SANITIZERS)"
	@touch $@

$(SANITIZED)/thread_pool: tests/cpp/thread_pool.cpp src/cpp/parallel.cpp src/cpp/parallel.h
	@mkdir -p $(SANITIZED)
	$(CXX) -std=c++20 -fsanitize=thread -g -O1 -Isrc/cpp -pthread $(filter %.cpp,$^) -o $@

clean:
	rm -rf build out $(VENV)

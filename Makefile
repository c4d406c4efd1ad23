# The commands of this project. `make demo` and `make test` do all the set-up they need.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= demo-output

.PHONY: help setup demo test check gate baseline bench readme clean

help:
	@echo "make setup   make $(VENV) with headbench in it"
	@echo "make demo    compare avatar methods on a capture made on the spot (OUT=$(OUT))"
	@echo "make test    run the tests"
	@echo "make check   style, types, architecture"
	@echo "make gate    hold the numbers of a small demo against tests/demo_baseline.json"
	@echo "make baseline  make that baseline anew, after a change that is meant to move them"
	@echo "make bench   measure the speed of the splat renderer"

setup: $(VENV)/.installed

# Reinstalled when packaging or the kernel changes; Python sources are used in place.
KERNEL := $(shell git ls-files "*CMakeLists.txt" "*.cpp" "*.h" 2>/dev/null)
$(VENV)/.installed: pyproject.toml constraints.txt __init__.py $(KERNEL)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "headbench needs Python 3.11 or newer; set PYTHON=")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: setup
	$(BIN)/headbench demo --out $(OUT)

test: setup
	$(BIN)/python -m pytest

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy bench datasets methods metrics reports
	$(BIN)/python -m pytest -q tests/test_architecture.py

# Seconds of seeded training on a capture made on the spot. PSNR moved by up to 0.005 dB and SSIM by up to 0.00013 between
# one and two threads, and with numpy, torch and libm held to SSE4; the baseline allows about ten times that.
GATED  := build/gated-demo
define gated_demo
rm -rf $(GATED)
$(BIN)/headbench demo --preset smoke --set methods=mean-image,nearest-camera,ga,ours --set metrics=psnr,ssim,storage \
  --out $(GATED)
endef

gate: setup
	$(gated_demo)
	$(BIN)/headbench gate $(GATED) --baseline tests/demo_baseline.json --junit build/gate.xml --markdown build/gate.md

baseline: setup
	$(gated_demo)
	$(BIN)/headbench gate $(GATED) --baseline tests/demo_baseline.json --update --captures remade

# The anchor is optional: without numba the table says so.
bench: setup
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check 'numba>=0.59'
	$(BIN)/headbench bench splats

# The README's table and picture are those of the last demo.
readme: demo
	$(BIN)/python -m headbench.reports.readme $(OUT) README.md

clean:
	rm -rf build $(VENV)

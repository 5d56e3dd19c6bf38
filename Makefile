# Two commands do everything: `make demo` and `make test`. Both create .venv on their first run.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# Most of the time of the suite goes to the compiler; see diffatmo/compiling.py.
COMPILE_FAST := --xla_cpu_use_fusion_emitters=false --xla_cpu_experimental_ynn_fusion_type= --xla_cpu_multi_thread_eigen=false \
	--xla_disable_hlo_passes=cse_barrier_expander \
	--xla_backend_optimization_level=1 --xla_backend_extra_options=xla_cpu_disable_loop_unrolling

.PHONY: demo test clean

demo: $(READY)
	$(BIN)/diffatmo fit -o demo --overwrite

test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	XLA_FLAGS="$(COMPILE_FAST)" $(BIN)/pytest -n 2 --dist worksteal

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "diffatmo needs Python 3.11 or newer; say which with: make PYTHON=/path/to/python3")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

clean:
	rm -rf .venv demo .pytest_cache .mypy_cache .ruff_cache

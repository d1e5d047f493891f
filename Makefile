# Two commands do all the set-up: `make demo` runs the main job, `make test` passes the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2

TUTORIALS := $(patsubst notebooks/%.ipynb,build/tutorials/%.md,$(wildcard notebooks/*.ipynb))

.PHONY: demo test docs notebooks package benchmark clean
.DELETE_ON_ERROR:

demo: $(VENV)/installed
	$(BIN)/pyro-dynogp demo

test: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -n $(WORKERS) --durations=25

benchmark: $(VENV)/peers
	$(BIN)/python -m tests.benchmarks

# Warnings are errors: mkdocs.yml says strict, and the site is looked at as it was built.
docs: $(TUTORIALS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	$(BIN)/python -m tests.built_site site

# Notebooks are executed before the site is built, and only those that changed. The kernel's log
# would have a warning about its own connection.
build/tutorials/%.md: notebooks/%.ipynb $(VENV)/docs
	@mkdir -p $(@D)
	$(BIN)/python -m nbconvert --to markdown --execute --output-dir $(@D) --log-level=ERROR \
		--ExecutePreprocessor.timeout=1200 --ExecutePreprocessor.extra_arguments=--log-level=40 $<

notebooks: $(VENV)/notebooks
	$(BIN)/jupyter lab notebooks

package: $(VENV)/installed
	$(BIN)/python -m tests.benchmarks.package

# torch is named first and pinned, so that no other package pulls in a different build of it.
$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	$(BIN)/pyro-dynogp compile
	touch $@

$(VENV)/peers: $(VENV)/installed tests/benchmarks/peers.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r tests/benchmarks/peers.txt
	touch $@

$(VENV)/docs $(VENV)/notebooks: $(VENV)/%: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$*]'
	touch $@

clean:
	rm -rf $(VENV) build site *.egg-info .mypy_cache .ruff_cache .import_linter_cache .pytest_cache

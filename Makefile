# Everything runs from .venv, which the first target that needs it sets up.
# ARGS goes to the command behind a target: make test ARGS="tests/system/test_llvm.py -x"

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all fuzz bench validate reference pictures docs lint clean

PYTHON_ENV := .venv/bin/python
EXPERIMENT := wake_sensor

help: ## show this list
	@echo "make demo or make test on a fresh machine do everything by themselves."
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/  make \1|\2/p' Makefile | awk -F'|' '{printf "%-18s%s\n", $$1, $$2}'

setup: ## make .venv, install the package and an LLVM for it (nothing to do: does nothing)
	@scripts/setup.sh

demo: setup ## run the main experiment; another: make demo EXPERIMENT=turbine
	.venv/bin/lidar-mi run scenes/$(EXPERIMENT).yaml -o outputs/$(EXPERIMENT) $(ARGS)

# One process for each core, eight at most (1.5 GiB each). In this process: make test ARGS=-n0
IN_PARALLEL := -n auto --maxprocesses 8 --dist loadfile

test: setup ## run the tests, without those marked slow
	$(PYTHON_ENV) -m pytest $(IN_PARALLEL) -m "not slow" $(ARGS)

test-all: setup ## run all tests
	$(PYTHON_ENV) -m pytest $(IN_PARALLEL) -m "slow or not slow" $(ARGS)

MINUTES := 20

fuzz: setup ## try hostile input: make fuzz MINUTES=20; what breaks something goes to tests/corpus
	$(PYTHON_ENV) -m tests.fuzz --minutes $(MINUTES) $(ARGS)

bench: setup ## compare with other programs, side by side: docs/performance.md; less: make bench ARGS=--quick
	@$(PYTHON_ENV) -c "from importlib.util import find_spec as f; exit(not (all(map(f, ('mitransient', 'openpiv', 'cv2', 'skimage')))))" \
		|| $(PYTHON_ENV) -m pip install -q -e ".[bench]"
	$(PYTHON_ENV) -m benchmarks $(ARGS)

validate: setup ## check against closed forms, published numbers and other programs: docs/validation
	@$(PYTHON_ENV) -c "from importlib.util import find_spec as f; exit(not (f('scatrs') and f('rustmatrix') and f('miepython')))" \
		|| $(PYTHON_ENV) -m pip install -q -e ".[test]"
	$(PYTHON_ENV) -m validation $(ARGS)

reference: setup ## write the pages of keys, commands, public names and plugins anew, from the code
	@for page in key command api plugin; do $(PYTHON_ENV) docs/make_$${page}_reference.py || exit 1; done

pictures: setup ## make the pictures of the pages anew, hours; some: make pictures ARGS="wake airport"
	@$(PYTHON_ENV) -c "import nbclient, nbformat" 2>/dev/null || $(PYTHON_ENV) -m pip install -q -e ".[test]"
	$(PYTHON_ENV) docs/make_pictures.py $(ARGS)

docs: setup ## check words, links and lengths of the pages and build them as a site in site/, readable offline
	@$(PYTHON_ENV) -c "import codespell_lib, furo, latex2mathml, myst_parser" 2>/dev/null \
		|| $(PYTHON_ENV) -m pip install -q -e ".[docs]"
	$(PYTHON_ENV) -m codespell_lib --skip "*.png,*.gif,*.nc,*.vol,*.html" \
		docs *.md paper examples scenes lidar_mi plugins
	$(PYTHON_ENV) -m pytest -q -n0 tests/docs -m "not slow" -k "link or short or screen or listed or images or up_to_date or tutorials"
	$(PYTHON_ENV) -m sphinx -q -W --keep-going -d build/doctrees docs site $(ARGS)
	@echo "open site/index.html"

lint: setup ## check style, format and types
	@$(PYTHON_ENV) -c "import ruff, mypy" 2>/dev/null || $(PYTHON_ENV) -m pip install -q -e ".[dev]"
	$(PYTHON_ENV) -m ruff check .
	$(PYTHON_ENV) -m ruff format --check .
	$(PYTHON_ENV) -m mypy

clean: ## remove caches and build leftovers; .venv and outputs stay
	rm -rf build dist site .pytest_cache .ruff_cache .mypy_cache *.egg-info
	find . -name .venv -prune -o -name outputs -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

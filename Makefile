# make                set up: .venv with all that is needed; then `. .venv/bin/activate`
# make help           these lines
# make tiles/<City>   set up, then make the tiles of a city of config/cities.tsv
# make dataset        set up, then make the tiles of all cities in the layout of the published dataset
# make verify         hold all tiles against the checksums of their manifests
# make test           set up, then pass the tests that every change needs
# make test-slow      set up, then pass the slow tests: whole runs, kills, draws, browsers, benchmarks, real scenes
# make test-all       test and test-slow
# make test-pythons   set up with the other Pythons that are here (3.12, 3.13), then pass the tests of what reads and writes files
# make test-networks  set up with PyTorch, then pass the tests of the networks
# make test-cluster   set up, then pass the test on a SLURM of its own (Debian, root)
# make test-s3        set up, then pass the tests with object storage (a server of its own)
# make docs           set up, then build the documentation: docs/_build/html/index.html
# make networks       set up with PyTorch
# make wheel          set up, then build the wheel with compiled kernels, so that its first run compiles nothing: dist/
# make lint           format, lint, lock file
# make lock           resolve the pins again
# make clean          remove all that runs have made
PYTHON ?= python3
CORES ?= 2
BIN := .venv/bin
READY := .venv/ready
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check
# Many processes run the same modules: each would compile anew what nobody may keep compiled.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup first-run first-city first-labels help docs networks wheel test test-all test-slow test-networks test-pythons test-s3 test-cluster lint lock dataset verify clean FORCE

setup: $(READY)

help:
	@sed -n 's/^# \(make\)/\1/p' $(firstword $(MAKEFILE_LIST))

# uv installs what the lock file names in a tenth of pip's time; where uv cannot be had, pip does it.
$(READY): envs/requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 11) or sys.exit("Python 3.11 or later is needed, this is %d.%d: set PYTHON=/path/to/python3.11" % v[:2])'
	$(PYTHON) -m venv .venv
	sed -n '/^uv==/,/[^\\]$$/p' envs/requirements.lock > .venv/uv.txt
	$(PIP) install --require-hashes -r .venv/uv.txt && \
	  $(BIN)/uv pip install --quiet --python $(BIN)/python --require-hashes -r envs/requirements.lock || \
	  $(PIP) install --no-compile --require-hashes -r envs/requirements.lock
	$(PIP) install --no-deps --no-build-isolation -e .
	-$(MAKE) --no-print-directory -j $(CORES) first-run
	touch $@

# All kernels are compiled beside the package, so that no job has to: by a run of the smallest city,
# and, at the same time, those of its last stage by labels of a box.
first-run: first-city first-labels

first-labels:
	PATH="$(CURDIR)/$(BIN):$$PATH" pytest -q -p no:cacheprovider tests/unit/labels/test_project.py -k same_in_any_order

first-city:
	rm -rf .venv/first && PATH="$(CURDIR)/$(BIN):$$PATH" && stereotruth init .venv/first --example demo && \
	  cd .venv/first && stereotruth run tiles/Demo --cores $(CORES) --quiet && cd ../.. && rm -rf .venv/first

# Kernels of the check and a run of the smallest city and of its page, compiled apart from those of .venv.
wheel: $(READY)
	rm -rf build dist
	export NUMBA_CACHE_DIR="$(CURDIR)/build/cache" PATH="$(CURDIR)/$(BIN):$$PATH" && \
	  stereotruth init build/first --example demo && (cd build/first && stereotruth check && stereotruth run tiles/Demo report --cores $(CORES) --quiet)
	STEREOTRUTH_KERNELS=build/cache/kernels $(PIP) wheel --no-deps --no-build-isolation --wheel-dir dist .

tiles/%: $(READY) FORCE
	PATH="$(CURDIR)/$(BIN):$$PATH" snakemake --cores $(CORES) $@

dataset verify: %: $(READY) FORCE
	PATH="$(CURDIR)/$(BIN):$$PATH" snakemake --cores $(CORES) $@

test: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" pytest -n $(CORES) -m "not slow"

test-all: test test-slow

test-slow: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" pytest -n $(CORES) -m slow

# Warnings are errors; links to what is not there are such.
docs: $(READY)
	$(BIN)/sphinx-build -W --keep-going -n -q -b html docs docs/_build/html

networks: $(READY)
	$(PIP) install --no-build-isolation -e '.[networks]'

test-networks: networks
	PATH="$(CURDIR)/$(BIN):$$PATH" pytest -n $(CORES) tests/unit/networks tests/workflow/test_train.py

# Libraries of newer Pythons are newer, too: GDAL, PROJ, NumPy, zarr decide what files hold.
OTHERS := 3.12 3.13
FILE_TESTS := $(addprefix tests/unit/,core/products core/test_tables.py sensor/test_images.py sensor/test_rpc_files.py \
  epipolar/test_rectify.py lidar/test_ingest.py lidar/test_point_store.py lidar/test_las_files.py lidar/test_height_raster.py \
  lidar/test_frames.py lidar/test_geoid.py lidar/test_to_wgs84.py tiles/test_tile_files.py tiles/test_layouts.py tiles/test_originals.py)
# The interpreter of a version, on the PATH or pyenv's; empty where there is none.
interpreter = $(firstword $(shell python$(1) -c "import sys; print(sys.executable)" 2> /dev/null) $(wildcard $(HOME)/.pyenv/versions/$(1).*/bin/python))

test-pythons:
	$(MAKE) --no-print-directory -j $(CORES) --output-sync $(foreach version,$(OTHERS),$(if $(call interpreter,$(version)),test-python$(version),no-python$(version)))

no-python%:
	@echo "SKIPPED: the tests on Python $*, which this machine does not have"

test-python%: .venv-%/ready
	PATH="$(CURDIR)/.venv-$*/bin:$$PATH" pytest -m "not slow" $(FILE_TESTS)

.PRECIOUS: .venv-%/ready  # made by way of test-python%: make would remove it
.venv-%/ready: $(READY)
	$(BIN)/uv venv --quiet --clear --python $(call interpreter,$*) .venv-$*
	$(BIN)/uv pip install --quiet --python .venv-$*/bin/python --require-hashes -r envs/requirements.lock
	$(BIN)/uv pip install --quiet --python .venv-$*/bin/python --no-deps --no-build-isolation -e .
	touch $@

test-s3: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" pytest tests/workflow/test_object_storage.py

test-cluster: $(READY)
	PATH="$(CURDIR)/$(BIN):$$PATH" tests/cluster/run.sh

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile workflow
	PATH="$(CURDIR)/$(BIN):$$PATH" snakemake --lint
	$(BIN)/python envs/check_lock.py

# Resolves again, keeping the pins that still fit.
lock: $(READY)
	UV_CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/uv pip compile pyproject.toml --extra catalog --extra dev --extra cluster --extra docs --extra pandora --extra storage \
	  --universal --python-version 3.11 --generate-hashes --no-annotate --quiet \
	  --output-file envs/requirements.lock

clean:
	rm -rf data results tiles dataset dataset_kitti dataset_us3d originals logs benchmark submission audit score_dsm report.html docs/_build .snakemake

FORCE:

# Two commands on a fresh machine: `make run` and `make test`. Either sets up .venv first, once.
#
# PYTHON: which Python (3.11 or later) .venv is made with

PYTHON ?= python3
BIN := .venv/bin
# They mostly wait.
NODE_WORKERS := $(shell echo $$(( $$(nproc) + 1 )))
NUMERICAL := tests/dynamics/test_accuracy.py tests/dynamics/test_second_formulation.py tests/dynamics/test_extremes.py \
	tests/dynamics/hard_cases/test_edges_and_throat.py

# A sourced ROS, or another environment, must not mix with the one in .venv.
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH LD_LIBRARY_PATH PYTHONHOME PYTHONPATH
unexport VIRTUAL_ENV _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Without bytecode each of the hundreds of processes of the tests would compile the package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup develop lock run test test-all test-core test-nodes
.PHONY: test-long-nodes test-generic test-numpy1 lint docs benchmark reproduction faults picture format clean test-plain

help:
	@echo "make run         set up and run the three experiments; results in runs/"
	@echo "make test        set up, check the style and run the tests, with few cases each"
	@echo "make test-all    ... with all cases, with a processor's other rounding, and with NumPy 1.26"
	@echo "make test-core   only the tests without nodes; make test-nodes: only those of the nodes"
	@echo "make test-long-nodes those of the nodes that make test leaves out"
	@echo "make test-generic run the numerical tests as compiled for any processor of this kind"
	@echo "make test-numpy1 run the core tests with an apt Jazzy's NumPy, 1.26, and without rerun"
	@echo "make test-plain  install without ROS in an environment of its own, and run README's Python"
	@echo "make setup       only set up .venv for runs; leaves .venv/bin/capture-sim"
	@echo "make develop     ... and for the tests and the docs"
	@echo "make lint        only check style, types and layers"
	@echo "make docs        build the pages in docs/ as a site, in build/site"
	@echo "make benchmark   measure speed against error; writes docs/evidence/benchmark.md (8 min)"
	@echo "make reproduction compare the paper's results with ours, on docs/evidence/reproduction.md (2 min)"
	@echo "make faults      insert faults into copies, one a core; list those that no test detects"
	@echo "                 (22 min of one core; JOBS=N for N at once; CASES=all: by make test-all)"
	@echo "make picture     remake the pictures in README.md and docs/; needs chromium and a Vulkan driver"
	@echo "make format      format the Python files as lint requires"
	@echo "make lock        pin the packages again after pyproject.toml has changed; ALL=1: the latest of each"
	@echo "make clean       remove .venv and everything built; keeps runs/"

setup develop:
	@command -v $(PYTHON) >/dev/null || { \
		echo "setup: no $(PYTHON). On Debian or Ubuntu: apt-get install python3 python3-dev python3-venv g++" >&2; \
		exit 2; }
	@$(PYTHON) tools/setup_env.py $(if $(filter develop,$@),--develop)

run: setup
	$(BIN)/capture-sim bench tilt_0 tilt_p10 tilt_m10 --out runs

# Lint and the node tests, which mostly wait, run at the same time as the core tests
test: develop
	@$(BIN)/python tools/run_tests.py

# What tests/cases.py leaves out of `make test`
test-all: develop
	CAPTURE_SIM_CASES=all $(MAKE) test
	$(MAKE) test-generic
	$(MAKE) test-numpy1

test-core: develop
	$(BIN)/python -m pytest tests --ignore tests/nodes -n auto --durations=20

# A file with the nodes that it shares runs in one process.
test-nodes: develop
	$(BIN)/python -m pytest tests/nodes -n $(NODE_WORKERS) --dist loadfile --durations=20

# Those that `make test` leaves out
test-long-nodes: develop
	CAPTURE_SIM_CASES=all $(BIN)/python -m pytest tests/nodes -m long -n $(NODE_WORKERS) --dist loadfile

# Rounding differs from one processor to the next, most of all without fused multiply and add, and
# tests must not depend on it. These are the tests that are most sensitive to it: each has failed for
# it once. CAPTURE_SIM_CASES is the number of random benches.
test-generic: develop
	mkdir -p build/generic
	NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= CAPTURE_SIM_CACHE=$(CURDIR)/build/generic \
		CAPTURE_SIM_CASES=$${CAPTURE_SIM_CASES:-40} \
		$(BIN)/python -m pytest $(NUMERICAL) -n auto --durations=20

# The committed files, in a clone with an environment of its own; without the nodes, whose wheels of
# ROS are for NumPy 2
test-numpy1:
	rm -rf build/numpy1
	git clone -q . build/numpy1 || (mkdir -p build/numpy1 && \
		tar -c --exclude=./.venv --exclude=./build --exclude=./.git . | tar -x -C build/numpy1)
	$(MAKE) -C build/numpy1 develop
	build/numpy1/$(BIN)/python -m pip install -q -r requirements/workstation.txt
	build/numpy1/$(BIN)/python -m pip uninstall -q -y rerun-sdk
	cd build/numpy1 && $(BIN)/python -m pytest tests --ignore tests/nodes -n auto

# Without ROS, in an environment of its own: what README's Python lines need
test-plain:
	rm -rf build/plain
	$(PYTHON) -m venv build/plain
	build/plain/bin/pip install -q .
	sed -n '/^```python/,/^```/{/^```/!p}' README.md >build/plain/readme.py
	cd build/plain && bin/python readme.py

lint: develop
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/licences.py

docs: develop
	$(BIN)/mkdocs build --strict
	@echo "look: $(BIN)/python -m http.server -d build/site 8000, then http://127.0.0.1:8000"

benchmark: develop
	$(BIN)/python -m benchmarks.speed

reproduction: develop
	$(BIN)/python -m benchmarks.reproduction

faults: develop
	$(BIN)/python tests/faults/run.py $(if $(JOBS),--jobs $(JOBS)) $(if $(CASES),--cases $(CASES))

picture: develop
	$(BIN)/capture-sim run tilt_0 tilt_p10 tilt_m10 --out build/picture
	$(BIN)/python -m tools.explain docs
	$(BIN)/python -m tools.diagrams docs
	$(BIN)/python -m tools.plan docs
	$(BIN)/python -m tools.reference docs --pictures
	$(BIN)/python -m tools.tables_of_nodes .
	cp build/picture/tilt_p10.png docs/tilt_p10.png
	$(BIN)/capture-sim sweep tilt_0 --vary approach.angle='-30 deg:30 deg:21' \
		--vary approach.offset='-50 mm:50 mm:21' --vary approach.speed=0.05,0.2 --out build/picture/map.csv
	cp build/picture/map_map.png docs/sweep_map.png
	$(BIN)/capture-sim sweep paper_designed --vary buffer.k_A='uniform(80%, 120%)' \
		--vary buffer.c_A='uniform(80%, 120%)' --vary chaser.mass='normal(100%, 2%)' \
		--vary contact.restitution='uniform(0.3, 0.9)' --runs 512 --sample latin --out build/picture/matters.csv
	cp build/picture/matters_tornado.png docs/sweep_tornado.png
	$(BIN)/capture-sim design examples/servicer.yaml --minimize max_axial_stroke_in,max_buffer_force \
		--stroke-limit 15 --torsion-limit 30 --peak-force 345 \
		--candidates 4000 --out build/picture/design
	cp build/picture/design/design.png docs/design_front.png
	$(BIN)/capture-sim report build/picture/tilt_0.mcap build/picture/tilt_p10.mcap build/picture/tilt_m10.mcap \
		--out build/picture/report.html
	$(BIN)/python -m tools.report_picture build/picture/report.html docs/report.png
	$(BIN)/python tools/rerun_picture.py build/picture/runs.rrd docs/rerun.png --at 0.1

lock: develop
	tools/lock.sh $(if $(ALL),--all)

format: develop
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build install log *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

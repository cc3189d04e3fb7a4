# `make demo` and `make test` need Python 3.10 or newer; scripts/setup brings what else they need.

# Where it is set, as images of containers like to, every process of a test compiles all it imports.
export PYTHONDONTWRITEBYTECODE =

# The library is built for each Python, for colcon, and for this .venv: what these builds have in
# common is compiled once where ccache is installed.
ccache := $(shell which ccache)
ifneq ($(ccache),)
export CMAKE_C_COMPILER_LAUNCHER = $(ccache)
export CMAKE_CXX_COMPILER_LAUNCHER = $(ccache)
export CCACHE_DIR = $(CURDIR)/build/ccache
endif

.PHONY: demo demo-ros ros2-wheels test test-untimed test-timed test-waiting test-building test-kernel core-tests lint benchmark experiments docs clean

demo: .venv/.ready
	.venv/bin/chainshaper demo

# The same as real ROS 2 nodes, on a machine without ROS 2: scripts/ros2-wheels brings one.
demo-ros: .venv/.ready
	scripts/ros2-wheels
	. .venv-ros/setup.sh && .venv/bin/chainshaper demo --ros

# Tests that need the machine's cores for themselves, and beside them those that mostly wait for
# tracers and other programs. What computes and compiles takes only what these leave (`nice -n 19`),
# and as two lanes, so that no more stand in line than there are cores: all other tests; and after
# each other what looks at the code, the C++ library's own tests, and the tests that compile
# (tests/conftest.py). What had to be tried twice stands at the end.
test:
	scripts/test-tools
	rm -rf build/tried
	$(MAKE) --jobs=2 .venv/.ready-dev ros2-wheels
	$(MAKE) --jobs=4 --output-sync=line \
		test-timed test-waiting test-untimed look-and-compile; \
		code=$$?; scripts/run-tests --tried-twice; exit $$code

.PHONY: look-and-compile
look-and-compile:
	$(MAKE) --jobs=1 --keep-going lint core-tests test-building

# Tests of a real ROS 2 run on it where no other one is; without it they skip (tests/helpers/ros2.py).
ros2-wheels:
	-[ "$$TEST_TOOLS" = leave ] || scripts/ros2-wheels

test-untimed: .venv/.ready-dev
	scripts/run-tests untimed "not timed and not waiting and not building" nice -n 19

test-timed: .venv/.ready-dev
	scripts/run-tests timed timed

test-waiting: .venv/.ready-dev
	scripts/run-tests waiting "waiting and not timed and not building"

test-building: .venv/.ready-dev
	scripts/run-tests building building nice -n 19

# In QEMU, what needs another kernel than this machine's: the sched_ext back end, LTTng's kernel
# tracer. Fetches about 130 MB once; a quarter of an hour or so.
test-kernel: .venv/.ready-dev
	.venv/bin/python tests/kernel/run_kernel_checks.py

# The C++ library's sources; how each is compiled is what the last build noted.
core = $(shell find core -name '*.[ch]pp')
# C++ that is not in the library: shaping nodes, the gates in front of rmw, the described nodes.
nodes = $(shell find src/chainshaper -name '*.[ch]pp')
# Of these, what the build compiles, since it needs no headers of ROS 2. Those of the nodes need them:
# scripts/lint-nodes checks them where a ROS 2 is sourced, or ROS2_SETUP names its setup.bash.
in_front_of_rmw = $(shell find src/chainshaper/robot/rmw -name '*.[ch]pp')
# The folder of the last build of the library.
built = $(dir $(firstword $(shell ls -t build/cp*/compile_commands.json)))

# The native library by itself, without Python, under sanitizers; each fuzz target runs for so many
# seconds: `make core-tests FUZZ_SECONDS=36000` is a campaign.
FUZZ_SECONDS = 10
core-tests: .venv/.ready-dev
	.venv/bin/cmake -S core -B build/core-tests -DCMAKE_BUILD_TYPE=RelWithDebInfo \
		-DCHAINSHAPER_BINDINGS=OFF -DCHAINSHAPER_TESTS=ON -DCHAINSHAPER_SANITIZE=ON \
		-DFUZZ_SECONDS=$(FUZZ_SECONDS)
	MAKEFLAGS= nice -n 19 .venv/bin/cmake --build build/core-tests --parallel 2
	nice -n 19 .venv/bin/ctest --test-dir build/core-tests --output-on-failure

lint: .venv/.ready-dev
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	nice -n 19 .venv/bin/mypy
	nice -n 19 .venv/bin/lint-imports --no-cache
	.venv/bin/clang-format --dry-run --Werror $(core) $(nodes)
	nice -n 19 .venv/bin/clang-tidy --quiet -p $(built) \
		$(filter-out core/tests/% core/fuzz/%,$(filter %.cpp,$(core))) $(filter %.cpp,$(in_front_of_rmw)) \
		src/chainshaper/sources/preload/preload.c
	nice -n 19 scripts/lint-nodes .venv/bin/clang-tidy $(built)preloaded/include

# Needs a quiet machine and about a quarter of an hour; prints tables, asserts nothing.
benchmark: .venv/.ready-dev
	.venv/bin/python benchmarks/shaping_jitter.py
	.venv/bin/python benchmarks/band_placement.py
	.venv/bin/python benchmarks/simulator.py
	.venv/bin/python benchmarks/sweep.py
	.venv/bin/python benchmarks/ctf_decode.py
	.venv/bin/python benchmarks/trace_to_latency.py
	.venv/bin/python benchmarks/fleet.py
	.venv/bin/python benchmarks/first_use.py
	.venv/bin/python benchmarks/enforcement/enter_exit.py

# The paper's tables and figures, ours beside them, in experiments/RESULTS.md. An hour on a quiet
# machine, some more where ROS 2 is sourced; LIVE=0 only simulates, which takes a minute or two.
experiments: .venv/.ready-dev
	.venv/bin/python experiments/render.py $(if $(filter 0,$(LIVE)),--simulated)

docs: .venv/.ready-dev
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict

# What is compiled: the native library, and what stands in front of ROS 2 (core/CMakeLists.txt). Where
# some of it has changed, scripts/setup builds again, and only that.
compiled := $(shell find core -type f) $(wildcard src/chainshaper/robot/*.py) \
	src/chainshaper/sources/preload/preload.c src/chainshaper/sources/preload/events_header.py \
	src/chainshaper/values/event_declarations.py \
	$(shell find src/chainshaper/robot -name '*.[ch]pp*')

.venv/.ready: pyproject.toml scripts/setup $(compiled)
	scripts/setup
	touch $@

.venv/.ready-dev: pyproject.toml scripts/setup $(compiled)
	scripts/setup dev
	touch $@ .venv/.ready

clean:
	rm -rf .venv build site .mypy_cache .ruff_cache .pytest_cache

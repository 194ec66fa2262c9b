# make demo    the main job on the shipped weights
# make test    every check that CI runs; those that need Gazebo are skipped where there is none
# make test-quick PYTHON=python3.12    the tests of the lower rooms, on another Python; needs no PyTorch
# make gazebo  a Gazebo 11 of our own, or the plugin for one that is installed
# make fuzz    every campaign of docs/reliability.md, each for two minutes
# make bench   speed, beside peers and the machine's limits, into benchmarks/results
# All set up their own virtual environments; the second time that takes no time.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
# A Python that is named and is not that of .venv has an environment of its own.
VERSION_OF = $(shell $(1) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
VENV := .venv
ifneq ($(origin PYTHON),file)
ifneq ($(filter-out $(call VERSION_OF,$(PYTHON)),$(call VERSION_OF,.venv/bin/python)),)
VENV := .venv-$(call VERSION_OF,$(PYTHON))
endif
endif
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt

# The wheels of ROS 2 start every Python of their environment twice, so those of Jazzy and of Kilted have one of
# their own each, above the other.
ROS := $(VENV)-ros

# What test-quick runs: it needs the extra "test" alone, and about a minute beside the kernels' compilation.
QUICK := tests/geometry tests/perception tests/simulation tests/test_boundary_types.py tests/test_front_door.py \
	tests/test_kernel_cache.py tests/test_rooms.py tests/test_threads.py tests/test_view_of_scan.py

# What runs with the wheels of Kilted as with those of Jazzy: topics, services, parameters and a team.
KILTED := tests/ros2/test_ros_live.py tests/ros2/test_ros_turtlebot.py

.PHONY: demo test test-quick gazebo fuzz bench clean

demo: $(VENV)/installed-view
	$(BIN)/triform demo

test: $(VENV)/installed-dev $(ROS)/installed $(ROS)-kilted/installed
	$(BIN)/ruff check src tests benchmarks ros2
	$(BIN)/ruff format --check src tests benchmarks ros2
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest --ignore tests/ros2
	$(ROS)/bin/python -m pytest tests/ros2
	$(ROS)-kilted/bin/python -m pytest $(KILTED)

test-quick: $(VENV)/installed-test
	$(BIN)/python -m pytest $(QUICK)

gazebo: $(VENV)/installed-evaluate
	$(BIN)/python -m triform.simulators.gazebo.install

# Seconds of each campaign of `make fuzz`; docs/reliability.md has what they found.
FUZZ_SECONDS ?= 120
CAMPAIGNS := wheels robot_answers sight arcs kills policies data_sets writers recordings command_line kept_kernels \
	ray_losses mujoco_worlds

fuzz: $(VENV)/installed-dev
	mkdir -p build/fuzz
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m tests.fuzz.fuzz_lidar build/fuzz \
		-artifact_prefix=build/ -max_len=2048 -len_control=0 -max_total_time=$(FUZZ_SECONDS)
	failed=; for campaign in $(CAMPAIGNS); do \
		$(BIN)/python -m tests.fuzz.$$campaign --seconds $(FUZZ_SECONDS) || failed="$$failed $$campaign"; \
	done; test -z "$$failed" || { echo "failed:$$failed" >&2; exit 1; }

bench: $(VENV)/installed-bench
	$(BIN)/python -m benchmarks

clean:
	rm -rf .venv .venv-* demo build src/triform.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "triform needs Python 3.11 or newer; name it with: make PYTHON=/path/to/python" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

# The environment of a distribution of ROS 2: its extra, and the constraints that hold for it.
define ROS_ENVIRONMENT
$(1)/installed: pyproject.toml $(3) $(VENV)/installed-dev
	@echo "installing triform[$(2)] into $(1)"
	@rm -rf $(1) && $$(PYTHON) -m venv $(1)
	@echo "import site; site.addsitedir('$$(CURDIR)/$(VENV)/lib/python$$$$($(1)/bin/python -c 'import sys; print(*sys.version_info[:2], sep=".")')/site-packages')" \
		> "$$$$($(1)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/zz_triform.pth"
	@$(1)/bin/python -m pip --disable-pip-version-check install --quiet --constraint $(3) \
		$$$$($(1)/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["$(2)"])') \
		|| echo "there are no wheels of ROS 2 for this machine; the tests that need them are skipped"
	@touch $$@
endef
$(eval $(call ROS_ENVIRONMENT,$(ROS),ros,constraints.txt))
$(eval $(call ROS_ENVIRONMENT,$(ROS)-kilted,ros-kilted,constraints-kilted.txt))

$(VENV)/installed-%: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing triform[$*] into $(VENV)"
	@$(PIP) --editable '.[$*]'
	@touch $@

# Try it
#   make demo      replay the sample bag through the real nodes into an embedded autopilot, and report (build/demo)
#   make fly       fly a scenario in closed loop through the real nodes, and report (build/fly)
#   make flights   fly every scenario 200 times in lock step, with five controllers (build/flights; many minutes)
#   make figures   redraw the paper's simulations into build/figures, and the controllers that `make flights` compared
# Change it
#   make test      run the test suite (about eight minutes on two cores); exit code 3 if a machine that is too busy fails it
#   make test-slow run the sweeps: more cases of what the suite tests (minutes)
#   make test-unit run the fast tests, which need no ROS (a minute)
#   make lint      style, types and names
#   make site      build the pages of docs/ as a site, with every link checked, and print the field card (build/site)
#   make px4-events  write flock_follower/mavlink/px4_events.txt from the sources of PX4, after `make px4_sitl` there: PX4='1.16=FOLDER 1.18=FOLDER'
#   make bless     make the present result of the sample bag the golden one (test/frozen)
#   make freeze    write the present results of the sample bag, flights, the bridge and real recordings to test/frozen
#   make frozen    compare with them, bit for bit (minutes; RUNS=4: the first 4 runs of each scenario)
#   make bags      regenerate the sample bag (a minute), and harder ones under build/bags (half an hour)
#   make setup     only make the virtual environment that the others use
#   make clean     remove everything that these made
# Measure it
#   make bench-simulation   speed of a flock of 10,000 agents, make bench-graph-law their safety
#   make bench-perception   CPU time and errors of perception beside OpenCV's detector (makes the bags it lacks)
#   make bench-planner      CPU time of the planner's tick, and its projection beside other solvers (minutes)
#   make bench-markers      how far and how near a marker, and a panel of two, are seen (five minutes)
#   make bench-evaluate  CPU time of evaluate beside reading and decoding the same bag (a minute)
#   make bench-stack        CPU time of the three nodes in flight beside three that only pass messages (a minute; DURATION=600)
#   make worst-case         search for the leader that brings the follower nearest to itself (an hour)
#   make guard-campaign     fly the distances of the pages of guard and flocks, in lock step (hours)
# Try to break it
#   make fuzz      random MAVLink bytes and malformed messages (minutes); BYTES=, MESSAGES=, SEED=
#   make kills     kill nodes at random moments of a flight, and time the braking (eight minutes); KILLS=, SEED=
#   make mutation  mutate gate, height, envelope, permission, activation, limits, guard and filter, and list the mistakes that their tests would miss (an hour)
#   make seeded-bugs  put known bugs in, one at a time, and run the test that must fail with each (three minutes); ONLY=stale
#
# Settings, as in make fly SCENARIO=outdoor DURATION=20
#   PYTHON=python3.12   the interpreter (default: the first of 3.12, 3.11, 3.13, 3.10 that runs)
#   ROS=kilted          ROS 2 Kilted instead of Jazzy
#   VISION=4.10         numpy 1.26 with OpenCV 4.10 instead of numpy 2 with OpenCV 5
#   TESTS=test/mavlink  what `make test` runs
#   MARKERS='not ros'   which of its tests: an expression of unit, ros, slow, sweep and linter
#   SCENARIO=outdoor    what `make fly` flies: a name in config/scenarios, or a file (default: indoor)
#   DURATION=20         fly no longer than this, s; never longer than the scenario
#   OUTPUT=folder       where `make demo` and `make fly` write (default: build/demo, build/fly)
#   RUNS=20             how often `make flights` flies each scenario
#   VIEW=no             `make demo` and `make fly` start no live page (default: http://127.0.0.1:8090)
#   DETECTOR=FILE       a program whose poses `make fly` flies on: examples/other_detector.py
#   AUTOPILOT=udp:127.0.0.1:14540   have `make fly` flown by an autopilot that runs already: PX4's SIH; ArduPilot's SITL:
#                       tcp:127.0.0.1:5760 (docs/desk.md). TRUTH=udpin:127.0.0.1:19410 where it sends the truth,
#                       FORWARD=yes to send it the odometry, for flight without GPS,
#                       LEADER=udpin:127.0.0.1:19411 where a second autopilot, that of the leader, sends the truth

ROS ?= jazzy
$(if $(filter jazzy kilted,$(ROS)),,$(error ROS = $(ROS): must be jazzy or kilted))
VISION ?= 5
$(if $(filter 5 4.10,$(VISION)),,$(error VISION = $(VISION): must be 5 or 4.10))
VENV := .venv$(patsubst %,-%,$(filter-out jazzy,$(ROS)))$(patsubst %,-opencv-%,$(filter-out 5,$(VISION)))
VIEW ?= yes
$(if $(filter yes no,$(VIEW)),,$(error VIEW = $(VIEW): must be yes or no))
export VIEW
TESTS ?= test
MARKERS ?=
SCENARIO ?= indoor
AUTOPILOT ?=
OUTPUT ?=
TRUTH ?=
FORWARD ?=
LEADER ?=
DETECTOR ?=
DURATION ?= 0
# Frozen flights are 25 runs of each scenario, unless RUNS is given.
FROZEN_RUNS := $(if $(RUNS),--runs $(RUNS))
RUNS ?= 200
BYTES ?= 1000000
MESSAGES ?= 100000
KILLS ?= 100
SEED ?= 1
ONLY ?=
export PYTHON
# Other machines receive nothing from the programs started here.
export ROS_AUTOMATIC_DISCOVERY_RANGE = LOCALHOST
RUN := $(VENV)/bin/python

.PHONY: help setup demo fly test test-unit test-slow test-detector-4.6 bless px4-events lint site figures flights \
	bench-simulation bench-evaluate bench-graph-law bench-markers bench-perception bench-planner bench-stack worst-case guard-campaign fuzz kills mutation \
	seeded-bugs frozen freeze bags clean
help:
	@sed -n '/^#/!q; s/^# \{0,1\}//p' Makefile

setup:
	@requirements/make_venv.sh $(VENV) requirements/lock-$(ROS).txt requirements/vision-$(VISION).txt

demo: setup
	@$(RUN) -m flock_desk.demo --output $(or $(OUTPUT),build/demo)

fly: setup
	@$(RUN) -m flock_desk.fly --scenario $(SCENARIO) --duration $(DURATION) \
		--output $(or $(OUTPUT),build/fly) \
		$(if $(DETECTOR),--detector $(DETECTOR)) \
		$(if $(AUTOPILOT),--autopilot $(AUTOPILOT)) $(if $(TRUTH),--truth $(TRUTH)) \
		$(if $(filter yes,$(FORWARD)),--forward-odometry) $(if $(LEADER),--leader-truth $(LEADER))

PYTEST := -m pytest --timeout 600 --timeout-method thread
test: setup
	@$(RUN) test/suite.py $(filter-out test,$(TESTS)) $(if $(MARKERS),-m '$(MARKERS)')

test-slow: setup
	@$(RUN) $(PYTEST) -n 2 -m sweep

test-unit: setup
	@$(RUN) -m pytest -m unit

test-detector-4.6:
	@requirements/make_venv.sh .venv-opencv-4.6 requirements/detector-4.6.txt
	@.venv-opencv-4.6/bin/python -m pytest test/perception test/pipeline/test_golden.py -m 'not sweep' \
		--ignore=test/perception/test_overlay.py

site:
	@requirements/make_venv.sh .venv-site requirements/site.txt
	@.venv-site/bin/sphinx-build -q -W --keep-going -c docs . build/site
	@echo build/site/docs/index.html

lint: setup
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/mypy
	@$(RUN) test/names.py

bless: setup
	@$(RUN) test/frozen.py --write sample

px4-events: setup
	@$(RUN) test/px4_events.py $(PX4)

frozen: setup
	@$(RUN) test/frozen.py $(FROZEN_RUNS)

freeze: setup
	@$(RUN) test/frozen.py $(FROZEN_RUNS) --write

figures: setup
	@$(RUN) -m flock_desk.figures

flights: setup
	@$(RUN) -m flock_desk.flights --scenario all --runs $(RUNS)

bench-simulation: setup
	@$(RUN) benchmarks/simulation.py

bench-graph-law: setup
	@$(RUN) benchmarks/graph_law.py

bench-perception: setup
	@$(RUN) benchmarks/perception.py

bench-markers: setup
	@$(RUN) benchmarks/markers.py

worst-case: setup
	@$(RUN) benchmarks/worst_case.py

guard-campaign: setup
	@$(RUN) benchmarks/guard_campaign.py

bench-planner: setup
	@$(RUN) benchmarks/planner_tick.py

bench-evaluate: setup
	@$(RUN) benchmarks/evaluate.py

bench-stack: setup
	@$(RUN) benchmarks/stack.py $(if $(filter-out 0,$(DURATION)),--duration $(DURATION))

fuzz: setup
	@$(RUN) test/fuzz.py --bytes $(BYTES) --messages $(MESSAGES) --seed $(SEED)

kills: setup
	@$(RUN) test/kills.py --kills $(KILLS) --seed $(SEED)

seeded-bugs: setup
	@$(RUN) test/seeded_bugs.py '$(ONLY)'

mutation:
	@echo 'takes about an hour on two cores; the reports come one by one'
	@requirements/make_venv.sh .venv-mutation requirements/mutation.txt
	@.ci/mutation

bags: setup
	@$(RUN) -m flock_desk.sample_bag --variant all

clean:
	rm -rf .venv .venv-* build install log *.egg-info .hypothesis .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

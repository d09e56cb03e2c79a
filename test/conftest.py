# Copyright 2026 The flock_follower developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Keeps every test on this machine and repeatable, and marks it ``unit``, ``ros`` or ``slow``.

``ros``: uses rclpy or starts nodes. Given here to all in test/nodes, to what asks for the fixture
``ros``, and to modules that import ROS. Another test that starts a process of ours says it itself.
``slow``: takes seconds, or belongs to a module of such tests; says it itself.
``sweep``: more cases of what another test holds; says it itself, and runs with ``make test-slow``.
``linter``: one of ROS's linters; says it itself.
``unit``: all else. Without paths and markers pytest runs these and the linters: `colcon test`.
A test without ``ros`` that loads rclpy or starts a process of ours fails.

A test with ``ros`` that fails while other programs had the processors says so.
"""

import ast
from functools import cache
import gc
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time

from hypothesis import HealthCheck, settings
import pytest

from flock_desk.runs.processes import private_environment
from flock_follower.checks.processor import children, LOAD_PERIOD, LoadMeter
from flock_follower.system.fast_dds import profile_variables

HERE = Path(__file__).resolve().parent

# A shell that starts the tests in the background has them ignore Ctrl-C, which some test.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Before any rclpy import: DDS reads these once, and nobody's real drone may hear a test.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = private_environment()['ROS_DOMAIN_ID']
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
os.environ['VIEW'] = 'no'  # flights start no live page
# As the nodes do: there is a core for each worker.
os.environ.setdefault('OPENCV_FOR_THREADS_NUM', '1')
# Nodes find each other in a fifth of a second instead of up to 2.5 s.
os.environ.update(profile_variables('config/dds/fastdds.xml'))

# What collecting makes stays to the end: to look for garbage in it takes a fifth of that time.
gc.disable()

#: The tests that run unless paths or markers are given.
FAST = 'unit or linter'
#: Modules of the packages that import rclpy.
NODES = 'flock_follower.nodes', 'flock_desk.simulator_', 'flock_desk.recorder_node'

settings.register_profile(
    'repeatable', derandomize=True, deadline=None, print_blob=False, max_examples=60,
    suppress_health_check=[HealthCheck.too_slow])
settings.load_profile('repeatable')


def is_ros(package):
    """Whether a package comes with ROS: rclpy, or message types."""
    return package == 'rclpy' or package.endswith(('_interfaces', '_msgs', '_srvs'))


@cache
def loads_ros(path):
    """Whether a module of tests, or a helper beside this file, imports ROS when it is loaded."""
    names = []
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f'{node.module}.{alias.name}' for alias in node.names]
    helpers = [HERE / f'{name.partition(".")[0]}.py' for name in names]
    return (any(is_ros(name.partition('.')[0]) or name.startswith(NODES) for name in names)
            or any(loads_ros(path) for path in helpers if path.exists()))


def may_use_ros(path):
    """Whether a module of tests may have some with the marker ``ros``."""
    return (HERE / 'nodes' in path.parents or loads_ros(path)
            or re.search(r'\bros\b', path.read_text()) is not None)


def may_be_slow(path):
    """Whether a module of tests may have some with the marker ``slow``."""
    return re.search(r'\bslow\b', path.read_text()) is not None


def is_slow(path):
    """Whether a module says of all its tests that they are slow."""
    return 'pytestmark = pytest.mark.slow' in path.read_text().splitlines()


def pytest_ignore_collect(collection_path, config):
    """Do not even load a module none of whose tests is asked for: some load for a second."""
    if not collection_path.match('test_*.py'):
        return None
    asked = config.option.markexpr
    if asked.startswith(('unit', 'not ros')) and loads_ros(collection_path):
        return True
    if asked.startswith('ros') and not may_use_ros(collection_path):
        return True
    if asked.startswith('ros and slow') and not may_be_slow(collection_path):
        return True
    if asked in ('unit', FAST, 'not slow') and is_slow(collection_path):
        return True
    return None  # others may have reasons to leave it out


class FromTheEnd(pytest.Dir):
    """A folder whose last module is loaded first."""

    def collect(self):
        return reversed([*super().collect()])


def pytest_collect_directory(path, parent):
    """
    Let the second worker load the modules from the last one on.

    In a fresh clone the asserts of each module are rewritten once, by the worker that comes first.
    """
    if os.environ.get('PYTEST_XDIST_WORKER') == 'gw1':
        return FromTheEnd.from_parent(parent, path=path)
    return None


def pytest_collection_modifyitems(items):
    """Mark every test, and begin with the slow ones: side by side, none is waited for at last."""
    for item in items:
        if (HERE / 'nodes' in item.path.parents or 'ros' in item.fixturenames
                or loads_ros(item.path)):
            item.add_marker('ros')
        if not any(item.get_closest_marker(name) for name in ('ros', 'slow', 'sweep', 'linter')):
            item.add_marker('unit')
    items.sort(key=lambda item: (item.get_closest_marker('slow') is None, item.path))


def pytest_collection_finish():
    """Look for garbage again, but only in what the tests make."""
    gc.freeze()
    gc.enable()


def family(process):
    """Return the ids of a process, its children, and theirs."""
    return [process, *(one for child in children(process) for one in family(child))]


LOAD = LoadMeter(lambda: family(os.getpid()))


def measure_load():
    """Measure the load of this process and its nodes as long as it lives."""
    while True:
        LOAD.sample(time.monotonic())
        time.sleep(LOAD_PERIOD)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Add the load to the report of a test of nodes that failed on a busy machine."""
    report = yield
    if report.failed and item.get_closest_marker('ros'):
        load = LOAD.worst(time.monotonic() - call.duration - LOAD_PERIOD)
        if load is not None and load.busy:
            report.user_properties.append(('too busy', str(load)))
            report.sections.append(('too busy', f'{load}: this may be why'))
    return report


class Progress:
    """
    Counts the tests of a run, and writes the counts to a file after each.

    :param path: of the file; '': none is written.
    """

    def __init__(self, path):
        self.path, self.total, self.done = path, 0, 0
        self.failed, self.busy = {}, {}

    def pytest_collection_finish(self, session):
        self.total = self.total or len(session.items)
        self.write()

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node, ids):
        self.total = len(ids)

    def pytest_runtest_logreport(self, report):
        if report.when == 'teardown':
            self.done += 1
        if report.failed:
            self.failed[report.nodeid] = True
            if load := dict(report.user_properties).get('too busy'):
                self.busy[report.nodeid] = load
        if report.when == 'teardown' or report.failed:
            self.write()

    def write(self):
        """Write the status, whole."""
        if self.path:
            part = Path(f'{self.path}.part')
            part.write_text(json.dumps({
                'total': self.total, 'done': self.done, 'failed': len(self.failed),
                'busy': [*self.busy]}))
            part.replace(self.path)

    def pytest_terminal_summary(self, terminalreporter):
        for test, load in self.busy.items():
            terminalreporter.write_line(f'too busy: {test}: {load}')


def pytest_configure(config):
    """Choose the tests; measure the load, where they run; count them, where they are reported."""
    if config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.option.markexpr:
        config.option.markexpr = FAST
    if not getattr(config.option, 'numprocesses', None):  # else its workers do
        threading.Thread(target=measure_load, daemon=True).start()
    if not hasattr(config, 'workerinput'):
        config.pluginmanager.register(Progress(os.environ.pop('FLOCK_FOLLOWER_TEST_STATUS', '')))


@pytest.fixture(autouse=True)
def keep_to_the_marker(request, monkeypatch):
    """Let no test without the marker ``ros`` start a process or load ROS."""
    # The black box lowers its priority: in this process that would be that of all later tests.
    monkeypatch.setattr(os, 'nice', lambda _: 0)
    if request.node.get_closest_marker('ros'):
        yield
        return

    start = subprocess.Popen

    def start_unless_ours(command, *arguments, **options):
        # Libraries ask other programs for the font or the processor that there is.
        if sys.executable in command:
            pytest.fail('starts a process: mark it with @pytest.mark.ros')
        return start(command, *arguments, **options)

    monkeypatch.setattr(subprocess, 'Popen', start_unless_ours)
    before = 'rclpy' in sys.modules
    yield
    assert before or 'rclpy' not in sys.modules, 'loads rclpy: mark it with @pytest.mark.ros'


@pytest.fixture
def undrawn(monkeypatch):
    """Put an empty picture in place of each of a report of ``evaluate``: they take a second."""
    from flock_desk.runs import plots
    for picture in ('_flight_picture', '_error_picture'):
        monkeypatch.setattr(plots, picture, lambda _: plots.Illustration(b'\x89PNG', 'empty'))


@pytest.fixture
def default_hangup():
    """Let children inherit no ignored SIGHUP: the suite itself may run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope='module')
def ros():
    """Have ROS up while a module's tests run; where there is none, others run all the same."""
    import rclpy
    rclpy.init()
    yield
    rclpy.try_shutdown()

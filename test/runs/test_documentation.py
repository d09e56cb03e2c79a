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

"""What the documentation says is what the code does."""

import ast
from pathlib import Path
import re

import numpy as np
import pytest

from flock_desk.program import PROGRAMS
from flock_desk.scenarios.scenario_file import parse

ROOT = Path(__file__).resolve().parents[2]
PAGES = pytest.mark.parametrize('page', sorted(
    str(path.relative_to(ROOT)) for folder in ('.', 'bags', 'config', 'docs', 'examples')
    for path in (ROOT / folder).glob('*.md')))
ARCHITECTURE = ROOT / 'docs' / 'architecture.md'


@pytest.mark.ros
def test_the_parameter_page_is_that_of_the_nodes():
    from flock_desk.parameter_tables import markdown
    assert (ROOT / 'config' / 'PARAMETERS.md').read_text() == markdown()


@PAGES
def test_every_file_and_folder_a_page_names_exists(page):
    text = (ROOT / page).read_text()
    folders = 'benchmarks|config|bags|deploy|docs|examples|launch|test|requirements|flock_follower'
    named = re.findall(rf'`((?:{folders})/[\w./@-]*)`', text)
    for name in named:
        assert (ROOT / name).exists(), name


@PAGES
def test_every_module_a_page_runs_exists(page):
    text = (ROOT / page).read_text()
    for module in set(re.findall(r'-m (flock_follower[\w.]+)', text)):
        assert (ROOT / (module.replace('.', '/') + '.py')).exists(), module


#: Targets of PX4's Makefile.
ELSEWHERE = ('px4_sitl', 'sihsim_quadx')
SERVICES = {'mavlink_bridge/arm', 'mavlink_bridge/takeoff', 'mavlink_bridge/offboard',
            'mavlink_bridge/land', 'planner/engage', 'replay/pause'}


@PAGES
def test_every_command_of_ours_exists(page):
    text = (ROOT / page).read_text()
    targets = re.findall(r'^([\w.-]+):', (ROOT / 'Makefile').read_text(), re.M)
    for line in re.findall(r'^(?: {4,}|`)(make [^`\n#]*)', text, re.M):
        called = [word for word in line.split()[1:] if '=' not in word and word[0] != '-']
        assert set(called) <= {*targets, *ELSEWHERE}, line
    programs = re.findall(r"'(\w+) = flock_", (ROOT / 'setup.py').read_text())
    for name in re.findall(r'ros2 run flock_follower (\w+)', text):
        assert name in programs, name
    for name, arguments in re.findall(r'ros2 launch flock_follower (\S+?)`?((?: \w+:=\S+)*)$',
                                      text, re.M):
        file = ROOT / 'launch' / name
        assert file.exists(), name
        said = file.read_text() + (ROOT / 'launch' / 'follower.launch.py').read_text()
        for argument in re.findall(r'(\w+):=', arguments):
            assert f"'{argument}': (" in said, argument
    called = re.findall(r'ros2 service call /(\S+)', text)
    called += re.findall(r'nodes[.]call /?(\w+/\w+)', text)
    for service in called:
        assert service in SERVICES, service
    for extra in re.findall(r"pip install '\.\[(\w+)\]'", text):
        assert f"'{extra}': [" in (ROOT / 'setup.py').read_text(), extra
    for name in re.findall(r'^    flock_follower (\w+)', text, re.M):
        assert name in PROGRAMS, name
    options = (ROOT / 'deploy' / 'install.sh').read_text().partition('END')[2]
    for line in re.findall(r'deploy/install\.sh ([^#`\n]*)', text):
        for option in re.findall(r'--[\w-]+', line):
            assert f'  {option} ' in options, option


def test_the_law_on_the_first_page_runs():
    (example,) = re.findall(r'```python\n(.*?)```', (ROOT / 'README.md').read_text(), re.DOTALL)
    found = {}
    exec(example, found)
    assert np.all(np.isfinite(eval(example.strip().splitlines()[-1], found)))


def test_the_scenario_on_the_page_of_simulation_can_be_flown():
    text = (ROOT / 'docs' / 'desk.md').read_text()
    (example,) = re.findall(r'```yaml\n(.*?)```', text, re.DOTALL)
    scenario = parse(example, 'mine.yaml')
    assert scenario.leader.motion == 'stairs' and scenario.outages


def test_every_module_on_the_page_of_the_house_exists():
    named = re.findall(r'`([\w/]+\.py)`', ARCHITECTURE.read_text())
    assert len(named) > 50
    for name in named:
        assert (ROOT / 'flock_follower' / name).exists() or (ROOT / name).exists(), name


def test_the_way_of_an_image_is_through_functions_that_exist_and_are_counted():
    text = ARCHITECTURE.read_text()
    table = text.partition('| file | functions')[2].partition('\n\n')[0]
    functions, files = set(), set()
    for row in table.splitlines()[2:]:
        paths, names = (re.findall(r'`([^`]+)`', cell) for cell in row.split('|')[1:3])
        defined = {node.name for path in paths
                   for node in ast.walk(ast.parse((ROOT / 'flock_follower' / path).read_text()))
                   if isinstance(node, ast.FunctionDef)}
        for name in names:
            assert name.rpartition('.')[2] in defined, f'{name} in {paths}'
            functions.add((paths[0], name))
        files.update(paths)
    assert f'{len(functions)} functions in {len(files)} files' in text


def test_the_example_for_kalibr_prints_what_the_page_says(capsys):
    text = (ROOT / 'docs' / 'sensors.md').read_text()
    (example,) = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    exec(example, {})
    assert f'```\n{capsys.readouterr().out}```' in text

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
    from flock_desk.program import markdown
    assert (ROOT / 'config' / 'PARAMETERS.md').read_text() == markdown(), (
        'run: python -m flock_desk.program --parameters > config/PARAMETERS.md')


FOLDERS = 'benchmarks|config|bags|deploy|docs|examples|launch|test|requirements|flock_follower'
#: Targets of PX4's Makefile.
ELSEWHERE = {'px4_sitl', 'sihsim_quadx'}
SERVICES = {'mavlink_bridge/arm', 'mavlink_bridge/takeoff', 'mavlink_bridge/offboard',
            'mavlink_bridge/land', 'planner/engage', 'replay/pause'}


@PAGES
def test_every_file_module_and_command_that_a_page_names_exists(page):
    text, makefile, setup = (
        (ROOT / name).read_text() for name in (page, 'Makefile', 'setup.py'))
    for name in re.findall(rf'`((?:{FOLDERS})/[\w./@-]*)`', text):
        assert (ROOT / name).exists(), name
    for module in re.findall(r'-m (flock_[\w.]+)', text):
        assert (ROOT / (module.replace('.', '/') + '.py')).exists(), module
    for line in re.findall(r'^(?: {4,}|`)(make [^`\n#]*)', text, re.M):
        called = {word for word in line.split()[1:] if '=' not in word and word[0] != '-'}
        assert called <= {*re.findall(r'^([\w.-]+):', makefile, re.M)} | ELSEWHERE, line
    for name in re.findall(r'ros2 run flock_follower (\w+)', text):
        assert f"'{name} = flock_" in setup, name
    for name in re.findall(r'^    (?:(?:.venv/bin/)?flock_follower|start_node) (\w+)', text, re.M):
        assert name in PROGRAMS, name
    for name, arguments in re.findall(r'ros2 launch flock_follower (\S+?)`?((?: \w+:=\S+)*)$',
                                      text, re.M):
        launch = ''.join((ROOT / 'launch' / file).read_text()
                         for file in (name, 'follower.launch.py'))
        for argument in re.findall(r'(\w+):=', arguments):
            assert f"'{argument}': (" in launch, argument
    for service in re.findall(r'(?:ros2 service call /|nodes[.]call /?)(\w+/\w+)', text):
        assert service in SERVICES, service


@pytest.mark.parametrize('path', sorted((ROOT / 'docs').glob('*.md')), ids=lambda path: path.stem)
def test_lines_of_docs_have_at_most_140_characters(path):
    long = [n for n, line in enumerate(path.read_text().splitlines(), 1) if len(line) > 140]
    assert not long, long[:5]


def test_every_answer_has_at_most_six_lines():
    answers = re.split('^## .*$', (ROOT / 'docs' / 'questions.md').read_text(), flags=re.M)[1:]
    assert len(answers) >= 12
    assert max(len(answer.strip().splitlines()) for answer in answers) <= 6


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


def test_the_scenario_of_the_tutorial_can_be_flown():
    text = (ROOT / 'docs' / 'tutorial.md').read_text()
    (example,) = re.findall(r"printf '%s.n' (.*?) > mine.yaml", text, re.DOTALL)
    scenario = parse('\n'.join(re.findall("'(.*?)'", example)), 'mine.yaml')
    assert scenario.leader.motion == 'circle' and scenario.outages


def test_every_module_on_the_page_of_the_house_exists():
    named = re.findall(r'`([\w/]+\.py)`', ARCHITECTURE.read_text())
    assert len(named) > 50
    for name in named:
        assert (ROOT / 'flock_follower' / name).exists() or (ROOT / name).exists(), name


@pytest.mark.parametrize(('header', 'counted'), [
    ('| file | functions, in the order', True), ('| file | functions for a lost leader', False)])
def test_path_of_an_image_is_through_existing_functions(header, counted):
    text = ARCHITECTURE.read_text()
    table = text.partition(header)[2].partition('\n\n')[0]
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
    assert len(functions) > 5
    assert not counted or f'{len(functions)} functions in {len(files)} files' in text


def test_the_example_for_kalibr_prints_what_the_page_says(capsys):
    text = (ROOT / 'docs' / 'sensors.md').read_text()
    (example,) = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    exec(example, {})
    assert f'```\n{capsys.readouterr().out}```' in text

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

import pytest
import yaml

from flock_follower.parameters.spec import Spec

ROOT = Path(__file__).resolve().parents[2]
NODES = [path.stem for path in sorted((ROOT / 'flock_follower' / 'nodes').glob('*.py'))]
PAGES = pytest.mark.parametrize('page', [
    'README.md', 'bags/README.md', 'config/PILOT.md', 'docs/architecture.md',
    'docs/permission.md', 'docs/sitl.md', 'docs/vio.md'])
ARCHITECTURE = ROOT / 'docs' / 'architecture.md'


def specs(node):
    from importlib import import_module
    found = import_module(f'flock_follower.nodes.{node}').SPECS
    assert all(isinstance(spec, Spec) for spec in found)
    return {spec.name: spec for spec in found}


@pytest.mark.ros
def test_the_parameter_page_is_that_of_the_nodes():
    from flock_follower.nodes.parameter_tables import markdown
    assert (ROOT / 'config' / 'PARAMETERS.md').read_text() == markdown()


@pytest.mark.ros
@pytest.mark.parametrize('node', [n for n in NODES if (ROOT / 'config' / f'{n}.yaml').exists()])
def test_a_shipped_parameter_file_is_valid_and_holds_the_defaults(node):
    values = yaml.safe_load((ROOT / 'config' / f'{node}.yaml').read_text())
    known = specs(node)
    for name, value in values['/**']['ros__parameters'].items():
        assert known[name].check(value) == known[name].default, name


@PAGES
def test_every_file_and_folder_a_page_names_exists(page):
    text = (ROOT / page).read_text()
    folders = 'benchmarks|config|bags|docs|launch|test|requirements|flock_follower'
    named = re.findall(rf'`((?:{folders})/[\w./]*)`', text)
    assert named
    for name in named:
        assert (ROOT / name).exists(), name


@PAGES
def test_every_module_a_page_runs_exists(page):
    text = (ROOT / page).read_text()
    for module in set(re.findall(r'-m (flock_follower[\w.]+)', text)):
        assert (ROOT / (module.replace('.', '/') + '.py')).exists(), module


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
    text = (ROOT / 'docs' / 'vio.md').read_text()
    (example,) = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    exec(example, {})
    assert f'```\n{capsys.readouterr().out}```' in text

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

"""The linter of names: each rule on a module that breaks it, and what the list accepts."""

from __future__ import annotations

import ast
from pathlib import Path

import names
import pytest

MODULE = """
#: Reactions take 0.2 s
FAR = 3  # m, and by so much
TOO_FAR = 2
A, B = 1, 2  # m
WORDS, OTHERS = 'a', 'b'


def beside(x):
    return FAR


def rounded(x):
    return FAR + TOO_FAR


def needed_time(x):
    return B


def speed(x):
    return B
"""


@pytest.mark.parametrize(('rule', 'listed'), [
    ('word', {'FAR', 'B'}), ('line', {'A, B'}), ('comment', {'TOO_FAR'}),
    ('function', {'beside', 'rounded'})])
def test_a_module_breaks_each_rule(rule: str, listed: set[str]) -> None:
    found = names.breaches_of_module(ast.parse(MODULE), MODULE, set())
    assert {name for broken, name in found if broken == rule} == listed


def test_a_one_word_number_of_one_function_is_a_breach_elsewhere() -> None:
    text = 'STEP = 0.1  # s\n\n\ndef advance():\n    return STEP\n'
    assert names.breaches_of_module(ast.parse(text), text, set()) == set()
    assert names.breaches_of_module(ast.parse(text), text, {'STEP'}) == {('word', 'STEP')}


@pytest.mark.parametrize(('british', 'american'), [
    ('_NEIGHBOURS', '_NEIGHBORS'), ('Colour of the centre', 'Color of the center'),
    ('initialised, 3 metres', 'initialized, 3 meters'),
    ('raised promises', 'raised promises'), ('CancelledError', 'CancelledError')])
def test_the_spelling_is_mended_in_the_case_of_the_word(british: str, american: str) -> None:
    assert names.american(british) == american


def test_the_list_of_accepted_breaches_may_only_shrink() -> None:
    one, other = ('word', 'FAR'), ('function', 'at')
    assert names.compare({'a.py': {one}}, {'a.py': {one}}) == []
    new, gone = names.compare({'a.py': {one}}, {'a.py': {other}})
    assert new == 'a.py: word: FAR' and gone.startswith('a.py: function: at is mended: ')


def test_a_long_name_of_a_test_is_a_breach(tmp_path: Path) -> None:
    for folder in names.FOLDERS:
        (tmp_path / folder).mkdir()
    long = 'test_' + 'x' * names.MAX_TEST_NAME
    (tmp_path / 'test' / 'test_it.py').write_text(f'def {long}():\n    pass\n')
    assert names.find_breaches(tmp_path) == {'test/test_it.py': {('length', long)}}

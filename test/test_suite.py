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
"""`make test`: its verdict of a busy machine, and the line that shows how far it is."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

from conftest import Progress
import pytest
from suite import environment, main, progress, read_status, Run, STATUS, Status, verdict

GREEN = Run(0, Status(9, 9))
RED = Run(1, Status(9, 9, 2, ('a',)))
BUSY = Run(1, Status(9, 9, 2, ('a', 'b')))


@pytest.mark.parametrize(('ended', 'alone', 'code'), [
    ([GREEN, GREEN], [], 0), ([GREEN, RED], [GREEN], 1), ([GREEN, BUSY], [GREEN], 0),
    ([GREEN, BUSY], [BUSY], 3), ([GREEN, BUSY], [RED], 1), ([RED, BUSY], [BUSY], 1)])
def test_only_a_pass_alone_turns_a_busy_failure_green(
        ended: list[Run], alone: list[Run], code: int) -> None:
    assert verdict(ended, alone) == code


@pytest.mark.parametrize('code', [1, 2, 4, 5, -9])
def test_a_run_that_ended_for_another_reason_is_never_excused(code: int) -> None:
    assert verdict([Run(code, Status(9, 4))], []) == code
    assert not Run(2, Status(9, 9, 1, ('a',))).excused


def test_the_line_has_done_total_time_left_and_logs() -> None:
    assert progress('test-flights', Status(100, 25, 1), 60.0) == (
        '1:00: 25 of 100 tests done, 1 failed, about 3:00 left; build/test-flights.log')
    assert '0 of ? tests done, 0 failed, collecting' in progress('test', Status(), 1.0)


def test_the_status_is_what_a_run_of_tests_wrote(tmp_path: Path) -> None:
    path = tmp_path / 'status.json'
    assert read_status(path) == Status()
    path.write_text(json.dumps({'total': 3, 'done': 2, 'failed': 1, 'busy': ['a::b']}))
    assert read_status(path) == Status(3, 2, 1, ('a::b',))


def test_run_keeps_compiled_files_however_it_is_started(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('PYTHONDONTWRITEBYTECODE', '1')
    monkeypatch.setenv('LANG', 'C')
    given = environment(Path('status.json'))
    assert 'PYTHONDONTWRITEBYTECODE' not in given
    assert (given['LANG'], given[STATUS]) == ('C', 'status.json')


def test_run_counts_each_test_once_and_names_busy_ones(tmp_path: Path) -> None:
    path = tmp_path / 'status.json'
    counted = Progress(str(path))
    counted.pytest_xdist_node_collection_finished(None, ['a', 'b', 'c'])
    busy = [('too busy', 'for 50% of the worst 2 s')]
    for test, failed, properties in (('a', True, busy), ('b', True, []), ('c', False, [])):
        for when in ('setup', 'call', 'teardown'):
            counted.pytest_runtest_logreport(SimpleNamespace(
                nodeid=test, when=when, failed=failed and when != 'setup',
                user_properties=properties))
        assert read_status(path).done == 'abc'.index(test) + 1
    assert read_status(path) == Status(3, 3, 2, ('a',))


def test_what_failed_on_a_busy_machine_is_repeated_alone(
        monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    runs = []

    def pretend(name: str, asked: list[str]) -> Run:
        runs.append((name, asked))
        return BUSY
    monkeypatch.setattr('suite.run', pretend)
    assert main(['test/nodes']) == 3
    assert [name for name, _ in runs] == ['test', 'test-again']
    assert runs[1] == ('test-again', ['a', 'b'])
    assert capsys.readouterr().out.splitlines()[-1].startswith('too busy: ')

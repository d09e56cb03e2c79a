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

"""Work on a Dask cluster: the same files as here, and plain words where there is none."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

from bag_excerpts import excerpt
import pytest

from flock_desk import evaluate, flights
from flock_desk.runs.processes import computed

SCENARIOS = {'mine.yaml': '', 'flock.yaml': 'flock: {followers: 2, words: true}\n'}


def test_without_dask_it_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.partition('.')[0] == 'distributed':
            raise ImportError('No module named distributed')
        return real(name, *rest)

    monkeypatch.setattr(builtins, '__import__', without)
    with pytest.raises(RuntimeError, match=r'pip install .flock_follower\[cluster\]'):
        list(computed(str, [1], scheduler='tcp://127.0.0.1:1'))


@pytest.mark.ros
def test_a_cluster_writes_the_same_files_as_this_process(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip('distributed')
    monkeypatch.setattr('flock_desk.flights.CHUNK', 2)
    for name, text in SCENARIOS.items():
        (tmp_path / name).write_text(f'summary: s\nduration: 3\nleader: {{motion: legs}}\n{text}')
    scenarios = [str(tmp_path / name) for name in SCENARIOS]
    bags = [str(excerpt(tmp_path / name)) for name in ('first', 'second')]
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True,
                                  dashboard_address=None, host='127.0.0.1') as cluster:
        address = cluster.scheduler_address
        assert list(computed(abs, range(-40, 0), scheduler=address)) == list(range(40, 0, -1))
        with pytest.raises(ZeroDivisionError):
            list(computed((1).__truediv__, [1, 0], scheduler=address))
        for where, options in (('here', []), ('there', ['--scheduler', address])):
            out = ['--output', str(tmp_path / where), *options]
            assert flights.main(['--scenario', *scenarios, '--runs', '5', '--jobs', '1',
                                 *out]) == 0
            assert evaluate.main([*bags, *out]) == 0
    for name in ('flights.json', 'first/result.mcap', 'second/result.mcap'):
        here, there = ((tmp_path / where / name).read_bytes() for where in ('here', 'there'))
        assert here == there, name


@pytest.mark.ros
def test_missing_scheduler_is_a_message_not_a_traceback(
        monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('distributed')
    monkeypatch.setattr('flock_desk.runs.processes.SCHEDULER_TIMEOUT', 1.0)
    with pytest.raises(OSError, match='--scheduler tcp://127.0.0.1:9: no scheduler answers'):
        list(computed(str, [1], scheduler='tcp://127.0.0.1:9'))


def test_evaluate_takes_several_bags_but_not_two_of_one_name(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bags = [str(tmp_path / name) for name in ('one.mcap', 'two.mcap')]
    assert evaluate.main([*bags, '--output', str(tmp_path / 'out')]) == 2
    assert capsys.readouterr().err.count('error: ') == 2
    with pytest.raises(SystemExit):
        evaluate.main([bags[0], str(tmp_path / 'other' / 'one.mcap')])
    assert 'one.mcap: bags of one name' in capsys.readouterr().err

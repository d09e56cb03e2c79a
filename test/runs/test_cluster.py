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

"""Campaigns on a Dask cluster: the same figures as here, and plain words where there is none."""

from __future__ import annotations

import builtins
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bag_excerpts import excerpt
import pytest

from flock_desk import evaluate
from flock_desk.flights import main
from flock_desk.runs.processes import computed

SHORT = 'summary: short\nduration: 3\nleader: {motion: legs}\n'


def test_without_dask_it_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.partition('.')[0] == 'distributed':
            raise ImportError('No module named distributed')
        return real(name, *rest)

    monkeypatch.setattr(builtins, '__import__', without)
    with pytest.raises(RuntimeError, match=r'pip install .flock_follower\[cluster\]'):
        list(computed(str, [1], scheduler='tcp://127.0.0.1:1'))


@pytest.fixture(scope='module')
def cluster() -> Iterator[Any]:
    """Return a cluster of two processes on this machine."""
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True,
                                  dashboard_address=None, host='127.0.0.1') as found:
        yield found


@pytest.mark.ros
def test_results_come_in_the_order_of_their_tasks(cluster: Any) -> None:
    address = cluster.scheduler_address
    assert list(computed(abs, range(-40, 0), scheduler=address)) == list(range(40, 0, -1))
    with pytest.raises(ZeroDivisionError):
        list(computed((1).__truediv__, [1, 0], scheduler=address))


@pytest.mark.ros
def test_a_cluster_writes_the_same_file_as_this_process(
        cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('flock_desk.flights.CHUNK', 2)
    mine, flock = tmp_path / 'mine.yaml', tmp_path / 'flock.yaml'
    mine.write_text(SHORT)
    flock.write_text(SHORT + 'flock: {followers: 2, words: true}\n')
    texts = []
    for name, where in (('here', ['--jobs', '1']),
                        ('there', ['--scheduler', cluster.scheduler_address])):
        assert main(['--scenario', str(mine), str(flock), '--runs', '5', *where,
                     '--output', str(tmp_path / name)]) == 0
        texts.append((tmp_path / name / 'flights.json').read_text())
    assert texts[0] == texts[1]


@pytest.mark.ros
def test_where_no_scheduler_answers_it_is_a_message_not_a_traceback(
        tmp_path: Path, capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('distributed')
    monkeypatch.setattr('flock_desk.runs.processes.SCHEDULER_TIMEOUT', 1.0)
    assert main(['--scenario', 'hover', '--runs', '1', '--scheduler', 'tcp://127.0.0.1:9',
                 '--output', str(tmp_path)]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith('error: --scheduler tcp://127.0.0.1:9: no scheduler answers there')


def test_evaluate_takes_several_bags_but_not_two_of_one_name(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bags = [str(tmp_path / name) for name in ('one.mcap', 'two.mcap')]
    assert evaluate.main([*bags, '--output', str(tmp_path / 'out')]) == 2
    assert capsys.readouterr().err.count('error: ') == 2
    with pytest.raises(SystemExit):
        evaluate.main([bags[0], str(tmp_path / 'other' / 'one.mcap')])
    assert 'one.mcap: bags of one name' in capsys.readouterr().err


@pytest.mark.ros
def test_a_cluster_evaluates_bags_as_this_process_does(cluster: Any, tmp_path: Path) -> None:
    bags = [excerpt(tmp_path / name) for name in ('first', 'second')]
    texts = []
    for name, where in (('here', []), ('there', ['--scheduler', cluster.scheduler_address])):
        out = tmp_path / name
        assert evaluate.main([*map(str, bags), *where, '--output', str(out)]) == 0
        texts.append([(out / bag.name / 'result.mcap').read_bytes() for bag in bags])
    assert texts[0] == texts[1]

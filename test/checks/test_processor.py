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
"""The load of a machine: which waiting for a processor counts, and from when on it is too busy."""

from __future__ import annotations

from pathlib import Path
import shutil

import pytest

from flock_follower.checks.processor import (
    BUSY_SHARE,
    children,
    Load,
    LOAD_WINDOW,
    LoadMeter,
    longest_wait,
    read_counters,
    stopped,
    waits_of,
)

TICK = 0.01  # s of /proc/stat


class Kernel:
    """A folder like /proc, of a machine with two processors and more that are not ours."""

    def __init__(self, proc: Path) -> None:
        self.proc, self.time, self.used, self.ended = proc, 0.0, 0.0, 0.0
        self.threads: dict[tuple[int, int], list[float]] = {}
        self.ended_threads: dict[int, float] = {}  # s that they ran, by their process

    def run(self, seconds: float, others: float, **shares: tuple[float, float]) -> None:
        """
        Let time pass.

        :param others: processors that other programs use.
        :param shares: of the threads, named p7_1: for which they run, and wait.
        """
        self.time += seconds
        self.used += others * seconds
        for name, (ran, waited) in shares.items():
            process, thread = map(int, name.removeprefix('p').split('_'))
            counted = self.threads.setdefault((process, thread), [0.0, 0.0])
            counted[0] += ran * seconds
            counted[1] += waited * seconds
            self.used += ran * seconds
        for (process, thread), (run, wait) in self.threads.items():
            folder = self.proc / str(process) / 'task' / str(thread)
            folder.mkdir(parents=True, exist_ok=True)
            (folder / 'schedstat').write_text(f'{round(1e9 * run)} {round(1e9 * wait)} 3\n')
        for process in {process for process, _ in self.threads}:
            ran = self.ended_threads.get(process, 0.0) + sum(
                run for (owner, _), (run, _) in self.threads.items() if owner == process)
            (self.proc / str(process) / 'stat').write_text(
                f'{process} (a b) c) S {"7 " * 10}{round(ran / TICK)} 0 0 0\n')
        half = round(0.5 * self.used / TICK)
        idle = round(2.0 * self.time / TICK) - 2 * half
        self.proc.mkdir(exist_ok=True)
        (self.proc / 'stat').write_text(
            f'cpu  9 9 9 9 9 9 9 9 0 0\ncpu0 {half} 0 0 {idle} 0 0 0 0 0 0\n'
            f'cpu1 0 {half} 0 {idle} 7 0 0 0 0 0\ncpu2 {round(self.time / TICK)} 0 0 0 0 0 0 0\n'
            'intr 1 2 3\n')

    def end_thread(self, process: int, thread: int) -> None:
        """End a thread: its process keeps its processor time."""
        ran, _ = self.threads.pop((process, thread))
        self.ended_threads[process] = self.ended_threads.get(process, 0.0) + ran
        shutil.rmtree(self.proc / str(process) / 'task' / str(thread))

    def end(self, process: int) -> None:
        """End a process: its parent has its processor time from then on."""
        for owner, thread in list(self.threads):
            if owner == process:
                self.end_thread(owner, thread)
        self.ended += self.ended_threads.pop(process)
        shutil.rmtree(self.proc / str(process))


@pytest.fixture
def kernel(tmp_path: Path) -> Kernel:
    return Kernel(tmp_path / 'proc')


def measured(kernel: Kernel, seconds: float, others: float,
             **shares: tuple[float, float]) -> Load | None:
    """Return the worst load of some seconds, of the processes 7 and 8."""
    meter = LoadMeter(lambda: [7, 8], kernel.proc, (0, 1))
    kernel.run(100.0, 2.0, p7_1=(0.0, 1.0))  # before it is measured
    meter.sample(kernel.time)
    for _ in range(round(2 * seconds)):
        kernel.run(0.5, others, **shares)
        meter.sample(kernel.time)
    return meter.worst()


def test_only_waiting_for_other_programs_counts(kernel: Kernel) -> None:
    alone = measured(kernel, 4.0, 0.0, p7_1=(1.0, 0.5), p8_1=(1.0, 0.5))
    assert alone == pytest.approx((0.0, 0.0, 2), abs=0.01) and not alone.busy


def test_the_share_is_that_of_waiting_times_that_of_the_others(kernel: Kernel) -> None:
    load = measured(kernel, 4.0, 1.5, p7_1=(0.3, 0.6), p8_1=(0.2, 0.4))
    # They wait for 2/3 of their time, and the others use 3/4 of the processors.
    assert load == pytest.approx((0.5, 1.5, 2), abs=0.01) and load.busy
    assert str(load).startswith('for 50% of the worst 2 s the processes waited for a processor')
    assert '(1.5 of 2 processors)' in str(load)


def test_programs_that_leave_a_processor_free_disturb_none(kernel: Kernel) -> None:
    load = measured(kernel, 4.0, 1.0, p7_1=(0.5, 0.02))
    assert load is not None and load.others == pytest.approx(1.0, abs=0.02) and not load.busy


@pytest.mark.parametrize(('share', 'busy'),
                         [(BUSY_SHARE - 0.01, False), (BUSY_SHARE + 0.01, True)])
def test_it_is_busy_from_a_share_on(share: float, busy: bool) -> None:
    assert Load(share, 1.0, 2).busy == busy


def test_one_busy_window_is_enough_and_those_before_do_not_count(kernel: Kernel) -> None:
    meter = LoadMeter(lambda: [7], kernel.proc, (0, 1))
    for second in range(20):
        burst = second in (8, 9)
        kernel.run(1.0, 1.5 if burst else 0.0, p7_1=(0.5, 0.5 if burst else 0.0))
        meter.sample(kernel.time)
    worst = meter.worst()
    assert worst is not None and worst.share == pytest.approx(0.375, abs=0.01)
    later = meter.worst(11.5 + LOAD_WINDOW)
    assert later is not None and later.share == pytest.approx(0.0, abs=1e-6)


def test_new_thread_counts_from_start_and_ended_one_no_more(kernel: Kernel) -> None:
    kernel.run(1.0, 0.0, p7_1=(0.1, 0.0), p7_2=(0.1, 0.9))
    meter = LoadMeter(lambda: [7], kernel.proc, (0, 1))
    meter.sample(kernel.time)
    kernel.end_thread(7, 2)
    kernel.run(2.0, 1.5, p7_1=(0.25, 0.0), p7_3=(0.25, 0.5))
    meter.sample(kernel.time)
    worst = meter.worst()
    assert worst is not None and worst.share == pytest.approx(0.5 * 0.75, abs=0.01)


@pytest.mark.parametrize(('before', 'others', 'expected'), [
    (False, (0.0, 0.0), (0.0, 0.0, 2)), (True, (0.0, 0.0), (0.0, 0.0, 2)),
    # They run for 0.75 of 2 processors and wait for half their time; the others use 1.25.
    (True, (1.0, 1.5), (0.5 * 1.25 / 2.0, 1.25, 2))],
    ids=['started in the window', 'ran before', 'beside another program'])
def test_a_child_that_ends_is_no_other_program(
        kernel: Kernel, before: bool, others: tuple[float, float],
        expected: tuple[float, float, int]) -> None:
    meter = LoadMeter(lambda: [7, 8], kernel.proc, (0, 1), lambda: kernel.ended)
    child = {'p8_1': (0.5, 0.0)}
    kernel.run(1.0, 0.0, p7_1=(0.5, 0.5), **(child if before else {}))
    meter.sample(kernel.time)
    kernel.run(1.0, others[0], p7_1=(0.5, 0.5), **child)
    kernel.end(8)
    kernel.run(1.0, others[1], p7_1=(0.5, 0.5))
    meter.sample(kernel.time)
    worst = meter.worst()
    assert worst == pytest.approx(expected, abs=0.01)


def test_without_the_kernels_counters_the_load_is_unknown(tmp_path: Path, kernel: Kernel) -> None:
    assert read_counters([7], 0.0, tmp_path / 'nowhere', (0,)) is None
    kernel.run(1.0, 0.0)
    assert read_counters([7], 0.0, kernel.proc, (0,)) is None  # no such process
    kernel.run(1.0, 0.0, p7_1=(0.5, 0.0))
    (kernel.proc / 'stat').unlink()
    meter = LoadMeter(lambda: [7], kernel.proc, (0,))
    for time in range(5):
        meter.sample(float(time))
    assert meter.worst() is None


def test_the_longest_wait_is_that_of_one_thread(kernel: Kernel) -> None:
    kernel.run(1.0, 0.0, p7_1=(0.0, 0.5))
    before = waits_of(7, kernel.proc)
    kernel.run(1.0, 0.0, p7_1=(0.0, 0.25), p7_2=(0.0, 0.75))
    assert longest_wait(before, waits_of(7, kernel.proc)) == pytest.approx(0.75)
    assert longest_wait(before, {}) == 0.0


@pytest.mark.parametrize(('state', 'expected'), [('T', True), ('t', True), ('S', False)])
def test_a_stopped_process_is_recognized_whatever_its_name(
        tmp_path: Path, state: str, expected: bool) -> None:
    (tmp_path / '7').mkdir()
    (tmp_path / '7' / 'stat').write_text(f'7 (a) T b) {state} 1 7 7 0\n')
    assert stopped(7, tmp_path) == expected and not stopped(8, tmp_path)


def test_the_children_are_those_of_every_thread(tmp_path: Path) -> None:
    for thread, text in ((6, '7 8 '), (9, '10')):
        (tmp_path / '6' / 'task' / str(thread)).mkdir(parents=True)
        (tmp_path / '6' / 'task' / str(thread) / 'children').write_text(text)
    assert sorted(children(6, tmp_path)) == [7, 8, 10] and children(5, tmp_path) == []

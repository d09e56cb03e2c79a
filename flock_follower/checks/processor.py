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
Whether the machine was too busy: measures how long processes waited for a processor.

The kernel counts for each thread the time in which it ran, and in which it was ready and waited
(``/proc/PID/task/TID/schedstat``). Processes that work together wait for each other, on a quiet
machine, too. So only the share of the waiting that other programs caused counts (``/proc/stat``).
The processor time of a child that has ended comes from ``getrusage``. The files also exist in a
container. Without these files the load is unknown, and every bound is judged.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
import contextlib
import os
from pathlib import Path
import resource
from typing import Final, NamedTuple

#: Share of LOAD_WINDOW for which processes wait for a processor that others have; busy above it.
#: Of `demo` and `fly` on two processors: 0.01 to 0.09 alone, 0.2 beside two busy programs.
BUSY_SHARE: Final = 0.1
LOAD_WINDOW: Final = 2.0  # s: a shorter burst breaks no bound, or shows in it
LOAD_PERIOD: Final = 0.5  # s between two readings, at least
PROC: Final = Path('/proc')
_TICK: Final = 1.0 / os.sysconf('SC_CLK_TCK')  # s


class Counters(NamedTuple):
    """Readings at one time, s: the waiting of each thread, ns, by its file; other values in s."""

    time: float
    waited: Mapping[Path, int]
    ran: Mapping[int, float]
    """Processor time of each process that has not ended, s, with that of its ended threads."""
    ended: float
    """Processor time of all children that have ended, s."""
    machine: float
    """Processor time of all programs, s, on the processors that these processes may use."""


class Load(NamedTuple):
    """The waiting of some processes over some time."""

    share: float
    """Share of the waiting for a processor that other programs used."""
    others: float
    """Number of processors that other programs used."""
    processors: int
    """Number of processors that these processes may use."""

    @property
    def busy(self) -> bool:
        """Return whether the load was too high to judge the times measured meanwhile."""
        return self.share > BUSY_SHARE

    def __str__(self) -> str:
        """Return the cause and the share, in words."""
        return (f'for {self.share:.0%} of the worst {LOAD_WINDOW:g} s the processes waited for a '
                f'processor that other programs had ({self.others:.1f} of {self.processors} '
                'processors)')


def waits_of(process: int, proc: Path = PROC) -> dict[Path, int]:
    """Return ns waited of each thread; empty if the process has ended."""
    found = {}
    for path in proc.glob(f'{process}/task/*/schedstat'):
        with contextlib.suppress(OSError, ValueError, IndexError):  # it has ended meanwhile
            found[path] = int(path.read_text(encoding='ascii').split()[1])
    return found


def _status_of(process: int, proc: Path) -> list[str]:
    """Return the fields of ``stat`` after the name, the state first; none without a process."""
    with contextlib.suppress(OSError):
        stat = (proc / str(process) / 'stat').read_text(encoding='utf-8', errors='replace')
        return stat.rpartition(')')[2].split()  # the name may hold anything
    return []


def ran_for(process: int, proc: Path = PROC) -> float:
    """Return the processor time of a process, s; 0 if it has ended."""
    return _TICK * sum(map(int, _status_of(process, proc)[11:13]))


def ended_children_ran_for() -> float:
    """Return the processor time, s, of all children of this process that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def children(process: int, proc: Path = PROC) -> list[int]:
    """Return the ids of the children of a process."""
    found: list[int] = []
    for path in proc.glob(f'{process}/task/*/children'):
        with contextlib.suppress(OSError, ValueError):
            found += map(int, path.read_text(encoding='ascii').split())
    return found


def stopped(process: int, proc: Path = PROC) -> bool:
    """Return whether a process was stopped by a signal or a debugger; no load explains that."""
    return _status_of(process, proc)[:1] in (['T'], ['t'])


def longest_wait(before: Mapping[Path, int], after: Mapping[Path, int]) -> float:
    """Return the longest time, s, that a thread waited between two readings."""
    return max(_waits(before, after), default=0.0)


def _waits(before: Mapping[Path, int], after: Mapping[Path, int]) -> list[float]:
    """Return the time, s, that each thread waited between two readings."""
    return [1e-9 * (waited - before.get(path, 0)) for path, waited in after.items()]


def read_counters(process_ids: Iterable[int], now: float, proc: Path = PROC,
                  usable: Iterable[int] | None = None, ended: float = 0.0) -> Counters | None:
    """
    Return the counters of some processes and of the machine, None if the kernel has none.

    :param now: s. :param usable: numbers of the processors; by default those of this process.
    :param ended: the processor time, s, of all children of this process that have ended.
    """
    process_ids = list(process_ids)
    waited = {path: time for process in process_ids
              for path, time in waits_of(process, proc).items()}
    names = {f'cpu{number}' for number in (
        os.sched_getaffinity(0) if usable is None else usable)}
    ticks = 0
    try:
        for line in (proc / 'stat').read_text(encoding='ascii').splitlines():
            name, *fields = line.split()
            if name in names:
                # user nice system idle iowait irq softirq steal; guests are in user.
                ticks += sum(map(int, fields[:3])) + sum(map(int, fields[5:8]))
    except (OSError, ValueError):
        return None
    ran = {process: time for process in process_ids if (time := ran_for(process, proc))}
    return Counters(now, waited, ran, ended, ticks * _TICK) if waited else None


def load_between(before: Counters, after: Counters, processors: int) -> Load:
    """Return the load between two readings; a thread only in the second reading is new."""
    waited = sum(_waits(before.waited, after.waited))
    ran = sum(ran - before.ran.get(process, 0.0) for process, ran in after.ran.items())
    gone = sum(ran for process, ran in before.ran.items() if process not in after.ran)
    # A process that is not our child and has ended counts as another program.
    ours = ran + max(after.ended - before.ended - gone, 0.0)
    others = max(after.machine - before.machine - ours, 0.0)
    share = waited / (ran + waited) * others / (others + ours) if waited > 0.0 else 0.0
    return Load(share, others / max(after.time - before.time, 1e-9), processors)


class LoadMeter:
    """
    Measures the load of some processes, window by window.

    :param find_ids: returns their ids.
    :param proc: the folder of the kernel's process files.
    :param usable: numbers of the processors; by default those of this process.
    :param ended: returns the processor time, s, of all children that have ended.
    """

    def __init__(self, find_ids: Callable[[], Iterable[int]], proc: Path = PROC,
                 usable: Iterable[int] | None = None,
                 ended: Callable[[], float] = ended_children_ran_for) -> None:
        self._find_ids, self._proc, self._ended = find_ids, proc, ended
        self._usable = tuple(os.sched_getaffinity(0) if usable is None else usable)
        self._recent: deque[Counters] = deque()
        self._windows: list[tuple[float, Load]] = []

    def sample(self, now: float) -> None:
        """Read the counters at a time, s; ignore a call within LOAD_PERIOD of the last reading."""
        if self._recent and now - self._recent[-1].time < LOAD_PERIOD:
            return
        counters = read_counters(
            self._find_ids(), now, self._proc, self._usable, self._ended())
        if counters is None:
            return
        self._recent.append(counters)
        while len(self._recent) > 1 and now - self._recent[1].time >= LOAD_WINDOW:
            self._recent.popleft()
        if now - self._recent[0].time >= LOAD_WINDOW:
            self._windows.append((now, load_between(
                self._recent[0], counters, len(self._usable))))

    def worst(self, since: float = 0.0) -> Load | None:
        """Return the load of the worst window that ended after a time, s; None if unknown."""
        return max((load for time, load in self._windows if time >= since), default=None)

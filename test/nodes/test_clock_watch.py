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

"""Stamps and ages while the system clock is set."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.nodes.support.clock_watch import ClockWatch, ON_THE_WAY

START = 1_700_000_000 * 10**9  # ns
SECOND = 10**9  # ns
STEPS = [-5.0, -0.3, 0.3, 5.0, 3600.0]  # s by which the clock is set


def clocks(seconds: float, step: float = 0.0) -> tuple[int, float]:
    """Return system and monotonic clock so many seconds after the start."""
    return START + round((seconds + step) * SECOND), 100.0 + seconds


def test_slewed_or_late_clock_does_not_count_as_set() -> None:
    watch, rng = ClockWatch(), np.random.default_rng(1)
    for tick in range(1000):
        system, monotonic = clocks(0.1 * tick, 0.0005 * tick)  # 5 ms per second
        assert watch.take(system + int(rng.uniform(0.0, 0.02) * SECOND), monotonic) == 0.0
    assert watch.clock_shift == 0


@pytest.mark.parametrize('step', STEPS)
def test_stamps_before_a_step_are_known_while_they_may_come(step: float) -> None:
    watch = ClockWatch()
    for tick in range(11):
        watch.take(*clocks(0.1 * tick))
    # It was set some time in the last 0.1 s.
    assert watch.take(*clocks(1.1, step)) == pytest.approx(step)
    assert watch.clock_shift == pytest.approx(step * SECOND, abs=2)
    for late in (0.01, 0.05):
        assert watch.before_step(clocks(1.0 - late)[0])
    for seconds in (1.101, 1.2, 2.0, 3.0):
        watch.take(*clocks(seconds, step))
        stamp = clocks(seconds - 0.001, step)[0]
        assert not watch.before_step(stamp)
    watch.take(*clocks(1.2 + ON_THE_WAY, step))
    assert not watch.before_step(clocks(1.0)[0])  # its age says enough by now
    assert not watch.before_step(0)

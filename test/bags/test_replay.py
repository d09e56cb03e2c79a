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

"""The arithmetic of playback: what falls due when, through pauses, rates, jumps and stalls."""

import math

from hypothesis import given
from hypothesis import strategies as st
import pytest

from flock_follower.bags.schedule import Gaps, section, Timeline

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000


def test_position_and_due_follow_the_rate_from_the_beginning_on():
    timeline = Timeline(START, rate=2.0, now=100.0)
    assert timeline.position(100.0) == START
    assert timeline.position(101.5) == START + 3 * SECOND
    assert timeline.due(START + 3 * SECOND) == 101.5
    timeline.jump(START, 200.0)
    assert timeline.position(150.0) == START


@pytest.mark.parametrize('began', [False, True])
def test_a_pause_holds_the_position_and_nothing_falls_due(began):
    timeline = Timeline(START, rate=1.0, now=0.0)
    for now in (2.0 * began, 60.0):  # twice is once
        timeline.change(now, 1.0, True)
    position = START + 2 * SECOND * began
    assert timeline.position(50.0) == position
    assert timeline.due(START) == math.inf
    timeline.change(100.0, 1.0, False)
    assert timeline.position(100.0) == position
    assert timeline.due(position + SECOND) == pytest.approx(101.0)


def test_a_new_rate_applies_from_where_it_was():
    timeline = Timeline(START, rate=1.0, now=0.0)
    timeline.change(2.0, 10.0, False)
    assert timeline.position(2.0) == START + 2 * SECOND
    assert timeline.due(START + 12 * SECOND) == pytest.approx(3.0)


def test_a_small_delay_is_caught_up_and_a_stall_is_not():
    timeline = Timeline(START, rate=1.0, now=0.0)
    timeline.limit_lateness(START + SECOND, 1.3, limit=0.5)
    assert timeline.due(START + 2 * SECOND) == 2.0
    timeline.limit_lateness(START + 2 * SECOND, 12.0, limit=0.5)
    assert timeline.due(START + 3 * SECOND) == pytest.approx(13.0)


@given(rate=st.floats(0.1, 100.0), offset_ns=st.integers(0, 3600 * SECOND),
       now=st.floats(0.0, 1e6))
def test_due_undoes_position_to_a_microsecond_of_wall_time(rate, offset_ns, now):
    timeline = Timeline(START, rate, now)
    due = timeline.due(START + offset_ns)
    assert abs(timeline.position(due) - START - offset_ns) <= 1e-6 * rate * SECOND + 1


@given(rate=st.floats(0.1, 100.0), waits=st.lists(st.floats(0.0, 0.01), max_size=50))
def test_late_waits_never_add_up(rate, waits):
    timeline = Timeline(START, rate, 0.0)
    for i, late in enumerate(waits):
        timeline.limit_lateness(START + i * SECOND, timeline.due(START + i * SECOND) + late, 0.5)
    assert timeline.due(START + 100 * SECOND) == pytest.approx(100.0 / rate, abs=1e-9)


def test_the_part_to_play_is_within_the_bag():
    end = START + 10 * SECOND
    assert section(START, end, 2.5, 0.0) == (START + 2_500_000_000, end + 1)
    assert section(START, end, 2.0, 3.0) == (START + 2 * SECOND, START + 5 * SECOND)
    assert section(START, end, 10.0, 9.0) == (end, end + 1)
    for start in (10.5, math.nan):
        with pytest.raises(ValueError, match=r'start = (10.5|nan): must be in \[0, 10\] s'):
            section(START, end, start, 0.0)


def test_a_step_of_more_than_5_s_either_way_is_a_gap():
    gaps, found = Gaps(START), []
    for stamp in (0, 4_900_000_000, 9_900_000_000, 15_000_000_000, -3_600_000_000_000, 0):
        found.append(gaps.take(START + stamp))
    assert found == [0.0, 0.0, 0.0, 5.1, -3615.0, 3600.0]
    assert gaps.skipped_ns == -9_900_000_000
    assert Gaps().take(START) == 0.0

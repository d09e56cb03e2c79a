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

"""One node that commands, one that takes its place, and two at once."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from flock_follower.mavlink.flight_end import CommandSources, FELL_SILENT_AFTER

PERIOD = 0.1  # s, the planner's
FIRST = st.one_of(st.integers(1, 40), st.integers(1, 10**6))
"""What a publisher has counted when we first hear it."""


def noticed(commands: list[tuple[float, int]]) -> list[float]:
    """Return when it was noticed that two command."""
    sources = CommandSources()
    return [time for time, number in sorted(commands) if sources.another(number, time)]


def publisher(first: int, begin: float, late: list[float], lost: set[int] = frozenset(),
              period: float = PERIOD) -> list[tuple[float, int]]:
    """Return times, s, and numbers of commands that come up to so late, some of them not."""
    return [(begin + k * period + delay, first + k) for k, delay in enumerate(late)
            if k not in lost]


JITTER = st.lists(st.floats(0.0, 0.08), min_size=16, max_size=24)


@given(first=FIRST, late=JITTER, lost=st.sets(st.integers(0, 40), max_size=20))
def test_one_publisher_is_one_however_many_of_its_commands_are_lost(first, late, lost):
    assert not noticed(publisher(first, 0.0, late, lost))


@given(lives=st.lists(st.tuples(FIRST, JITTER, st.floats(FELL_SILENT_AFTER, 20.0)), min_size=2,
                      max_size=4))
def test_a_planner_that_starts_again_is_no_second_one(lives):
    commands: list[tuple[float, int]] = []
    for first, late, pause in lives:
        begin = commands[-1][0] + pause + 1e-6 if commands else 0.0
        commands += publisher(first, begin, late)
    assert not noticed(commands)


@given(number=FIRST, own=FIRST, late=JITTER, at=st.floats(0.1, 1.5))
def test_a_single_command_of_a_second_node_is_noticed(number, own, late, at):
    found = noticed([*publisher(own, 0.0, late), (at, number)])
    assert found and at <= found[0] < at + 2 * PERIOD


def test_where_the_middleware_does_not_number_messages_nothing_is_noticed():
    sources = CommandSources()
    assert not any(sources.another(None, 0.01 * k) for k in range(10))

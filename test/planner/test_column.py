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

"""A column of followers: each sees only the vehicle ahead, and the leader comes back."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
import math

from flown import Follower, PARAMS, seen
import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.params import COLUMN_V_MAX, FOLLOWER, LEADER, Member

BEGIN, FORWARD, BACK = 10, 60, 50  # ticks of 0.1 s: hover, flight ahead, flight back
LATE = 2  # ticks by which an estimate is old
LAG = 0.3  # s
MARGIN = 1.38  # m: the near edge of the band and the margin m


def least_distances(v_max: float, count: int) -> Array:
    """
    Return the least distance, m, between each of the followers and the one ahead.

    The leader goes at 0.8 ``v_max`` and comes back at 0.9 ``v_max``, with 1 m/s^2.
    """
    params = replace(PARAMS, v_max=v_max)
    followers = [Follower(replace(params, vehicles={'ahead': Member(FOLLOWER if k else LEADER)}),
                          LAG) for k in range(count)]
    place, speed, past = 0.0, 0.0, deque[list[Array]](maxlen=LATE + 1)
    for k, each in enumerate(followers, 1):
        each.position = np.array([-1.8 * k, 0.0, 2.0])
    least = np.full(count, np.inf)
    for tick in range(BEGIN + FORWARD + BACK):
        wanted = 0.0 if tick < BEGIN else (0.8 if tick < BEGIN + FORWARD else -0.9) * v_max
        changed = float(np.clip(wanted - speed, -0.1, 0.1))
        place, speed = place + 0.1 * (speed + 0.5 * changed), speed + changed
        past.append([np.array([[place, 0.0, 2.0], [speed, 0.0, 0.0], [10.0 * changed, 0.0, 0.0]]),
                     *(np.stack([each.position, each.velocity, each.acceleration])
                       for each in followers)])
        for k, each in enumerate(followers):
            position, velocity, acceleration = past[0][k]
            stamp = max(each.now - 0.1 * LATE, 0.0)
            each.tick(seen(stamp, position, velocity, 'ahead', acceleration=acceleration))
        least = np.minimum(least, -np.diff([place, *(each.position[0] for each in followers)]))
    return least


def test_column_of_six_keeps_margins_if_leader_returns() -> None:
    assert least_distances(COLUMN_V_MAX, 6)[1:].min() >= MARGIN


def test_a_faster_column_is_refused() -> None:
    vehicles = {'ahead': Member(FOLLOWER)}
    assert replace(PARAMS, v_max=COLUMN_V_MAX, vehicles=vehicles).v_max == COLUMN_V_MAX
    with pytest.raises(ValueError, match='must be at most 1 m/s beside other followers: ahead'):
        replace(PARAMS, v_max=1.01, vehicles=vehicles)


def test_one_lost_behind_a_follower_in_sight_pushes_nobody_back() -> None:
    """A glimpse of the vehicle beyond: the one ahead is between."""
    vehicles = {'ahead': Member(FOLLOWER), 'leader': Member(LEADER)}
    params = replace(PARAMS, v_max=COLUMN_V_MAX, vehicles=vehicles)
    alone, both = (Follower(params) for _ in range(2))
    for tick in range(20):
        glimpse = [seen(both.now, (4.5, 0.0, 2.0), name='leader')] if tick < 3 else []
        alone.tick(seen(alone.now, (2.4, 0.0, 2.0), name='ahead'))
        both.tick(seen(both.now, (2.4, 0.0, 2.0), name='ahead'), *glimpse)
    assert both.position == pytest.approx(alone.position, abs=0.05)


@pytest.mark.parametrize('start', [(4.4, 2.2), (4.9, 0.0)], ids=['beside', 'behind'])
def test_lost_coming_one_is_kept_clear_of_beside_one_in_sight(
        start: tuple[float, float]) -> None:
    """One in sight that is nearer to both hides a vehicle only on the line of sight to it."""
    vehicles = {'ahead': Member(FOLLOWER), 'leader': Member(LEADER)}
    params = replace(PARAMS, v_max=COLUMN_V_MAX, vehicles=vehicles)
    follower, least = Follower(params, LAG), math.inf
    place = np.array([*start, 2.0])
    velocity = -0.9 * np.array([*start, 0.0]) / math.hypot(*start)
    for tick in range(40):
        leader = [seen(follower.now, place, velocity, 'leader')] if tick < 22 else []
        follower.tick(seen(follower.now, (2.5, 0.0, 2.0), name='ahead'), *leader)
        place = place + 0.1 * velocity
        least = min(least, math.dist(place, follower.position))
    assert least >= 2.0

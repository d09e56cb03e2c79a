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

"""What a page shows of the newest messages, and that what is old is shown as old."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from flock_follower.geometry import quaternion_from_rpy, quaternion_to_matrix
from flock_follower.messages import OdometryState, RELATIVE
from flock_follower.messages.commands import Command
from flock_follower.view.flight import (
    clean,
    from_above,
    HISTORY_LENGTH,
    LIMITS,
    LOST,
    NEIGHBORS_MAX,
    NEVER,
    NodeReport,
    shadow,
    ShownBattery,
    ShownFlight,
)
from flock_follower.view.scene import BOX, ELLIPSOID, Shape

NOW = 1000.0
PLANNER = {'state': 'TRACK', 'reason': '', 'engaged': 'True', 'limits': 'a_max, cohesion',
           'nearest_m': '1.06', 'farthest_m': '2.89', 'edges': 'leader'}


def state(child: str = 'leader', position: Any = (2.0, 0.0, 1.5), velocity: Any = (0.0, 0.0, 0.0),
          stamp: int = 0, frame: str = 'odom') -> OdometryState:
    return OdometryState(stamp, frame, child, np.array(position), quaternion_from_rpy(0, 0, 0),
                         np.array(velocity), np.zeros(3), 0.01 * np.eye(6), 0.01 * np.eye(6),
                         np.eye(3))


def flight(**planner: str) -> ShownFlight:
    """Return a flight in TRACK behind a leader, everything of it received now."""
    made = ShownFlight()
    made.take_odometry(state('base_link', (0.0, 0.0, 1.5)), NOW)
    made.take_neighbor(state(), NOW)
    made.take_command(Command(np.array([0.2, 0.0, 0.0]), 0.0), NOW)
    made.take_state(planner.get('state', 'TRACK'))
    made.take_bridge('ACTIVE', NOW)
    made.take_report('planner', NodeReport(NOW, 0, 'running', {**PLANNER, **planner}))
    made.take_report('relative_pose', NodeReport(NOW, 0, 'running', {'image_raw_hz': '30.00'}))
    made.take_report('mavlink_bridge', NodeReport(
        NOW, 0, 'running', {'autopilot': 'PX4', 'limited_by': 'v_max', 'setpoint': 'command'}))
    made.take_distance('leader', 2.0, NOW)
    made.take_battery(ShownBattery(NOW, 0.78, 15.8))
    made.note('image', NOW)
    return made


@pytest.mark.parametrize('word', ['IDLE', 'SEARCH', 'TRACK', 'COAST', 'HOLD', 'RELATIVE'])
def test_the_state_and_its_reason_are_those_of_the_planner(word: str) -> None:
    page = flight(state=word, reason='why').page(NOW)
    assert (page['state'], page['reason']) == (word, 'why')


def test_a_reason_of_the_state_before_is_not_shown() -> None:
    made = flight(state='TRACK', reason='tracking')
    made.take_state('HOLD')
    assert (made.page(NOW)['state'], made.page(NOW)['reason']) == ('HOLD', '')


def test_silent_planner_is_lost_whatever_its_latched_state() -> None:
    made = flight()
    assert made.page(NOW + LIMITS['planner'])['state'] == 'TRACK'
    page = made.page(NOW + LIMITS['planner'] + 0.1)
    assert (page['state'], page['band'], page['limits'], page['engaged']) == (LOST, None, '', '')
    assert ShownFlight().page(NOW)['state'] == NEVER


def test_a_bridge_that_is_silent_has_no_autopilot() -> None:
    made = flight()
    assert made.page(NOW + 0.9)['bridge']['state'] == 'ACTIVE'
    page = made.page(NOW + 1.1)
    assert page['bridge']['state'] == 'NO_AUTOPILOT' and page['bridge']['lost']
    assert 'for 1.1 s' in page['bridge']['reason']
    made.take_bridge('NO_AUTOPILOT: lost, ACTIVE', NOW + 1.2)
    assert not made.page(NOW + 1.2)['bridge']['lost']


def test_every_source_has_an_age_and_is_stale_after_its_limit() -> None:
    made = flight()
    for ahead, stale in ((0.0, set()), (0.7, {'odometry', 'estimate', 'distance', 'command'}),
                         (20.0, {*LIMITS})):
        ages = {source: (age, old) for source, age, old, _ in made.page(NOW + ahead)['ages']}
        assert ages.keys() == LIMITS.keys()
        assert {source for source, (_, old) in ages.items() if old} == stale
        assert {age for age, _ in ages.values()} == {ahead}
    assert all(age is None and old for _, age, old, _ in ShownFlight().page(NOW)['ages'])


def test_a_page_is_json_and_has_no_number_that_is_not_finite() -> None:
    made = flight()
    made.take_battery(ShownBattery(NOW, math.nan, math.inf))
    made.take_distance('leader', math.nan, NOW)
    for page in (made.page(NOW), ShownFlight().page(NOW), made.history(NOW)):
        json.dumps(page, allow_nan=False)
    assert made.page(NOW)['battery']['share'] is None
    assert made.page(NOW)['distance']['m'] == 2.0  # the last one that was known
    assert clean({'a': [math.inf, 'x' * 1000]}) == {'a': [None, 'x' * 400]}


def test_problems_come_worst_first_and_a_silent_node_is_one() -> None:
    made = flight()
    made.take_report('visualizer', NodeReport(NOW + 4.0, 1, 'slow', {}))
    made.take_report('planner', NodeReport(NOW + 4.0, 2, 'no tick', PLANNER))
    made.take_report('mavlink_bridge', NodeReport(NOW + 4.0, 0, 'running', {}))
    warnings = made.page(NOW + 4.0)['warnings']
    assert [(one['level'], one['node']) for one in warnings] == [
        ('error', 'planner'), ('error', 'relative_pose'), ('warn', 'visualizer')]


def test_the_history_is_that_of_the_last_minute() -> None:
    made = flight()
    for second in range(1, 100):
        made.take_distance('leader', float(second), NOW + second)
        made.take_odometry(state('base_link', (second, 0.0, 0.0)), NOW + second)
    history = made.history(NOW + 100.0)
    for times in ([t for t, _ in history['distances']], [t for t, *_ in history['tracks']['']]):
        assert min(times) >= NOW + 100.0 - HISTORY_LENGTH and max(times) == NOW + 99.0
    assert 'leader' not in history['tracks']  # not seen for that long


def test_a_flood_of_names_is_bounded() -> None:
    made = ShownFlight()
    for number in range(1000):
        made.take_neighbor(state(f'n{number}'), NOW)
    assert len(made.page(NOW)['neighbors']) == NEIGHBORS_MAX


def test_places_of_another_frame_are_forgotten() -> None:
    made = flight()
    assert made.take_odometry(state('base_link', frame=RELATIVE, stamp=1), NOW)
    assert made.page(NOW)['neighbors'] == {}
    assert not made.take_odometry(state('base_link', stamp=2), NOW)  # of less use


def test_image_shows_its_own_estimate_else_one_carried_to_it() -> None:
    made = ShownFlight()
    for k in range(3):
        made.take_neighbor(state(position=(2.0 + 0.1 * k, 0.0, 0.0), velocity=(1.0, 0.0, 0.0),
                                 stamp=k * 10**8), NOW)

    def drawn(stamp: float) -> tuple[float, str]:
        (box,) = (one for one in made.picture_scene(round(stamp * 1e9)) if one.kind == BOX)
        return float(np.asarray(box.position)[0]), box.paint
    assert drawn(0.1) == (pytest.approx(2.1), 'seen')
    assert drawn(0.3) == (pytest.approx(2.3), 'seen')
    assert drawn(1.0) == (pytest.approx(2.2), 'gray')  # not seen since: where it was
    assert made.picture_scene(20 * 10**9) == []


def test_from_above_a_shape_keeps_place_and_heading() -> None:
    box = from_above(Shape('x', BOX, 'seen', (1.0, 1.0, 1.0), (1.0, 2.0, 3.0),
                           quaternion_from_rpy(0.0, 0.0, 0.5)))
    assert box['p'] == [[1.0, 2.0]] and box['a'] == pytest.approx(0.5, abs=1e-3)


def test_ellipsoid_shadow_is_its_extent_along_ground() -> None:
    turn = quaternion_to_matrix(quaternion_from_rpy(0.4, -0.7, 1.1))
    outline = shadow(turn, (1.0, 2.0, 3.0))
    form = turn @ np.diag(np.square([0.5, 1.0, 1.5])) @ turn.T
    for angle in np.linspace(0.0, np.pi, 7):
        way = np.array([np.cos(angle), np.sin(angle)])
        extent = np.sqrt(way @ form[:2, :2] @ way)
        assert np.max(outline @ way) == pytest.approx(extent, rel=0.02)
    seen = from_above(Shape('c', ELLIPSOID, 'ellipsoid', (1.0, 2.0, 3.0), (5.0, 0.0, 0.0)))
    assert np.mean(seen['p'][:-1], axis=0) == pytest.approx([5.0, 0.0], abs=1e-3)

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

"""Flocks in scenarios: where they begin, what their files say, who sees whom, what is heard."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flock_desk.scenarios.flock import (
    facing_ahead,
    Flock,
    FollowerFailure,
    FORMATIONS,
    places,
)
from flock_desk.scenarios.scenario_file import (
    load,
    load_for_real_time,
    parse,
    ScenarioError,
    with_flock,
)
from flock_desk.sensors.sensing import facing, hidden, in_view, PerceptionNoise, Radio

LEVEL = np.eye(3)
GOOD = """summary: a test
leader: {motion: legs}
flock:
  followers: 4
  formation: wedge
  cameras: [front]
"""


@pytest.mark.parametrize('formation', FORMATIONS)
@pytest.mark.parametrize('count', [1, 4, 19])
def test_in_a_formation_nobody_is_near_another_and_each_faces_whom_it_has_ahead(
        formation: str, count: int) -> None:
    found = places(Flock(count, formation, spacing=1.8))
    points = np.array([np.zeros(3), *(place.offset for place in found)])
    apart = np.linalg.norm(points[:, None] - points, axis=2) + 10.0 * np.eye(count + 1)
    assert len(found) == count
    assert apart.min() >= 1.8 - 1e-9
    for number, (place, yaw) in enumerate(zip(found, facing_ahead(found)), start=1):
        assert 0 <= place.ahead < number
        ahead = apart[number, place.ahead] * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        assert place.offset + ahead == pytest.approx(points[place.ahead], abs=1e-9)


def test_a_vehicle_between_hides_the_one_behind_it() -> None:
    line = np.array([[2.0, 0.0, 0.0], [4.0, 0.1, 0.0], [4.0, 1.0, 0.0], [-4.0, 0.0, 0.0]])
    there = np.ones(4, dtype=bool)
    assert hidden(line, there, 0.25).tolist() == [False, True, False, False]
    there[0] = False  # it is gone
    assert not hidden(line, there, 0.25).any()
    beside = np.array([[2.0, 0.26, 0.0], [4.0, 0.0, 0.0]])
    assert not hidden(beside, there[:2], 0.25).any()


def test_each_camera_sees_its_side_and_four_wide_ones_see_all_round() -> None:
    around = [2.0 * np.array([np.cos(a), np.sin(a), 0.0]) for a in np.radians([0, 90, 180, 270])]
    offsets, level = np.array(around), np.tile(LEVEL, (4, 1, 1))
    for k, side in enumerate(('front', 'left', 'back', 'right')):
        assert in_view(offsets, level, PerceptionNoise(), [side]).tolist() == [
            k == j for j in range(4)]
    angles = np.radians(np.arange(0.0, 360.0, 2.0))
    circle = 2.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    everywhere = np.tile(LEVEL, (len(circle), 1, 1))
    sides = ['front', 'left', 'right', 'back']
    assert in_view(circle, everywhere, PerceptionNoise(half_width=1.1), sides).all()
    assert not in_view(circle, everywhere, PerceptionNoise(), sides).all()
    assert not in_view(3.0 * circle, everywhere, PerceptionNoise(half_width=1.1, farthest=5.0),
                       sides).any()


def test_each_face_shows_its_marker_to_its_side() -> None:
    """The vehicle is ahead of whoever looks, which is behind it, and faces as its yaw says."""
    offset = np.array([[2.0, 0.0, 0.0]])
    shown = {}
    for yaw in (0, 90, 180, 270):
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        turned = np.array([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]])
        shown[yaw] = [side for side in ('front', 'left', 'right', 'back')
                      if facing(offset, turned, 0.7, [side])[0]]
    assert shown == {0: ['back'], 90: ['left'], 180: ['front'], 270: ['right']}


def test_words_come_late_to_those_of_the_own_flock_only_and_some_are_lost() -> None:
    radio = Radio[str](3, 0.25, 0.0, [np.random.default_rng(k) for k in range(6)])
    radio.send(1.0, 4, ['a', 'b'])
    assert radio.arrived(1.2) == []
    assert sorted(radio.arrived(1.25)) == [(3, 'a'), (3, 'b'), (5, 'a'), (5, 'b')]
    assert radio.arrived(2.0) == []
    lossy = Radio[int](2, 0.0, 0.3, [np.random.default_rng(k) for k in range(2)])
    lossy.send(0.0, 0, list(range(1000)))
    assert len(lossy.arrived(0.0)) == pytest.approx(700, abs=50)


@pytest.mark.parametrize(('change', 'message'), [
    (('followers: 4', 'followers: 0'), 'x.yaml:4: flock.followers = 0: must be an integer in '
                                       '[1, 50]'),
    (('followers: 4', 'followers: 2.5'), "x.yaml:4: flock.followers = '2.5': must be an integer"),
    (('wedge', 'heap'), "x.yaml:5: flock.formation = 'heap': must be one of line, wedge, ring, "
                        'grid'),
    (('[front]', '[aft]'), 'x.yaml:6: flock.cameras = [aft]: must be some of front, left, right, '
                          'back, up, down, each once'),
    (('[front]', '[front, front]'), 'x.yaml:6: flock.cameras = [front, front]: must be some'),
    (('[front]', '[]'), 'x.yaml:6: flock.cameras = []: must be some'),
    (('[front]', 'front'), "x.yaml:6: flock.cameras = 'front': must be a list"),
    (('formation: wedge', 'loss: 1.5'), 'x.yaml:5: flock.loss = 1.5: must be a number in [0, 1]'),
    (('formation: wedge', 'words: maybe'), "x.yaml:5: flock.words = 'maybe': must be true or "
                                           'false'),
    (('formation: wedge', 'fails: {follower: 5, at: 9}'),
     'x.yaml:5: flock.fails = follower 5: must be an integer in [1, followers], where '
     'followers = 4'),
    (('formation: wedge', 'fails: {follower: 2}'), 'x.yaml:5: flock.fails.at: is missing'),
    (('formation: wedge', 'fails: 2'), 'x.yaml:5: flock.fails: must be a mapping'),
    (('formation: wedge', 'ranges: true'), 'x.yaml:1: ranges: rate = 0: must be above 0 Hz'),
    (('formation: wedge', 'size: 2'), 'x.yaml:5: flock.size: unknown key'),
])
def test_a_wrong_flock_is_told_with_line_and_what_is_allowed(change: tuple[str, str],
                                                             message: str) -> None:
    text = GOOD.replace(*change)
    assert text != GOOD
    with pytest.raises(ScenarioError) as error:
        parse(text, 'x.yaml')
    assert str(error.value).startswith(message)


def test_a_flock_of_ones_own_is_read() -> None:
    flock = parse(GOOD + '  fails: {follower: 2, at: 20}\n', 'x.yaml').flock
    assert flock == Flock(4, 'wedge', fails=FollowerFailure(2, 20.0))
    assert flock is not None
    assert flock.names == ['leader', *(f'follower_{k}' for k in range(1, 5))]


def test_the_nodes_fly_no_flock_and_say_who_does() -> None:
    with pytest.raises(ScenarioError, match=r'flies in lock step only: flights --scenario '
                                            r'flock_line; fly --followers'):
        load_for_real_time('flock_line')


def test_some_keys_of_a_flock_are_changed_and_the_others_stay() -> None:
    line = load('flock_line')
    changed = with_flock(line, '{followers: 8, fails: {follower: 7, at: 20}}', '--flock')
    assert changed == replace(line, flock=replace(
        line.flock, followers=8, fails=FollowerFailure(7, 20.0)))
    for text, message in (('{followers: 0}', '--flock:1: flock.followers = 0: must be'),
                          ('{size: 3}', '--flock:1: flock.size: unknown key'),
                          ('{words', '--flock:1: not valid YAML')):
        with pytest.raises(ScenarioError, match=message):
            with_flock(line, text, '--flock')
    with pytest.raises(ScenarioError, match='--flock: scenario hover has no flock'):
        with_flock(load('hover'), '{followers: 2}', '--flock')

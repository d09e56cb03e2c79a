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

"""The motion of the leader, as a scenario file describes it."""

from __future__ import annotations

from dataclasses import dataclass, MISSING

from flock_desk.scenarios.part import Interval, Part, Vector
from flock_follower.ranges import parameter, Range

MOTIONS = ('legs', 'circle', 'figure_eight', 'wander', 'spline', 'random_walk', 'stairs',
           'approach')
HEADINGS = ('fixed', 'course', 'away')


@dataclass(frozen=True)
class Leg(Part):
    """A velocity kept for a while."""

    duration: float = parameter(MISSING, Range(0.1, 600.0, 's'), 's.')
    velocity: Vector = parameter(
        MISSING, Range(-10.0, 10.0, 'm/s'),
        'm/s: away from the follower (as it stands at the start), to the left, up.')


@dataclass(frozen=True)
class LeaderMotion(Part):
    """
    Motion of the leader, after an initial hover.

    'legs' keeps given velocities one after the other, 'circle' and 'figure_eight' are level,
    'wander' is a random smooth course that stays near. Random in three dimensions, each run
    another: a 'spline' through points, a 'random_walk' of the velocity, 'stairs' that go up and
    down between level stretches, an 'approach' that leaves and comes back at the follower.
    Acceleration and jerk are bounded.
    """

    motion: str = parameter('legs', MOTIONS)
    wait: float = parameter(3.0, Range(0.0, 600.0, 's'), 'Hovering first, s.')
    speed: Interval = parameter(
        (0.4, 0.4), Range(0.0, 10.0, 'm/s'),
        'Largest speed, m/s; each run draws one. Legs have their own.')
    climb: float = parameter(
        0.0, Range(0.0, 10.0, 'm/s'),
        'Largest vertical speed of the motions in three dimensions, m/s.')
    climb_acceleration: float = parameter(
        0.5, Range(0.05, 10.0, 'm/s^2'), 'Their largest vertical acceleration, m/s^2.')
    height: float = parameter(
        1.0, Range(0.0, 100.0, 'm'), 'How far above or below its first height they go, m.')
    size: float = parameter(
        1.5, Range(0.3, 100.0, 'm'),
        'Radius of the circle, half the length of the figure eight, m.')
    legs: tuple[Leg, ...] = ()
    repeat: bool = parameter(
        False, None, 'Whether the legs begin again after the last one; otherwise it hovers.')
    acceleration: float = parameter(
        1.0, Range(0.05, 10.0, 'm/s^2'), 'Largest acceleration, m/s^2.')
    jerk: float = parameter(
        4.0, Range(0.1, 100.0, 'm/s^3'), 'Largest jerk while the speed changes, m/s^3.')
    heading: str = parameter(
        'fixed', HEADINGS,
        "Where it faces: 'fixed', away from the follower's start; along its 'course'; or 'away' "
        'from the follower wherever that is, as its pilot turns it, at most at 1 rad/s.')

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.climb > self.speed[0]:
            raise ValueError(f'climb = {self.climb:g}: must be at most speed = {self.speed[0]:g}')
        if self.climb and self.climb_acceleration > self.acceleration:
            raise ValueError(f'climb_acceleration = {self.climb_acceleration:g}: must be at most '
                             f'acceleration = {self.acceleration:g}')

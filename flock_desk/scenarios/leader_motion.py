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

"""How the leader of a scenario flies: what a scenario file says of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from flock_desk.scenarios.part import Interval, Part, Vector
from flock_follower.ranges import Range

MOTIONS = ('legs', 'circle', 'figure_eight', 'wander', 'spline', 'random_walk', 'stairs',
           'approach')
HEADINGS = ('fixed', 'course', 'away')


@dataclass(frozen=True)
class Leg(Part):
    """A velocity kept for a while."""

    duration: float
    """s."""
    velocity: Vector
    """m/s: away from the follower (as it stands at the start), to the left, up."""

    RANGES: ClassVar[dict[str, Range]] = {'duration': Range(0.1, 600.0, 's'),
                                          'velocity': Range(-10.0, 10.0, 'm/s')}


@dataclass(frozen=True)
class LeaderMotion(Part):
    """
    How the leader flies, after hovering for a while.

    'legs' keeps given velocities one after the other, 'circle' and 'figure_eight' are level,
    'wander' is a random smooth course that stays near. Random in three dimensions, each run
    another: a 'spline' through points, a 'random_walk' of the velocity, 'stairs' that go up and
    down between level stretches, an 'approach' that leaves and comes back at the follower.
    Acceleration and jerk are bounded.
    """

    motion: str = 'legs'
    wait: float = 3.0
    """Hovering first, s."""
    speed: Interval = (0.4, 0.4)
    """Largest speed, m/s; each run draws one. Legs have their own."""
    climb: float = 0.0
    """Largest vertical speed of the motions in three dimensions, m/s."""
    climb_acceleration: float = 0.5
    """Their largest vertical acceleration, m/s^2."""
    height: float = 1.0
    """How far above or below its first height they go, m."""
    size: float = 1.5
    """Radius of the circle, half the length of the figure eight, m."""
    legs: tuple[Leg, ...] = ()
    repeat: bool = False
    """Whether the legs begin again after the last one; otherwise it hovers."""
    acceleration: float = 1.0
    """Largest acceleration, m/s^2."""
    jerk: float = 4.0
    """Largest jerk while the speed changes, m/s^3."""
    heading: str = 'fixed'
    """
    Where it faces: 'fixed', away from the follower's start; along its 'course'; or 'away' from
    the follower wherever that is, as its pilot turns it, at most at 1 rad/s.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        'wait': Range(0.0, 600.0, 's'), 'speed': Range(0.0, 10.0, 'm/s'),
        'climb': Range(0.0, 10.0, 'm/s'), 'climb_acceleration': Range(0.05, 10.0, 'm/s^2'),
        'height': Range(0.0, 100.0, 'm'), 'size': Range(0.3, 100.0, 'm'),
        'acceleration': Range(0.05, 10.0, 'm/s^2'), 'jerk': Range(0.1, 100.0, 'm/s^3')}
    CHOICES: ClassVar[dict[str, tuple[str, ...]]] = {'motion': MOTIONS, 'heading': HEADINGS}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.climb > self.speed[0]:
            raise ValueError(f'climb = {self.climb:g}: must be at most speed = {self.speed[0]:g}')
        if self.climb and self.climb_acceleration > self.acceleration:
            raise ValueError(f'climb_acceleration = {self.climb_acceleration:g}: must be at most '
                             f'acceleration = {self.acceleration:g}')

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
Courses in three dimensions that chance draws: how people, or their worst moods, fly a leader.

Each is the velocity (n, 3) of a leader at times (n,), s, from rest: away from where the follower
begins, to the left, up. The speed is at most ``speed``, up and down at most ``climb``, and the
acceleration is bounded likewise; the height stays within ``height`` of the first.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np

from flock_desk.scenarios.leader_motion import LeaderMotion
from flock_follower.geometry import Array

Stretch = tuple[float, float, float, float]  # duration, s; forward, left and up, m/s


def random_walk(motion: LeaderMotion, speed: float, rng: np.random.Generator) -> Iterator[Stretch]:
    """Yield velocities of any direction, each kept for 1 to 4 s."""
    height = _Height(motion)
    level = _level(motion, speed)
    while True:
        duration, heading = rng.uniform(1.0, 4.0), rng.uniform(-math.pi, math.pi)
        forward = level * rng.uniform(0.3, 1.0)
        up = height.after(duration, motion.climb * rng.uniform(-1.0, 1.0))
        yield duration, forward * math.cos(heading), forward * math.sin(heading), up


def stairs(motion: LeaderMotion, speed: float, rng: np.random.Generator) -> Iterator[Stretch]:
    """Yield level stretches of 2 to 5 s, and between them climbs or descents on the way."""
    height, heading = _Height(motion), 0.0
    level = _level(motion, speed)
    while True:
        heading += rng.uniform(-0.8, 0.8)
        for climbing in (0.0, 1.0):
            duration = rng.uniform(2.0, 5.0)
            up = climbing * motion.climb * rng.choice([-1.0, 1.0])
            up = height.after(duration, up)
            forward = level * rng.uniform(0.4, 1.0)
            yield duration, forward * math.cos(heading), forward * math.sin(heading), up


def approach(motion: LeaderMotion, speed: float, rng: np.random.Generator) -> Iterator[Stretch]:
    """Yield a flight away for 2 to 6 s and back the way it came, faster, up or down meanwhile."""
    height = _Height(motion)
    level = _level(motion, speed)
    while True:
        duration, heading = rng.uniform(2.0, 6.0), rng.uniform(-0.6, 0.6)
        for share, turned in ((rng.uniform(0.4, 0.8), 0.0), (1.0, math.pi)):
            up = height.after(duration, motion.climb * rng.uniform(-1.0, 1.0))
            yield (duration, share * level * math.cos(heading + turned),
                   share * level * math.sin(heading + turned), up)


def flown(stretches: Iterator[Stretch], motion: LeaderMotion, times: Array) -> Array:
    """Return the velocities (n, 3) that go from stretch to stretch at bounded acceleration."""
    across = math.sqrt(max(motion.acceleration ** 2 - motion.climb_acceleration ** 2, 0.0)
                       if motion.climb else motion.acceleration ** 2)
    drawn, total = [], 0.0
    while total < times[-1]:
        drawn.append(next(stretches))
        total += drawn[-1][0]
    legs = np.array(drawn).reshape(-1, 4)
    level = _ramped(legs[:, 0], legs[:, 1:3], across, times)
    up = _ramped(legs[:, 0], legs[:, 3:], motion.climb_acceleration, times)
    return np.concatenate([level, up], axis=1)


def spline(motion: LeaderMotion, speed: float, times: Array, rng: np.random.Generator) -> Array:
    """
    Return the velocities (n, 3) along a uniform cubic B-spline through random points.

    The points are as far apart as it flies in 1 to 1.6 s, each direction within 1.2 rad of the
    last one; the time between two is as short as the bounds allow.
    """
    count = math.ceil(times[-1]) + 8
    headings = np.cumsum(rng.uniform(-1.2, 1.2, count))
    steps = speed * rng.uniform(1.0, 1.6, count)
    heights = _walk(steps * motion.climb / speed * rng.uniform(-1.0, 1.0, count), motion.height)
    points = np.concatenate([np.zeros((3, 3)), np.cumsum(np.stack(
        [steps * np.cos(headings), steps * np.sin(headings), np.zeros(count)], axis=1), axis=0)])
    points[3:, 2] = heights
    fine = _spline_derivatives(points, np.arange(0.0, count, 0.02))
    speeds, accelerations = (np.linalg.norm(d, axis=1).max() for d in fine)
    knot = max(1.0, speeds / speed, math.sqrt(accelerations / motion.acceleration))
    if motion.climb:
        climbs, lifts = (np.abs(d[:, 2]).max() for d in fine)
        knot = max(knot, climbs / motion.climb, math.sqrt(lifts / motion.climb_acceleration))
    return _spline_derivatives(points, times / knot)[0] / knot


class _Height:
    """Keeps a course within ``height`` of where it began."""

    def __init__(self, motion: LeaderMotion) -> None:
        self._most, self._rate = motion.height, motion.climb_acceleration
        self._height = self._climb = 0.0

    def after(self, duration: float, climb: float) -> float:
        """Return the vertical speed to go to for a duration, s: the one wanted, or another."""
        for wanted in (climb, -climb, 0.0, -math.copysign(abs(climb), self._height)):
            ramp = min(abs(wanted - self._climb) / self._rate, duration)
            reached = self._climb + math.copysign(ramp * self._rate, wanted - self._climb)
            height = (self._height + 0.5 * ramp * (self._climb + reached)
                      + (duration - ramp) * reached)
            stopped = height + 0.5 * reached * abs(reached) / self._rate
            if max(abs(height), abs(stopped)) <= self._most:
                break
        self._height, self._climb = height, reached
        return wanted


def _walk(steps: Array, most: float) -> Array:
    """Return the sums (n,) of steps (n,), each turned that would lead beyond ``most``."""
    at, reached = 0.0, []
    for step in steps.tolist():
        at += step if abs(at + step) <= most else -step
        reached.append(at)
    return np.array(reached)


def _level(motion: LeaderMotion, speed: float) -> float:
    """Return the largest horizontal speed, m/s, that leaves room for the climb."""
    return math.sqrt(speed ** 2 - motion.climb ** 2)


def _ramped(durations: Array, wanted: Array, rate: float, times: Array) -> Array:
    """Return values (n, m) at times (n,), from zero, each wanted one approached at a rate."""
    value, begin = np.zeros(wanted.shape[1]), 0.0
    knots, values = [0.0], [value]
    for duration, target in zip(durations.tolist(), wanted):
        change = target - value
        ramp = float(np.linalg.norm(change)) / rate
        share = min(1.0, duration / ramp) if ramp > 0.0 else 1.0
        value = value + share * change
        knots += [begin + min(ramp, duration), begin + duration]
        values += [value, value]
        begin += duration
    return np.stack([np.interp(times, knots, column) for column in np.array(values).T], axis=1)


def _spline_derivatives(points: Array, at: Array) -> tuple[Array, Array]:
    """Return the first two derivatives (n, 3) of a uniform cubic B-spline, knots 1 apart."""
    i = np.minimum(at.astype(int), len(points) - 4)
    u = (at - i)[:, None]
    p0, p1, p2, p3 = (points[i + k] for k in range(4))
    first = 0.5 * (-(1.0 - u) ** 2 * p0 + (3.0 * u * u - 4.0 * u) * p1
                   + (-3.0 * u * u + 2.0 * u + 1.0) * p2 + u * u * p3)
    second = (1.0 - u) * p0 + (3.0 * u - 2.0) * p1 + (1.0 - 3.0 * u) * p2 + u * p3
    return first, second

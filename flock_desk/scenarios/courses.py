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
The courses of simulated leaders, sampled ahead of the flight with bounded jerk, and the wind.

Speeds change the way a trapezoid of acceleration does: a step in speed, averaged over two windows
of T1 = dv / a and T2 = a / j, has an acceleration of at most a and a jerk of at most j.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
import math
from typing import Any

import numpy as np

from flock_desk.scenarios import random_courses
from flock_desk.scenarios.leader_motion import LeaderMotion
from flock_desk.scenarios.scenario import Scenario, Wind
from flock_follower.geometry import Array

STEP = 1.0 / 120.0  # s
TURN_GAIN, TURN_RATE = 2.0, 1.0  # 1/s and rad/s, of a leader that faces away from the follower
_SLACK = 1.02  # what sampling may add to the bound on the acceleration


@dataclass(frozen=True)
class Course:
    """Position, velocity, acceleration (n, 3) in ENU and heading (n,), every STEP from 0 on."""

    positions: Array
    velocities: Array
    accelerations: Array
    headings: Array

    def at(self, time: float) -> tuple[Array, Array, Array, float]:
        """
        Return position, velocity, acceleration (3,) and heading at a time, s.

        Beyond the end they are those of the end.
        """
        last = len(self.positions) - 1
        share, whole = math.modf(min(max(time / STEP, 0.0), float(last)))
        i, k = int(whole), min(int(whole) + 1, last)
        position, velocity, acceleration = (
            (1.0 - share) * a[i] + share * a[k]
            for a in (self.positions, self.velocities, self.accelerations))
        turn = math.remainder(self.headings[k] - self.headings[i], 2.0 * math.pi)
        return position, velocity, acceleration, float(self.headings[i] + share * turn)


def turn_rate(heading: Any, offset: Array) -> Any:
    """
    Return the rates (...), rad/s, at which leaders turn to face away from their followers.

    :param heading: theirs (...), rad.
    :param offset: their positions minus those of the followers (..., 3), m.
    """
    direction = np.arctan2(offset[..., 1], offset[..., 0])
    error = (direction - heading + math.pi) % (2.0 * math.pi) - math.pi
    return np.clip(TURN_GAIN * error, -TURN_RATE, TURN_RATE)


def course(scenario: Scenario, run: int) -> Course:
    """
    Return the leader's course in one run; the follower starts at the origin, facing along x.

    :raises ValueError: if the motion needs more than its acceleration.
    """
    motion, rng = scenario.leader, scenario.random(run, 'leader')
    distance = rng.uniform(*scenario.start.distance)
    bearing = rng.uniform(*scenario.start.bearing)
    count = round(scenario.duration / STEP) + 1
    times = np.maximum(np.arange(count) * STEP - motion.wait, 0.0)
    speed = motion.speed[0] if motion.speed[0] == motion.speed[1] else float(
        scenario.random(run, 'leader speed').uniform(*motion.speed))
    v = _MOTIONS[motion.motion](motion, speed, times, rng)
    c, s = math.cos(bearing), math.sin(bearing)
    v[:, :2] = v[:, :2] @ np.array([[c, s], [-s, c]])
    a = np.gradient(v, STEP, axis=0)
    greatest = float(np.sqrt(np.max(np.sum(a * a, axis=1))))
    if greatest > _SLACK * motion.acceleration:
        raise ValueError(f'leader: needs {greatest:.2f} m/s^2: must be at most acceleration = '
                         f'{motion.acceleration:g} m/s^2 (slower, or a larger size)')
    p = np.zeros_like(v)
    p[1:] = np.cumsum(0.5 * STEP * (v[1:] + v[:-1]), axis=0)
    headings: Array = np.zeros(count)  # 'away' is turned by the simulation
    if motion.heading == 'course':
        moving = np.hypot(v[:, 0], v[:, 1]) > 0.05
        known = np.maximum.accumulate(np.where(moving, np.arange(count), 0))
        headings = np.where(np.cumsum(moving) > 0,
                            np.arctan2(v[known, 1], v[known, 0]), 0.0)
    start = np.array([distance, 0.0, scenario.start.altitude + scenario.start.above])
    return Course(start + p, v, a, headings)


def _smoothed(values: Array, step: float, motion: LeaderMotion) -> Array:
    """Return values (n, ...) that change by at most ``step``, with bounded rate and jerk."""
    return _averaged(_averaged(values, step / motion.acceleration),
                     motion.acceleration / motion.jerk)


def _averaged(values: Array, window: float) -> Array:
    """Return values (n, ...), each averaged with those before it in a window, s."""
    width = max(round(window / STEP), 1)
    total = np.cumsum(np.concatenate([np.repeat(values[:1], width, axis=0), values]), axis=0)
    averaged: Array = (total[width:] - total[:-width]) / width
    return averaged


def _legs(motion: LeaderMotion, _: float, times: Array, rng: np.random.Generator) -> Array:
    ends = np.cumsum([leg.duration for leg in motion.legs])
    if not len(ends):
        return np.zeros((len(times), 3))
    within = times % ends[-1] if motion.repeat else times
    kept = np.array([leg.velocity for leg in motion.legs] + [(0.0, 0.0, 0.0)])
    wanted = kept[np.searchsorted(ends, within, side='right')]
    wanted[times == 0.0] = 0.0
    step = float(np.max(np.linalg.norm(np.diff(wanted, axis=0), axis=1)))
    return _smoothed(wanted, step, motion)


def _speed(motion: LeaderMotion, speed: float, times: Array) -> Array:
    """Return the speed (n,) from rest to ``speed``, half of the acceleration left for turning."""
    return _smoothed(np.where(times > 0.0, speed, 0.0), 2.0 * speed, motion)


def _circle(motion: LeaderMotion, speed: float, times: Array,
            rng: np.random.Generator) -> Array:
    speeds = _speed(motion, speed, times)
    angle = rng.choice([-1.0, 1.0]) * np.cumsum(speeds) * STEP / motion.size
    return speeds[:, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)


def _figure_eight(motion: LeaderMotion, speed: float, times: Array,
                  rng: np.random.Generator) -> Array:
    # Gerono's lemniscate x = A sin u, y = A sin u cos u is fastest in its middle: A u' sqrt(2).
    rate = _speed(motion, speed, times) / (math.sqrt(2.0) * motion.size)
    u = np.cumsum(rate) * STEP
    along = motion.size * rate * np.cos(u)
    across = motion.size * rate * np.cos(2.0 * u) * rng.choice([-1.0, 1.0])
    return np.stack([along, across, np.zeros_like(u)], axis=1)


def _wander(motion: LeaderMotion, speed: float, times: Array,
            rng: np.random.Generator) -> Array:
    """Return velocities that are sums of sinusoids: their integral stays near."""
    periods = rng.uniform([9.0, 14.0, 21.0], [14.0, 21.0, 30.0])[:, None]  # s
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, 3))
    shares = rng.uniform(0.5, 1.0, (3, 3)) * [1.0, 1.0, 0.15]
    waves = np.sum(shares * np.sin(2.0 * np.pi * times[:, None, None] / periods + phases), axis=1)
    fastest = float(np.max(np.linalg.norm(waves, axis=1)))
    begin = _smoothed(np.where(times > 0.0, 1.0, 0.0), 3.0 * speed, motion)
    return speed * waves / fastest * begin[:, None]


def _random(stretches: Callable[..., Iterator[random_courses.Stretch]], motion: LeaderMotion,
            speed: float, times: Array, rng: np.random.Generator) -> Array:
    return _averaged(random_courses.flown(stretches(motion, speed, rng), motion, times),
                     motion.acceleration / motion.jerk)


#: By name: of a motion, its speed and times (n,), s, the velocities (n, 3) from rest.
_MOTIONS: dict[str, Callable[..., Array]] = {
    'legs': _legs, 'circle': _circle, 'figure_eight': _figure_eight, 'wander': _wander,
    'spline': random_courses.spline, 'random_walk': partial(_random, random_courses.random_walk),
    'stairs': partial(_random, random_courses.stairs),
    'approach': partial(_random, random_courses.approach)}


def wind_course(wind: Wind, count: int, period: float, rng: np.random.Generator) -> Array:
    """Return the air's velocity (count, 3), m/s, ENU, every period, s, in one run."""
    direction = rng.uniform(-math.pi, math.pi)
    speed = rng.uniform(*wind.speed)
    steady = speed * np.array([math.cos(direction), math.sin(direction), 0.0])
    keep = math.exp(-period / wind.gust_time)
    fresh = wind.gust * rng.standard_normal((count, 3)) * [1.0, 1.0, 0.5]
    gusts = fresh
    for k in range(1, count):
        gusts[k] = keep * gusts[k - 1] + math.sqrt(1.0 - keep * keep) * fresh[k]
    return steady + gusts

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

Each motion is the velocity (n, 3) of a leader at times (n,), s, from rest: away from where the
follower begins, to the left, up. In random three-dimensional motions the level speed is at most
``speed``, the vertical speed at most ``climb``; the accelerations are bounded in the same way, and
the height stays within ``height`` of the first height.

Speeds change with a trapezoidal acceleration: a step in speed, averaged over two windows of T1 =
dv / a and T2 = a / j, has an acceleration of at most a and a jerk of at most j.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
import math
from typing import Any

import numpy as np

from flock_desk.scenarios.scenario import LeaderMotion, Scenario, Wind
from flock_follower.geometry import Array

COURSE_STEP = 1.0 / 120.0  # s
TURN_GAIN = 2.0  # 1/s, of the yaw of a leader that faces away from the follower
TURN_RATE = 1.0  # rad/s, of that yaw, at most
Stretch = tuple[float, float, float, float]  # duration, s; forward, left and up, m/s
_SLACK = 1.02  # factor on the bound on the acceleration: sampling adds to it


@dataclass(frozen=True)
class Course:
    """Position, velocity, acceleration (n, 3) in ENU, heading (n,), each COURSE_STEP from 0 on."""

    positions: Array
    velocities: Array
    accelerations: Array
    headings: Array

    def at(self, time: float) -> tuple[Array, Array, Array, float]:
        """
        Return position, velocity, acceleration (3,) and heading at a time, s.

        Beyond the end the values of the end are returned.
        """
        last = len(self.positions) - 1
        share, whole = math.modf(min(max(time / COURSE_STEP, 0.0), float(last)))
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
    return np.minimum(np.maximum(TURN_GAIN * error, -TURN_RATE), TURN_RATE)


def course(scenario: Scenario, run: int) -> Course:
    """
    Return the leader's course in one run; the follower starts at the origin, facing along x.

    :raises ValueError: if the motion needs more than its acceleration.
    """
    motion, rng = scenario.leader, scenario.random(run, 'leader')
    distance = rng.uniform(*scenario.start.distance)
    bearing = rng.uniform(*scenario.start.bearing)
    count = round(scenario.duration / COURSE_STEP) + 1
    times = np.maximum(np.arange(count) * COURSE_STEP - motion.wait, 0.0)
    speed = motion.speed[0] if motion.speed[0] == motion.speed[1] else float(
        scenario.random(run, 'leader speed').uniform(*motion.speed))
    v = _MOTIONS[motion.motion](motion, speed, times, rng)
    c, s = math.cos(bearing), math.sin(bearing)
    v[:, :2] = v[:, :2] @ np.array([[c, s], [-s, c]])
    a = np.gradient(v, COURSE_STEP, axis=0)
    greatest = float(np.sqrt(np.max(np.sum(a * a, axis=1))))
    if greatest > _SLACK * motion.acceleration:
        raise ValueError(f'leader: needs {greatest:.2f} m/s^2: must be at most acceleration = '
                         f'{motion.acceleration:g} m/s^2 (slower, or a larger size)')
    p = np.zeros_like(v)
    p[1:] = np.cumsum(0.5 * COURSE_STEP * (v[1:] + v[:-1]), axis=0)
    headings: Array = np.zeros(count)  # 'away' is turned by the simulation
    if motion.heading == 'course':
        moving = np.hypot(v[:, 0], v[:, 1]) > 0.05
        known = np.maximum.accumulate(np.where(moving, np.arange(count), 0))
        headings = np.where(np.cumsum(moving) > 0,
                            np.arctan2(v[known, 1], v[known, 0]), 0.0)
    start = np.array([distance, 0.0, scenario.start.altitude + scenario.start.above])
    return Course(start + p, v, a, headings)


def _smooth(values: Array, step: float, motion: LeaderMotion) -> Array:
    """Return values (n, ...) that change by at most ``step``, with bounded rate and jerk."""
    return _average(_average(values, step / motion.acceleration),
                    motion.acceleration / motion.jerk)


def _average(values: Array, window: float) -> Array:
    """Return values (n, ...), each averaged with those before it in a window, s."""
    width = max(round(window / COURSE_STEP), 1)
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
    return _smooth(wanted, step, motion)


def _speed(motion: LeaderMotion, speed: float, times: Array) -> Array:
    """Return the speed (n,) from rest to ``speed``; half of the acceleration is for turning."""
    return _smooth(np.where(times > 0.0, speed, 0.0), 2.0 * speed, motion)


def _circle(motion: LeaderMotion, speed: float, times: Array,
            rng: np.random.Generator) -> Array:
    speeds = _speed(motion, speed, times)
    angle = rng.choice([-1.0, 1.0]) * np.cumsum(speeds) * COURSE_STEP / motion.size
    return speeds[:, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)


def _figure_eight(motion: LeaderMotion, speed: float, times: Array,
                  rng: np.random.Generator) -> Array:
    # Gerono's lemniscate x = A sin u, y = A sin u cos u is fastest in its middle: A u' sqrt(2).
    rate = _speed(motion, speed, times) / (math.sqrt(2.0) * motion.size)
    u = np.cumsum(rate) * COURSE_STEP
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
    begin = _smooth(np.where(times > 0.0, 1.0, 0.0), 3.0 * speed, motion)
    return speed * waves / fastest * begin[:, None]


def random_walk(climb: float, level: float, height: _Height,
                rng: np.random.Generator) -> Iterator[Stretch]:
    """Yield velocities of any direction, each kept for 1 to 4 s."""
    while True:
        duration, heading = rng.uniform(1.0, 4.0), rng.uniform(-math.pi, math.pi)
        forward = level * rng.uniform(0.3, 1.0)
        up = height.after(duration, climb * rng.uniform(-1.0, 1.0))
        yield duration, forward * math.cos(heading), forward * math.sin(heading), up


def stairs(climb: float, level: float, height: _Height,
           rng: np.random.Generator) -> Iterator[Stretch]:
    """Yield level stretches of 2 to 5 s, and between them climbs or descents on the way."""
    heading = 0.0
    while True:
        heading += rng.uniform(-0.8, 0.8)
        for climbing in (0.0, 1.0):
            duration = rng.uniform(2.0, 5.0)
            up = height.after(duration, climbing * climb * rng.choice([-1.0, 1.0]))
            forward = level * rng.uniform(0.4, 1.0)
            yield duration, forward * math.cos(heading), forward * math.sin(heading), up


def approach(climb: float, level: float, height: _Height,
             rng: np.random.Generator) -> Iterator[Stretch]:
    """Yield flights away for 2 to 6 s, and back on the same path, faster, and up or down."""
    while True:
        duration, heading = rng.uniform(2.0, 6.0), rng.uniform(-0.6, 0.6)
        for share, turned in ((rng.uniform(0.4, 0.8), 0.0), (1.0, math.pi)):
            up = height.after(duration, climb * rng.uniform(-1.0, 1.0))
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
    level = _ramp(legs[:, 0], legs[:, 1:3], across, times)
    up = _ramp(legs[:, 0], legs[:, 3:], motion.climb_acceleration, times)
    return np.concatenate([level, up], axis=1)


def spline(motion: LeaderMotion, speed: float, times: Array, rng: np.random.Generator) -> Array:
    """
    Return the velocities (n, 3) along a uniform cubic B-spline through random points.

    The distance between two points is 1 to 1.6 s times ``speed``; the direction changes by at most
    1.2 rad from leg to leg. All legs take the same time, at least 1 s, else as short as the bounds
    of speed and acceleration allow.
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
        """Return the vertical speed for a duration, s: ``climb`` if the height permits it."""
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
    """Return the sums (n,) of steps (n,); a step that would lead beyond ``most`` is reversed."""
    at, reached = 0.0, []
    for step in steps.tolist():
        at += step if abs(at + step) <= most else -step
        reached.append(at)
    return np.array(reached)


def _ramp(durations: Array, wanted: Array, rate: float, times: Array) -> Array:
    """Return values (n, m) at times (n,), from zero; each wanted value is approached at a rate."""
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


def _random(stretches: Callable[..., Iterator[Stretch]], motion: LeaderMotion,
            speed: float, times: Array, rng: np.random.Generator) -> Array:
    level = math.sqrt(speed ** 2 - motion.climb ** 2)  # leaves room for the climb
    drawn = stretches(motion.climb, level, _Height(motion), rng)
    return _average(flown(drawn, motion, times), motion.acceleration / motion.jerk)


#: By name: of a motion, its speed and times (n,), s, the velocities (n, 3) from rest.
_MOTIONS: dict[str, Callable[..., Array]] = {
    'legs': _legs, 'circle': _circle, 'figure_eight': _figure_eight, 'wander': _wander,
    'spline': spline, 'random_walk': partial(_random, random_walk),
    'stairs': partial(_random, stairs),
    'approach': partial(_random, approach)}


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

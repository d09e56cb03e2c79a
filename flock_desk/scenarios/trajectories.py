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
Trajectories of a rendered flight: a leader on a winding course and its follower.

The leader's speed, heading and height are sinusoids, so its acceleration is known in closed form.
The course has no end, and leads forwards. The follower is flown in closed loop by the project's
own law at 10 Hz, through an attitude lag, and turns its camera towards the leader, so that a
planner's commands in replay resemble the recorded flight. For a wider range than the law allows,
it falls back from the leader and catches up again instead (:class:`Swing`).

Everything is in the odom frame (ENU, origin below the follower's start), m, s, rad. States are
rounded at every step: differences in the last bit between processors do not grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.flocking import acceleration, FlockingParams
from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
    Transform,
    wrap_angle,
)
from flock_follower.geometry.rotation_vectors import slerp
from flock_follower.planner.limits import limit_command

#: Time between samples of a track, s.
TRACK_STEP = 0.005
#: Height of both vehicles above the ground at the start, m.
START_HEIGHT = 1.6

_GRAVITY = 9.81
_DRAG = 0.25  # specific drag of a small quadrotor, 1/s: it leans forward to keep its speed
_PERIOD = 20  # steps between commands: 10 Hz
_FLIGHT = FlockingParams(K=1.0, sigma=1.0, beta=0.25, theta=2.0, d0=1.0, d1=8.0)
_A_MAX = 2.5  # m/s^2
_V_MAX = 2.0  # m/s


@dataclass(frozen=True)
class Track:
    """The motion of one vehicle, sampled every TRACK_STEP from time 0 on."""

    positions: Array
    """(N, 3), m, odom frame."""
    velocities: Array
    """(N, 3), m/s, odom frame."""
    accelerations: Array
    """(N, 3), m/s^2, odom frame."""
    quaternions: Array
    """(N, 4), base_link to odom, ``(x, y, z, w)``."""
    rates: Array
    """(N, 3), angular velocity in base_link, rad/s."""

    def pose(self, time: float) -> Transform:
        """Return base_link in odom at a time within the track, s: cubic Hermite and slerp."""
        i, f = self._locate(time)
        p, v = self.positions[i:i + 2], self.velocities[i:i + 2] * TRACK_STEP
        position = (p[0] + f * v[0] + f**2 * (3 * (p[1] - p[0]) - 2 * v[0] - v[1])
                    + f**3 * (2 * (p[0] - p[1]) + v[0] + v[1]))
        return Transform.from_quaternion(
            position, slerp(self.quaternions[i], self.quaternions[i + 1], f))

    def velocity(self, time: float) -> Array:
        """Return the velocity, (3,), m/s, in odom at a time within the track, s."""
        return self._interpolate(self.velocities, time)

    def rate(self, time: float) -> Array:
        """Return the angular velocity (3,), rad/s, in base_link at a time within the track, s."""
        return self._interpolate(self.rates, time)

    def _interpolate(self, values: Array, time: float) -> Array:
        i, f = self._locate(time)
        return (1.0 - f) * values[i] + f * values[i + 1]

    def _locate(self, time: float) -> tuple[int, float]:
        i = min(int(time / TRACK_STEP), len(self.positions) - 2)
        return i, time / TRACK_STEP - i


@dataclass(frozen=True)
class Swing:
    """A horizontal distance between the two bodies that goes out and in as a sinusoid."""

    nearest: float
    """m."""
    farthest: float
    """m."""
    period: float
    """s."""
    phase: float
    """Phase at time 0, rad; 0: nearest, and moving away."""

    def at(self, time: float) -> tuple[float, float, float]:
        """Return the distance, m, and its first two derivatives at a time, s."""
        rate, half = 2.0 * np.pi / self.period, 0.5 * (self.farthest - self.nearest)
        angle = rate * time + self.phase
        c, s = float(np.cos(angle)), float(np.sin(angle))
        return self.nearest + half * (1.0 - c), half * rate * s, half * rate**2 * c


def fly(duration: float, seed: int = 1, swing: Swing | None = None) -> tuple[Track, Track]:
    """
    Return the tracks of leader and follower for a duration, s.

    :param seed: of the buffeting of their attitudes.
    :param swing: the distance that the follower keeps, instead of obeying the flocking law.
    """
    times = np.arange(round(duration / TRACK_STEP) + 1) * TRACK_STEP
    rng = np.random.default_rng(seed)
    p, v, a, heading = leader_course(times)
    return (_track(p, v, a, heading, _gust_rotations(times, rng)),
            _track(*_follow(p, v, heading, swing), _gust_rotations(times, rng)))


def leader_course(times: Array) -> tuple[Array, Array, Array, Array]:
    """
    Return the leader's positions, velocities, accelerations, (N, 3) each, and headings (N,).

    Velocity, acceleration (at most 1 m/s^2) and heading are exact; the positions integrate the
    velocity from 0 by the trapezoidal rule with its end correction, so the times must be evenly
    spaced.
    """
    # Numbers found by search: the follower's distance varies most within 1.2 to 2.6 m.
    w_s, w_h, w_z = 2.0 * np.pi / np.array([4.61, 6.23, 9.0])
    speed = 1.03 - 0.39 * np.cos(w_s * times - 0.99)
    speed_rate = 0.39 * w_s * np.sin(w_s * times - 0.99)
    heading = 0.62 * np.sin(w_h * times + 2.65)
    turn = 0.62 * w_h * np.cos(w_h * times + 2.65)
    c, s = np.cos(heading), np.sin(heading)
    climb = 0.12 * w_z
    v = np.stack([speed * c, speed * s, climb * np.cos(w_z * times)], axis=1)
    a = np.stack([speed_rate * c - speed * turn * s, speed_rate * s + speed * turn * c,
                  -climb * w_z * np.sin(w_z * times)], axis=1)
    step = times[1] - times[0]
    p = np.zeros_like(v)
    p[1:] = np.cumsum(0.5 * step * (v[1:] + v[:-1]) - step**2 / 12 * (a[1:] - a[:-1]), axis=0)
    start = [1.96 * c[0], 1.96 * s[0], START_HEIGHT]
    return _rounded(p + start), _rounded(v), _rounded(a), _rounded(heading)


def _follow(leader_p: Array, leader_v: Array, headings: Array,
            swing: Swing | None) -> tuple[Array, Array, Array, Array]:
    """Return the follower's positions, velocities, accelerations and yaws."""
    p: Array = np.array([0.0, 0.0, START_HEIGHT])
    v, a, jerk = (_rounded(np.zeros(3)) for _ in range(3))
    yaw, yaw_rate = float(headings[0]), 0.0
    states = []
    for i, (target_p, target_v, heading) in enumerate(zip(leader_p, leader_v, headings)):
        states.append((p, v, a, yaw))
        if i % _PERIOD == 0:
            offset, difference = target_p - p, target_v - v
            wanted = (acceleration([offset], [difference], _FLIGHT) if swing is None else
                      _keep_distance(offset, difference, *swing.at(i * TRACK_STEP)))
            # The law does not mind where around its leader it flies; the marker is on the tail.
            left = np.array([-np.sin(heading), np.cos(heading), 0.0])
            wanted += left * (left @ (0.3 * offset + 0.2 * difference))
            wanted[2] = 4.0 * (START_HEIGHT - p[2]) - 4.0 * v[2]
            command = limit_command(wanted, v, _A_MAX, _V_MAX, _PERIOD * TRACK_STEP).acceleration
            bearing = float(np.arctan2(offset[1], offset[0]))
        # Attitude loops: acceleration follows like a 2nd-order lag of 10 rad/s, yaw of 5 rad/s.
        jerk = jerk + TRACK_STEP * (100.0 * (command - a) - 18.0 * jerk)
        yaw_rate += TRACK_STEP * (25.0 * wrap_angle(bearing - yaw) - 9.0 * yaw_rate)
        a, v, p = (_rounded(a + TRACK_STEP * jerk), _rounded(v + TRACK_STEP * a),
                   _rounded(p + TRACK_STEP * v + 0.5 * TRACK_STEP**2 * a))
        jerk, yaw_rate, yaw = _rounded(jerk), round(yaw_rate,
                                                    7), round(yaw + TRACK_STEP * yaw_rate, 7)
    columns = [np.array(column) for column in zip(*states)]
    return columns[0], columns[1], columns[2], columns[3]


def _keep_distance(offset: Array, difference: Array, distance: float, rate: float,
                   change: float) -> Array:
    """Return the acceleration (3,), m/s^2, that brings the leader to a distance, and keeps it."""
    horizontal = np.array([offset[0], offset[1], 0.0])
    now = np.sqrt(horizontal @ horizontal)
    along = horizontal / now
    wanted: Array = along * (2.0 * (now - distance) + 3.0 * (along @ difference - rate) - change)
    return wanted


def _track(p: Array, v: Array, a: Array, yaw: Array, buffeting: Array) -> Track:
    quaternions = np.array([
        _rounded(canonical_quaternion(quaternion_multiply(
            attitude(*state), rotation_vector_to_quaternion(shake))))
        for *state, shake in zip(a + _DRAG * v, yaw, buffeting)])
    return Track(p, v, a, quaternions, _rounded(_angular_velocities(quaternions)))


def attitude(specific_force: ArrayLike, yaw: float) -> Array:
    """
    Return the attitude quaternion of a quadrotor that thrusts so and faces a yaw, rad.

    :param specific_force: acceleration plus drag (3,), m/s^2, without gravity.
    """
    z = np.asarray(specific_force, dtype=float) + np.array([0.0, 0.0, _GRAVITY])
    z /= np.linalg.norm(z)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0.0])
    y /= np.linalg.norm(y)
    return matrix_to_quaternion(np.stack([np.cross(y, z), y, z], axis=1))


def _gust_rotations(times: Array, rng: np.random.Generator) -> Array:
    """Return small rotation vectors (N, 3), rad: gusts and the attitude loops' response."""
    total = np.zeros((len(times), 3))
    for frequency in (1.3, 2.9, 5.3, 9.7):  # Hz
        amplitude = np.deg2rad(0.30) / frequency**0.5
        total += amplitude * np.sin(2.0 * np.pi * (frequency * times[:, None] + rng.random(3)))
    return total


def _angular_velocities(quaternions: Array) -> Array:
    """Return the body rates (N, 3), rad/s, by central differences."""
    padded = np.concatenate([quaternions[:1], quaternions, quaternions[-1:]])
    steps = np.full(len(quaternions), 2.0 * TRACK_STEP)
    steps[[0, -1]] = TRACK_STEP
    return np.array([quaternion_to_rotation_vector(
        quaternion_multiply(quaternion_conjugate(before), after)) / step
        for before, after, step in zip(padded[:-2], padded[2:], steps)])


def _rounded(values: Array) -> Array:
    return np.round(values, 7)

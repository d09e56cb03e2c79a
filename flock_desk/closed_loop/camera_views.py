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
The perception of simulated followers, image by image: visibility and noise, and the real filters.

Each follower is a row: the m followers of the first run by their numbers, then those of the next
run. Each follower looks for m others: the leader first, then the other followers by their numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from flock_desk.closed_loop.world import ODOMETRY_STEPS, World
from flock_desk.scenarios.courses import COURSE_STEP
from flock_desk.scenarios.flock import LEADER
from flock_desk.scenarios.scenario import Print, Scenario
from flock_desk.sensors.sensing import (
    facing,
    hidden,
    in_view,
    PerceptionNoise,
    Radios,
    relative_noise,
)
from flock_desk.sensors.vio import Due, GaussMarkov, turned
from flock_follower.geometry import (
    Array,
    IDENTITY_QUATERNION,
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
)
from flock_follower.messages import duplicate_name, OdometryState
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception.neighbor_filter import NeighborFilter, UpdateOutcome
from flock_follower.perception.neighbor_motion import Estimate, POSITION, VELOCITY
from flock_follower.perception.range_tracking import PlacedRange, RangeSeries, RangingParams

IMAGE_STEPS = 4
BODY = 0.25  # m: radius of a vehicle that stands in the way of a view
YAW_NOISE = 0.02  # rad: of a vehicle's yaw measured in an image
MARKER_TILT = 0.02  # rad: error of the attitude of a marker on its vehicle
_USED = UpdateOutcome.STARTED, UpdateOutcome.USED, UpdateOutcome.SURPRISING
_BODY_CENTER = np.zeros(3)
_NO_ROTATION = np.eye(3)
_POSE_COVARIANCE = YAW_NOISE ** 2 * np.eye(6)  # m^2 and rad^2; its positions are replaced
_PRINT_VELOCITY = np.zeros(3)  # m/s
_PRINT_VELOCITY_COVARIANCE = 1e-4 * np.eye(3)  # (m/s)^2


class Sighted(NamedTuple):
    """The estimate of one vehicle, in ENU, with the drift of the ego odometry."""

    name: str
    estimate: Estimate
    """Its attitude is not used."""
    yaw: float | None
    """rad; None if it is not known."""
    relative: bool = False
    """Whether it is in the frame without odometry."""


class CameraViews:
    """The cameras and the neighbor filters of all rows of a world."""

    def __init__(self, world: World, noise: PerceptionNoise) -> None:
        self._world, self._noise = world, noise
        scenario, m, rows = world.scenario, len(world.others), len(world.rows)
        drawn = [_random_draws(scenario, run, number) for run, number in world.rows]
        self._latency = np.stack([each[0] for each in drawn], axis=1)
        self._random_draws, self._visible = (
            np.concatenate([each[k] for each in drawn], axis=1) for k in (1, 2))
        self._names = [scenario.company.names[v] for _, number in world.rows
                       for v in world.others[number - 1]]
        errors = scenario.odometry
        self._tilt = GaussMarkov(world.random('tilt'), 2, errors.tilt, errors.tilt_memory,
                                 IMAGE_STEPS * COURSE_STEP, errors.tilt_bias)
        self._turned = np.concatenate([g.standard_normal((len(self._latency), m))
                                       for g in world.random('attitudes')], axis=1)
        askew = np.stack([MARKER_TILT * scenario.random(run, 'askew').standard_normal(m + 1)
                          for run, number in world.rows if number == 1])
        self._askew = askew[:, world.others].ravel()
        self._filters = [NeighborFilter() for _ in range(m * rows)]
        """Of all rows, one after the other."""
        self._ranges_due: Due | None = None
        if scenario.measures_ranges:
            self._ranges_due = Due(scenario.ranges.rate)
            draws = ['ranges', *(f'ranges of other {k}' for k in range(2, m + 1))]
            generators = [scenario.random(run, draw, number)
                          for run, number in world.rows for draw in draws]
            self._range_latency = np.array([g.uniform(*scenario.ranges.latency)
                                            for g in generators])
            self._radios = Radios(scenario.ranges, generators)
            self._series = [RangeSeries(each, _BODY_CENTER) for each in self._filters]
        self._alone: dict[int, NeighborFilter] = {}
        """Filters of those rows that fly without odometry."""
        self._sight: Array | None = None
        self._images: list[_Coming[float]] = [[] for _ in range(rows)]
        self._coming: list[_Coming[Sighted]] = [[] for _ in range(rows)]
        self.seen: Any = np.zeros((rows, m), dtype=bool)
        """Which of the other vehicles an image has shown since this was last set to False."""
        self.in_sight: Any = np.ones((rows, m), dtype=bool)
        """Which of them are in the newest image, ignoring outages and missed detections."""

    def look(self, k: int) -> None:
        """Take the images, and measure the ranges, of step k of the world."""
        world, now = self._world, k * COURSE_STEP
        if k % IMAGE_STEPS == 0:
            self._look(k // IMAGE_STEPS, now)
            for number, place in enumerate(world.scenario.prints, start=1):
                self._look_at_print(duplicate_name(LEADER, number), place)
        if self._ranges_due is not None and k % ODOMETRY_STEPS == 0 and (
                not world.odometry_lost and self._ranges_due.at(now)):
            self._measure_ranges(now)

    def _look(self, image: int, now: float) -> None:
        world, m = self._world, len(self._world.others)
        sensing, vio = world.scenario.sensing, world.vio
        offsets: Array = world.offsets.reshape(-1, 3)
        eyes = np.repeat(world.vehicle.rotation, m, axis=0)
        self.in_sight = self._in_sight(offsets, eyes)
        found = self._visible[image] & self.in_sight.ravel() & (not world.odometry_lost)
        self.seen = self.seen | found.reshape(self.seen.shape)
        tilt = np.repeat(self._tilt.step(), m, axis=0)
        covariance = relative_noise(offsets, self._noise, self._angular_speeds(offsets, eyes))
        yaw_error = np.repeat(vio.yaw_error, m)
        offsets = turned(_tilt_offsets(offsets, tilt), yaw_error)
        # Along and across the line of sight are the covariance's own axes.
        drawn = sensing.noise * np.einsum('nij,nj->ni', np.linalg.cholesky(covariance),
                                          self._random_draws[image, :, :3])
        # As in perception, the filters live where own motion is smooth, their results in odom.
        measured = np.repeat(world.travel, m, axis=0) + offsets + drawn
        covariance = max(sensing.noise, 1e-3) ** 2 * covariance
        correction = vio.position - world.travel
        velocity_noise = sensing.velocity_noise * self._random_draws[image, :, 3:]
        yaws = (world.headings + yaw_error
                + YAW_NOISE * self._turned[image] + self._askew)
        arrivals = np.maximum(now + self._latency[image],
                              world.placed(now) + world.odometry_latency).tolist()
        for images, arrival in zip(self._images, arrivals):
            images.append((arrival, now))
        for i in np.flatnonzero(found).tolist():
            state = _update_estimate(self._filters[i], now, measured[i], covariance[i])
            if state is not None:
                self._send(arrivals[i // m], i, state._replace(
                    position=state.position + correction[i // m],
                    velocity=state.velocity + velocity_noise[i]), float(yaws[i]))

    def look_alone(self, k: int, motions: Sequence[OdometryState | None],
                   attitudes: Array) -> None:
        """
        Take the images of step k in rows without odometry; only the leader is looked for.

        :param motions: the motion by attitude of each row, None with odometry.
        :param attitudes: by the autopilot (rows, 3, 3), FLU to ENU.
        """
        if k % IMAGE_STEPS != 0 or not any(motions):
            return
        world, image, now = self._world, k // IMAGE_STEPS, k * COURSE_STEP
        m = len(world.others)
        found, offsets = self._visible[image] & self.in_sight.ravel(), world.offsets.reshape(-1, 3)
        covariances, scale = relative_noise(offsets, self._noise), world.scenario.sensing.noise
        for row, motion in enumerate(motions):
            if motion is None:
                self._alone.pop(row, None)
                continue
            i = row * m
            if not found[i]:
                continue
            self.seen[row, 0] = True
            turn = attitudes[row] @ world.vehicle.rotation[row].T
            noise = scale * np.linalg.cholesky(covariances[i]) @ self._random_draws[image, i, :3]
            state = _update_estimate(self._alone.setdefault(row, NeighborFilter()), now,
                                     motion.position + turn @ (offsets[i] + noise),
                                     max(scale, 1e-3) ** 2 * covariances[i])
            if state is not None:
                self._send(now + self._latency[image, row], i, state, float(world.headings[i]),
                           relative=True)

    def _send(self, arrival: float, i: int, state: Estimate, yaw: float | None,
              relative: bool = False) -> None:
        self._coming[i // len(self._world.others)].append(
            (arrival, Sighted(self._names[i], state, yaw, relative)))

    def _measure_ranges(self, now: float) -> None:
        """Measure the distances to the others by radio."""
        world, m, noise = self._world, len(self._world.others), RangingParams().range_noise ** 2
        measured = self._radios.measure(np.linalg.norm(world.offsets.reshape(-1, 3), axis=1))
        arrivals = np.maximum(now + self._range_latency,
                              world.placed(now) + np.repeat(world.odometry_latency, m))
        there = world.present[world.others].ravel()
        for i, distance in enumerate(measured.tolist()):
            if not there[i % m ** 2]:
                continue
            row = i // m
            own = OdometrySample(now, world.vio.position[row], IDENTITY_QUATERNION,
                                 world.vio.velocity[row], _PRINT_VELOCITY, world.travel[row])
            state = self._series[i].take(PlacedRange(now, distance, noise, own.travel), own)
            if state is not None:
                self._send(float(arrivals[i]), i, state, None)

    def _look_at_print(self, name: str, place: Print) -> None:
        """
        Add a print to the images just taken that show it.

        The choice between leader and print is not modeled: perception is assumed to be right, as
        its tests show.
        """
        world, vio = self._world, self._world.vio
        offsets = np.array(place.position) - world.vehicle.position
        body = quaternion_to_matrix(quaternion_from_yaw(place.yaw))
        shown = in_view(offsets, world.vehicle.rotation, self._noise) & facing(
            offsets, np.tile(body, (len(offsets), 1, 1)), world.scenario.sensing.marker_angle)
        seen_from = vio.position + turned(offsets, vio.yaw_error)
        covariances = np.zeros((len(offsets), 15, 15))
        covariances[:, POSITION, POSITION] = relative_noise(offsets, self._noise)
        covariances[:, VELOCITY, VELOCITY] = _PRINT_VELOCITY_COVARIANCE
        for row in np.flatnonzero(shown).tolist():
            arrival, stamp = self._images[row][-1]
            self._coming[row].append((arrival, Sighted(name, Estimate(
                stamp, seen_from[row], _PRINT_VELOCITY, body, _PRINT_VELOCITY, _PRINT_VELOCITY,
                covariances[row]),
                place.yaw)))

    def _in_sight(self, offsets: Array, eyes: Array) -> Any:
        """Return which of the others each row sees (rows, m), given its rotations (rows * m)."""
        world, flock, m = self._world, self._world.scenario.company, len(self._world.others)
        shown = in_view(offsets, eyes, self._noise, flock.cameras) & facing(
            offsets, world.bodies, world.scenario.sensing.marker_angle, flock.faces)
        shown = shown.reshape(-1, m, m)
        if m > 1:
            there = world.present[world.others]
            shown &= ~hidden(world.offsets, there, BODY) & there
        return shown.reshape(-1, m)

    def _angular_speeds(self, offsets: Array, eyes: Array) -> Array:
        """Return the angular speed of the others across the image since the last image, rad/s."""
        sight = np.einsum('nji,nj->ni', eyes, offsets)
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        before, self._sight = sight if self._sight is None else self._sight, sight
        turning: Array = np.linalg.norm(sight - before, axis=1) / (IMAGE_STEPS * COURSE_STEP)
        return turning

    def arrived(self, now: float) -> list[tuple[list[float], list[Sighted]]]:
        """
        Return the arrivals at the planner of each row since the last call.

        An arrival is the stamp of a processed image, s, or the newest estimate of a vehicle.
        """
        return [(_due(images, now), [*{
            (each.name, each.relative): each for each in _due(coming, now)}.values()])
                for images, coming in zip(self._images, self._coming)]


def _tilt_offsets(offsets: Array, tilt: Array) -> Array:
    """Return offsets (n, 3) turned by small angles (n, 2) about x and y, rad."""
    x, y, z = offsets[:, 0], offsets[:, 1], offsets[:, 2]
    about_x, about_y = tilt[:, 0], tilt[:, 1]
    result = np.empty_like(offsets)
    result[:, 0] = x + about_y * z
    result[:, 1] = y - about_x * z
    result[:, 2] = z + (about_x * y - about_y * x)
    return result


def _update_estimate(track: NeighborFilter, now: float, place: Array, covariance: Array
                     ) -> Estimate | None:
    """Return the estimate after a place (3,), m, of a covariance (3, 3); None if it is refused."""
    full = _POSE_COVARIANCE.copy()
    full[:3, :3] = covariance
    outcome = track.update(now, Transform(_NO_ROTATION, place), _BODY_CENTER, full)
    return track.newest if outcome in _USED else None


T = TypeVar('T')
_Coming = list[tuple[float, T]]
"""The sent items, in the order of sending, and their times of arrival, s."""


def _due(coming: _Coming[T], now: float) -> list[T]:
    """Remove and return the items that have arrived."""
    due = [each for arrival, each in coming if arrival <= now + 1e-9]
    coming[:] = [each for each in coming if each[0] > now + 1e-9]
    return due


def _random_draws(scenario: Scenario, run: int, number: int) -> tuple[Array, Array, Any]:
    """
    Return the random draws of the c images of one row.

    The draws are the latency (c,), s, noise (c, m, 6) of standard deviation 1, and whether each of
    the others is found if it is in sight (c, m).
    """
    sensing, rng = scenario.sensing, scenario.random(run, 'images', number)
    count = round(scenario.duration / COURSE_STEP) // IMAGE_STEPS + 1
    times = np.arange(count) * IMAGE_STEPS * COURSE_STEP
    latency = rng.uniform(*sensing.latency) * (1.0 + rng.uniform(-0.1, 0.1, count))
    found = [rng.random(count) < sensing.recall]
    clear = np.ones(count, dtype=bool)
    for outage in scenario.outages:
        if outage.what == 'marker':
            clear &= (times < outage.at) | (times >= outage.at + outage.duration)
    for begin in sensing.draw_light_changes(scenario.duration, rng):
        clear &= (times < begin) | (times >= begin + rng.uniform(*sensing.light_change))
    noise = [rng.standard_normal((count, 6))]
    for other in range(2, scenario.company.followers + 1):
        more = scenario.random(run, f'images of other {other}', number)
        found.append(more.random(count) < sensing.recall)
        noise.append(more.standard_normal((count, 6)))
    return latency, np.stack(noise, axis=1), np.stack(found, axis=1) & clear[:, None]

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

Every follower is a row, of n runs with m followers each: run by run, in the order of their
numbers. Each looks for m others: the leader first, then the other followers by their numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from flock_desk.scenarios.courses import STEP
from flock_desk.scenarios.flock import Flock, LEADER
from flock_desk.scenarios.scenario import Scenario
from flock_desk.sensors.sensing import (
    facing,
    hidden,
    in_view,
    PerceptionNoise,
    Radios,
    relative_noise,
)
from flock_desk.sensors.vio import GaussMarkov, turned, Vio
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
ASKEW = 0.02  # rad: by which its markers hang
_USED = UpdateOutcome.STARTED, UpdateOutcome.USED, UpdateOutcome.SURPRISING
_CENTRE = np.zeros(3)
_STILL, _STANDING = np.zeros(3), 1e-4 * np.eye(3)  # m/s, and its covariance: of a print


class Scene(NamedTuple):
    """How all vehicles of n runs stand, the leader first, then its m followers."""

    offsets: Array
    """(n, m, m, 3), from each follower to each of the others, m, ENU."""
    yaws: Array
    """(n, m + 1), rad."""
    rotations: Array
    """(n, m + 1, 3, 3), FLU to ENU."""
    present: Any
    """(m, m), whether those others are there."""


def others(flock: Flock) -> Any:
    """Return the vehicles around each follower, by number (m, m); 0 is the leader."""
    m = flock.followers
    return np.array([[v for v in range(m + 1) if v != f] for f in range(1, m + 1)])


class Lookout:
    """
    The cameras and the neighbour filters of all rows.

    :param odometry_latency: of each row, s: perception waits for odometry.
    """

    def __init__(self, scenario: Scenario, runs: Sequence[int], noise: PerceptionNoise,
                 odometry_latency: Sequence[float]) -> None:
        self._sensing, self._noise, self._flock = scenario.sensing, noise, scenario.company
        self._others = others(self._flock)
        m = self._flock.followers
        rows = [(run, number) for run in runs for number in range(1, m + 1)]
        drawn = [_drawn(scenario, run, number) for run, number in rows]
        self._prints = scenario.prints
        self._latency = np.stack([each[0] for each in drawn], axis=1)
        self._drawn, self._visible = (
            np.concatenate([each[k] for each in drawn], axis=1) for k in (1, 2))
        self._names = [[self._flock.names[v] for v in self._others[number - 1]]
                       for _, number in rows]
        errors = scenario.odometry
        self._tilt = GaussMarkov(
            [scenario.random(run, 'tilt', number) for run, number in rows], 2, errors.tilt,
            errors.tilt_memory, IMAGE_STEPS * STEP, errors.tilt_bias)
        self._odometry_latency = np.array(odometry_latency)
        self._turned = np.concatenate([scenario.random(run, 'attitudes', number).standard_normal(
            (len(self._latency), m)) for run, number in rows], axis=1)
        askew = np.stack([ASKEW * scenario.random(run, 'askew').standard_normal(m + 1)
                          for run in runs])
        self._askew = askew[:, self._others].ravel()
        self._filters = [NeighborFilter() for _ in range(m * len(rows))]
        """Of all rows, one after the other."""
        self._radios: Radios | None = None
        if scenario.measures_ranges:
            draws = ['ranges', *(f'ranges of other {k}' for k in range(2, m + 1))]
            generators = [scenario.random(run, draw, number)
                          for run, number in rows for draw in draws]
            self._range_latency = np.array([g.uniform(*scenario.ranges.latency)
                                            for g in generators])
            self._radios = Radios(scenario.ranges, generators)
            self._series = [RangeSeries(each, _CENTRE) for each in self._filters]
        self._alone: dict[int, NeighborFilter] = {}
        """Filters of those rows that fly without odometry."""
        self._sight: Array | None = None
        self._images: list[_Coming[float]] = [[] for _ in rows]
        self._coming: list[_Coming[Sighted]] = [[] for _ in rows]
        self.seen: Any = np.zeros((len(rows), m), dtype=bool)
        """Which of the other vehicles an image has shown since this was last set to False."""
        self.in_sight: Any = np.ones((len(rows), m), dtype=bool)
        """Which of them are in the newest image, ignoring outages and missed detections."""

    def look(self, k: int, scene: Scene, vio: Vio, travel: Array, placed: float,
             lost: bool) -> None:
        """
        Take the images of step k.

        :param travel: integral of the velocity of ``vio`` (rows, 3), m.
        :param placed: when there is odometry of the images, or newer, s.
        :param lost: whether odometry is lost, so that nothing can be placed in its frame.
        """
        image, now, m = k // IMAGE_STEPS, k * STEP, len(self._others)
        offsets: Array = scene.offsets.reshape(-1, 3)
        self.in_sight = self._in_sight(scene)
        found = self._visible[image] & self.in_sight.ravel()
        if lost:
            found = np.zeros_like(found)
        self.seen = self.seen | found.reshape(self.seen.shape)
        tilt: Array = self._tilt.step()
        tilt = np.repeat(np.concatenate([tilt, np.zeros((len(tilt), 1))], axis=1), m, axis=0)
        covariance = relative_noise(offsets, self._noise, self._turning(scene))
        offsets = turned(offsets + np.cross(tilt, offsets), np.repeat(vio.yaw_error, m))
        scale = self._sensing.noise
        # Along and across the line of sight are the covariance's own axes.
        drawn = scale * np.einsum('nij,nj->ni', np.linalg.cholesky(covariance),
                                  self._drawn[image, :, :3])
        # As in perception, the filters live where own motion is smooth, their results in odom.
        measured = np.repeat(travel, m, axis=0) + offsets + drawn
        covariance = max(scale, 1e-3) ** 2 * covariance
        correction = vio.position - travel
        velocity_noise = self._sensing.velocity_noise * self._drawn[image, :, 3:]
        yaws = (scene.yaws[:, self._others].ravel() + np.repeat(vio.yaw_error, m)
                + YAW_NOISE * self._turned[image] + self._askew)
        arrivals = np.maximum(
            now + self._latency[image], placed + self._odometry_latency).tolist()
        for row, arrival in enumerate(arrivals):
            self._images[row].append((arrival, now))
        for i in np.flatnonzero(found).tolist():
            state = _updated(self._filters[i], now, measured[i], covariance[i])
            if state is not None:
                self._send(arrivals[i // m], i, state._replace(
                    position=state.position + correction[i // m],
                    velocity=state.velocity + velocity_noise[i]), float(yaws[i]))

    def look_alone(self, k: int, scene: Scene, motions: Sequence[OdometryState | None],
                   attitudes: Array) -> None:
        """
        Take the same images in rows that fly without odometry; of each it sees the leader only.

        :param motions: the motion by attitude of each row, None with odometry.
        :param attitudes: by the autopilot (rows, 3, 3), FLU to ENU.
        """
        image, now, m = k // IMAGE_STEPS, k * STEP, len(self._others)
        found, offsets = self._visible[image] & self.in_sight.ravel(), scene.offsets.reshape(-1, 3)
        covariances, scale = relative_noise(offsets, self._noise), self._sensing.noise
        for row, motion in enumerate(motions):
            if motion is None:
                self._alone.pop(row, None)
                continue
            i = row * m
            if not found[i]:
                continue
            self.seen[row, 0] = True
            turn = attitudes[row] @ scene.rotations[:, 1:].reshape(-1, 3, 3)[row].T
            noise = scale * np.linalg.cholesky(covariances[i]) @ self._drawn[image, i, :3]
            state = _updated(self._alone.setdefault(row, NeighborFilter()), now,
                             motion.position + turn @ (offsets[i] + noise),
                             max(scale, 1e-3) ** 2 * covariances[i])
            if state is not None:
                self._send(now + self._latency[image, row], i, state,
                           float(scene.yaws[:, self._others].ravel()[i]), relative=True)

    def _send(self, arrival: float, i: int, state: Estimate, yaw: float | None,
              relative: bool = False) -> None:
        row, j = divmod(i, len(self._others))
        self._coming[row].append((arrival, Sighted(
            self._names[row][j], state.stamp, state.position, state.velocity, yaw,
            state.covariance[POSITION, POSITION], state.covariance[VELOCITY, VELOCITY],
            state.acceleration, relative)))

    def measure_ranges(self, now: float, scene: Scene, vio: Vio, travel: Array,
                       placed: float) -> None:
        """Measure the distances to the others by radio; parameters as of ``look``."""
        if self._radios is None:
            return
        m, noise = len(self._others), RangingParams().range_noise ** 2
        measured = self._radios.measure(np.linalg.norm(scene.offsets.reshape(-1, 3), axis=1))
        arrivals = np.maximum(now + self._range_latency,
                              placed + np.repeat(self._odometry_latency, m))
        for i, distance in enumerate(measured.tolist()):
            if not scene.present.ravel()[i % m ** 2]:
                continue
            row = i // m
            own = OdometrySample(now, vio.position[row], IDENTITY_QUATERNION, vio.velocity[row],
                                 _STILL, travel[row])
            state = self._series[i].take(PlacedRange(now, distance, noise, travel[row]), own)
            if state is not None:
                self._send(float(arrivals[i]), i, state, None)

    def look_at_prints(self, positions: Array, rotations: Array, vio: Vio) -> None:
        """
        Add the prints in view to the images just taken.

        Which of two is the leader is not modelled: perception is taken to know, as its tests show.

        :param positions: of the followers (rows, 3), m; :param rotations: theirs (rows, 3, 3).
        """
        for number, place in enumerate(self._prints, start=1):
            offsets = np.array(place.position) - positions
            bodies = np.tile(quaternion_to_matrix(quaternion_from_yaw(place.yaw)),
                             (len(offsets), 1, 1))
            shown = in_view(offsets, rotations, self._noise) & facing(
                offsets, bodies, self._sensing.marker_angle)
            covariances = relative_noise(offsets, self._noise)
            seen_from = vio.position + turned(offsets, vio.yaw_error)
            for row in np.flatnonzero(shown).tolist():
                arrival, stamp = self._images[row][-1]
                self._coming[row].append((arrival, Sighted(
                    duplicate_name(LEADER, number), stamp, seen_from[row], _STILL, place.yaw,
                    covariances[row], _STANDING, _STILL)))

    def _in_sight(self, scene: Scene) -> Any:
        n, m, _, _ = scene.offsets.shape
        offsets = scene.offsets.reshape(-1, 3)
        eyes = np.repeat(scene.rotations[:, 1:], m, axis=1).reshape(-1, 3, 3)
        bodies = scene.rotations[:, self._others].reshape(-1, 3, 3)
        flock = self._flock
        shown = in_view(offsets, eyes, self._noise, flock.cameras) & facing(
            offsets, bodies, self._sensing.marker_angle, flock.faces)
        if m > 1:
            shown &= ~hidden(scene.offsets, scene.present, BODY).ravel()
            shown &= np.broadcast_to(scene.present, (n, m, m)).ravel()
        return shown.reshape(n * m, m)

    def _turning(self, scene: Scene) -> Array:
        """Return how fast the others have moved across the images since the last, rad/s."""
        m = len(self._others)
        eyes = np.repeat(scene.rotations[:, 1:], m, axis=1).reshape(-1, 3, 3)
        sight = np.einsum('nji,nj->ni', eyes, scene.offsets.reshape(-1, 3))
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        before, self._sight = sight if self._sight is None else self._sight, sight
        turning: Array = np.linalg.norm(sight - before, axis=1) / (IMAGE_STEPS * STEP)
        return turning

    def arrived(self, now: float) -> list[tuple[list[float], list[Sighted]]]:
        """
        Return the arrivals at the planner of each row since the last call.

        An arrival is the stamp of a processed image, s, or the newest estimate of a vehicle.
        """
        return [(_due(images, now), [*{
            (each.name, each.relative): each for each in _due(coming, now)}.values()])
                for images, coming in zip(self._images, self._coming)]


def _updated(track: NeighborFilter, now: float, place: Array, covariance: Array
             ) -> Estimate | None:
    """Return the estimate after a place (3,), m, of a covariance (3, 3); None if it is refused."""
    full = YAW_NOISE ** 2 * np.eye(6)
    full[:3, :3] = covariance
    outcome = track.update(now, Transform(translation=place), _CENTRE, full)
    return track.newest if outcome in _USED else None


class Sighted(NamedTuple):
    """The estimate of one vehicle, in ENU, with the drift of the own odometry."""

    name: str
    stamp: float
    """s."""
    position: Array
    """(3,), m."""
    velocity: Array
    """(3,), m/s."""
    yaw: float | None
    """rad; None if it is not known."""
    position_covariance: Array
    """(3, 3), m^2."""
    velocity_covariance: Array
    """(3, 3), m^2/s^2."""
    acceleration: Array
    """(3,), m/s^2."""
    relative: bool = False
    """Whether it is in the frame without odometry."""


T = TypeVar('T')
_Coming = list[tuple[float, T]]
"""What has been sent, in the order of sending, and when each arrives, s."""


def _due(coming: _Coming[T], now: float) -> list[T]:
    """Take out what has arrived."""
    due = [each for arrival, each in coming if arrival <= now + 1e-9]
    coming[:] = [each for each in coming if each[0] > now + 1e-9]
    return due


def _drawn(scenario: Scenario, run: int, number: int) -> tuple[Array, Array, Any]:
    """
    Return the random draws of the c images of one row.

    The draws are the latency (c,), s, noise (c, m, 6) of standard deviation 1, and whether each of
    the others is found if it is in sight (c, m).
    """
    sensing, rng = scenario.sensing, scenario.random(run, 'images', number)
    count = round(scenario.duration / STEP) // IMAGE_STEPS + 1
    times = np.arange(count) * IMAGE_STEPS * STEP
    latency = rng.uniform(*sensing.latency) * (1.0 + rng.uniform(-0.1, 0.1, count))
    found = [rng.random(count) < sensing.recall]
    clear = np.ones(count, dtype=bool)
    for outage in scenario.outages:
        if outage.what == 'marker':
            clear &= (times < outage.at) | (times >= outage.at + outage.duration)
    for begin in rng.uniform(0.0, scenario.duration, rng.poisson(
            sensing.light_changes * scenario.duration / 60.0)):
        clear &= (times < begin) | (times >= begin + rng.uniform(*sensing.light_change))
    noise = [rng.standard_normal((count, 6))]
    for other in range(2, scenario.company.followers + 1):
        more = scenario.random(run, f'images of other {other}', number)
        found.append(more.random(count) < sensing.recall)
        noise.append(more.standard_normal((count, 6)))
    return latency, np.stack(noise, axis=1), np.stack(found, axis=1) & clear[:, None]

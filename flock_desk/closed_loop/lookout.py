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
What the perception of simulated followers makes of the vehicles around them, image by image.

Every follower is a row, of n runs with m followers each: run by run, in the order of their
numbers. Each looks for m others: the leader first, then the other followers by their numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from flock_desk.scenarios.flock import Flock, LEADER
from flock_desk.scenarios.leader import STEP
from flock_desk.scenarios.scenario import Scenario
from flock_desk.sensors.sensing import (
    facing,
    Filters,
    hidden,
    in_view,
    PerceptionNoise,
    relative_noise,
)
from flock_desk.sensors.vio import GaussMarkov, turned, Vio
from flock_follower.geometry import Array, quaternion_from_yaw, quaternion_to_matrix
from flock_follower.messages import duplicate_name

IMAGE_STEPS = 4
BODY = 0.25  # m: radius of a vehicle that stands in the way of a view
YAW_NOISE = 0.02  # rad: of the yaw that an image tells of a vehicle
ASKEW = 0.02  # rad: by which its markers hang
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
    """Return whom each follower has around it: numbers of vehicles (m, m), 0 is the leader."""
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
        images = [_Images.drawn(scenario, run, number) for run, number in rows]
        self._prints = scenario.prints
        self._latency = np.stack([each.latency for each in images], axis=1)
        self._drawn = np.concatenate([each.noise for each in images], axis=1)
        self._visible = np.concatenate([each.visible for each in images], axis=1)
        self._names = [[self._flock.names[v] for v in self._others[number - 1]]
                       for _, number in rows]
        errors = scenario.odometry
        self._tilt = GaussMarkov(
            [scenario.random(run, 'tilt', number) for run, number in rows], 2, errors.tilt,
            errors.tilt_memory, IMAGE_STEPS * STEP, errors.tilt_bias)
        self._odometry_latency = np.array(odometry_latency)
        self._turned = np.concatenate([scenario.random(run, 'attitudes', number).standard_normal(
            (len(images[0].latency), m)) for run, number in rows], axis=1)
        askew = np.stack([ASKEW * scenario.random(run, 'askew').standard_normal(m + 1)
                          for run in runs])
        self._askew = askew[:, self._others].ravel()
        self.filters = Filters(m * len(rows))
        """Of all rows, one after the other."""
        self._sight: Array | None = None
        self._sent: deque[_Sent] = deque(maxlen=20)
        self.seen: Any = np.zeros((len(rows), m), dtype=bool)
        """Which of the others an image has shown since this was last set to False."""
        self.in_sight: Any = np.ones((len(rows), m), dtype=bool)
        """Which of them the newest image would show, were nobody blinded."""

    def look(self, k: int, scene: Scene, vio: Vio, travel: Array, placed: float,
             lost: bool) -> None:
        """
        Take the images of step k.

        :param travel: integral of what ``vio`` says of the velocity (rows, 3), m.
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
        walked = np.repeat(travel, m, axis=0)
        used = self.filters.update(now, walked + offsets + drawn,
                                    max(scale, 1e-3) ** 2 * covariance, found)
        position = self.filters.position + np.repeat(vio.position, m, axis=0) - walked
        velocity = (self.filters.velocity
                    + self._sensing.velocity_noise * self._drawn[image, :, 3:])
        yaws = (scene.yaws[:, self._others].ravel() + np.repeat(vio.yaw_error, m)
                + YAW_NOISE * self._turned[image] + self._askew)
        arrivals = np.maximum(now + self._latency[image], placed + self._odometry_latency)
        self._sent.append(_Sent(now, arrivals, used.reshape(-1, m), position, velocity,
                                yaws, self.filters.acceleration.copy(), {}))

    def look_at_prints(self, positions: Array, rotations: Array, vio: Vio) -> None:
        """
        Add the prints in view to the images just taken.

        Which of two is the leader is not modelled: perception is taken to know, as its tests show.

        :param positions: of the followers (rows, 3), m; :param rotations: theirs (rows, 3, 3).
        """
        sent = self._sent[-1]
        for number, place in enumerate(self._prints, start=1):
            offsets = np.array(place.position) - positions
            bodies = np.tile(quaternion_to_matrix(quaternion_from_yaw(place.yaw)),
                             (len(offsets), 1, 1))
            shown = in_view(offsets, rotations, self._noise) & facing(
                offsets, bodies, self._sensing.marker_angle)
            covariances = relative_noise(offsets, self._noise)
            seen_from = vio.position + turned(offsets, vio.yaw_error)
            for row in np.flatnonzero(shown).tolist():
                sent.prints.setdefault(row, []).append(Sighted(
                    duplicate_name(LEADER, number), sent.stamp, seen_from[row], _STILL, place.yaw,
                    covariances[row], _STANDING, _STILL))

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

    def estimates(self, now: float) -> list[list[Sighted]]:
        """Return the newest estimate of each of the others that has arrived in each row."""
        newest: list[list[Sighted]] = [[] for _ in self._names]
        missing: Any = np.ones_like(self.seen)
        m = missing.shape[1]
        filters = self.filters  # their covariances are those of the last image: a little newer
        for sent in reversed(self._sent):
            fresh = sent.used & missing & (sent.arrivals <= now + 1e-9)[:, None]
            missing &= ~fresh
            for row, j in np.argwhere(fresh).tolist():
                i = row * m + j
                newest[row].append(Sighted(
                    self._names[row][j], sent.stamp, sent.position[i], sent.velocity[i],
                    float(sent.yaws[i]),
                    filters.position_covariance[i], filters.velocity_covariance[i],
                    sent.acceleration[i]))
            if not missing.any():
                break
        if self._prints:
            for row, found in enumerate(newest):
                found += next((sent.prints.get(row, []) for sent in reversed(self._sent)
                               if sent.arrivals[row] <= now + 1e-9), [])
        return newest

    def looked(self, now: float) -> list[list[float]]:
        """Return the stamps of the newest images that were processed in each row, s."""
        return [[sent.stamp for sent in self._sent if sent.arrivals[row] <= now + 1e-9]
                for row in range(len(self._names))]


class Sighted(NamedTuple):
    """What perception says of one vehicle, in ENU, with the drift of one's own odometry."""

    name: str
    stamp: float
    """s."""
    position: Array
    """(3,), m."""
    velocity: Array
    """(3,), m/s."""
    yaw: float | None
    """rad; None where it is not known."""
    position_covariance: Array
    """(3, 3), m^2."""
    velocity_covariance: Array
    """(3, 3), m^2/s^2."""
    acceleration: Array
    """(3,), m/s^2."""


class _Sent(NamedTuple):
    """What perception made of the images of one moment."""

    stamp: float
    """s."""
    arrivals: Array
    """When it reaches the planner of each row, s."""
    used: Any
    """(rows, m), of whom there is an estimate."""
    position: Array
    """(rows * m, 3), m."""
    velocity: Array
    """(rows * m, 3), m/s."""
    yaws: Array
    """(rows * m,), rad."""
    acceleration: Array
    """(rows * m, 3), m/s^2."""
    prints: dict[int, list[Sighted]]
    """By row, those in view."""


@dataclass(frozen=True)
class _Images:
    """What chance decides about the images of one row; there are c of them."""

    latency: Array
    """(c,), s."""
    noise: Array
    """(c, m, 6), of standard deviation 1."""
    visible: Any
    """(c, m), whether each of the others is found where it is in sight."""

    @classmethod
    def drawn(cls, scenario: Scenario, run: int, number: int) -> _Images:
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
        return cls(latency, np.stack(noise, axis=1), np.stack(found, axis=1) & clear[:, None])

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
Estimates the offset between the camera's stamps and the odometry's clock.

An image of stamp t was exposed at t + offset on the odometry's clock. If the measured points of a
neighbor are transformed to odom with the ego poses at t + offset, they form a smooth path only
with the true offset: with another offset the rotation of the ego vehicle moves the points.

Every ``BATCH`` seconds, the points of each neighbor are transformed to odom with each offset of a
grid. The misfit of an offset is the chi^2 of a path with any initial position, velocity and
acceleration, driven by white jerk. No offset of the grid is preferred, and nothing is linearized,
so every offset inside the grid is found, whatever offset is applied meanwhile. The misfits of all
batches are added; old misfits are forgotten. The standard deviation follows from the curvature and
the least of the misfits, so unmodeled motion and noise increase it.

``MountedCamera`` holds what belongs to one camera on the body: mounting, clock, learned noise, and
its last searches.
"""

from __future__ import annotations

from collections.abc import Iterable
import math
from typing import Final

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.odometry.buffer import OdometryBuffer
from flock_follower.perception.learned_noise import LearnedNoise
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.neighbor_motion import FilterParams
from flock_follower.ranges import MAX_OFFSET

#: Initial standard deviation of an offset, s.
INITIAL_DEVIATION: Final[float] = 0.1
#: Step of the grid of offsets, s.
GRID_STEP = 0.01
#: Half width of the grid of offsets, s.
GRID_REACH = 0.14
#: Offsets about the initial one, s.
OFFSET_GRID: Final[Array] = np.arange(-GRID_REACH, GRID_REACH + 0.5 * GRID_STEP, GRID_STEP)
#: Least length of a batch, s.
BATCH: Final[float] = 0.6
#: Least number of points of a batch.
MIN_POINTS = 8
#: Most points in the length of a batch.
MAX_POINTS = 40
#: Standard deviation of a point, m: only its ratio to JERK_DENSITY counts.
POINT_STD = 0.0015
#: Spectral density of the jerk, (m/s^3)^2/Hz.
JERK_DENSITY = 0.5
#: Deviations are widened: errors of successive images are alike.
WIDENING: Final[float] = 2.0
#: An estimate is applied once it differs from the applied offset by this many deviations, at first
#: and later, and by MIN_CHANGE.
SIGNIFICANT: Final = (4.0, 1.5)
#: Least change of the applied offset, s.
MIN_CHANGE: Final[float] = 0.001
#: Pause after a batch, s, while the deviation is below MIN_CHANGE.
REST: Final[float] = 3.0
#: Number of batches that are used: clocks drift.
REMEMBERED: Final[float] = 60.0


class TimeOffset:
    """
    The offset of the camera's stamps, s: the ``applied`` one and the ``estimate``.

    :param offset: initial value, applied from the start.
    :param fixed: whether to keep the initial value.
    """

    def __init__(self, offset: float = 0.0, fixed: bool = False) -> None:
        self._first, self.fixed = offset, fixed
        self.restart()

    def restart(self) -> None:
        """Reset the estimate."""
        self.applied = self.estimate = self._first
        self.deviation = INITIAL_DEVIATION
        """Standard deviation of the estimate, s."""
        self._misfits: Array = np.zeros(len(OFFSET_GRID))
        self._freedom = 0.0
        self._found = False
        self._resting = -math.inf  # until this time, s
        self._paths: dict[str, list[tuple[float, Array]]] = {}  # times, points on the body

    @property
    def describe(self) -> str:
        """Return the applied offset and the estimate, as text."""
        known = '' if self.fixed else (
            f'; estimated {1e3 * self.estimate:.1f} +- {1e3 * self.deviation:.1f} ms')
        return f'{1e3 * self.applied:.1f} ms applied{known}'

    def take(self, name: str, time: float, camera_point: Array, T_body_camera: Transform,
             odometry: OdometryBuffer) -> float:
        """
        Take the place where a camera saw a neighbor; return the change of the applied offset, s.

        :param time: of the exposure by the camera's clock, s.
        :param camera_point: a point of the neighbor, (3,), m, in the optical frame.
        """
        if self.fixed or time < self._resting:
            return 0.0
        path = self._paths.setdefault(name, [])
        if path and not 0.0 < time - path[-1][0] < 0.5 * BATCH:
            path.clear()
        if not path or time - path[-1][0] > 0.9 * BATCH / MAX_POINTS:
            path.append((time, T_body_camera.apply(camera_point)))
        last = (odometry.newest or time) - self._first - GRID_REACH
        if path[0][0] + BATCH > last:
            return 0.0
        usable = [each for each in path if each[0] <= last]
        if len(usable) < MIN_POINTS or usable[-1][0] - usable[0][0] < BATCH:
            return 0.0
        del path[:len(usable)]
        self._resting = time + (REST if self.deviation < MIN_CHANGE else 0.0)
        self._judge(np.array([t for t, _ in usable]), np.array([p for _, p in usable]), odometry)
        return self._apply()

    def _judge(self, times: Array, points: Array, odometry: OdometryBuffer) -> None:
        """Take the points (n, 3) of a batch, in base_link, at n times, s."""
        places = odometry.places(times + (self._first + OFFSET_GRID)[:, None], points)
        if places is None:
            return
        precision = path_precision(times - times[0], POINT_STD**2, JERK_DENSITY)
        misfits = np.einsum('kni,kni->k', precision @ places, places)
        if not misfits.min() > 0.0:  # NaN is not
            return
        keep = 1.0 - 1.0 / REMEMBERED
        self._misfits = keep * self._misfits + misfits
        self._freedom = keep * self._freedom + 3.0 * (len(times) - 3)
        found, self.deviation = fit_offset(self._misfits, self._freedom)
        self.estimate = self._first + found

    def _apply(self) -> float:
        """Apply the estimate if it is significant; return by how much the applied one changed."""
        off = abs(self.estimate - self.applied)
        if not off > max(MIN_CHANGE, SIGNIFICANT[self._found] * self.deviation):
            return 0.0
        before, self._found = self.applied, True
        self.applied = min(max(self.estimate, -MAX_OFFSET), MAX_OFFSET)
        return self.applied - before


def fit_offset(misfits: Array, freedom: float) -> tuple[float, float]:
    """
    Return the most likely offset, s, relative to the initial one, and its standard deviation.

    :param misfits: one for each offset of OFFSET_GRID, in any unit; the least one is due to noise.
    :param freedom: number of measured values minus number of fitted values.
    """
    chi2 = misfits * (freedom / misfits.min()) + (OFFSET_GRID / INITIAL_DEVIATION)**2
    best = int(chi2.argmin())
    weights = np.exp(0.5 * (chi2[best] - chi2))
    spread = float(weights.dot((OFFSET_GRID - OFFSET_GRID[best])**2) / weights.sum())
    if 0 < best < len(OFFSET_GRID) - 1:
        before, least, after = chi2[best - 1:best + 2].tolist()
        bend = before - 2.0 * least + after
        shift = 0.5 * GRID_STEP * (before - after) / bend
        spread = max(2.0 * GRID_STEP**2 / bend, spread - GRID_STEP**2)
    else:
        shift, spread = 0.0, INITIAL_DEVIATION**2
    return float(OFFSET_GRID[best]) + shift, WIDENING * math.sqrt(spread)


def path_precision(times: Array, variance: float, jerk_density: float) -> Array:
    """
    Return the inverse covariance (n, n), 1/m^2, of a path with an unknown start, at times, s.

    :param variance: of a point, m^2. :param jerk_density: see JERK_DENSITY.
    """
    first, apart = np.minimum(times[:, None], times), np.abs(times[:, None] - times)
    covariance = variance * np.eye(len(times)) + jerk_density * first**3 * (
        first**2 / 20.0 + first * apart / 8.0 + apart**2 / 12.0)
    inverse = np.linalg.inv(covariance)
    start = np.vander(times, 3)
    free = inverse @ start
    precision: Array = inverse - free @ np.linalg.inv(start.T @ free) @ free.T
    return precision


class MountedCamera:
    """
    A camera mounted at ``T_body_camera`` (optical), and its state from image to image.

    :param time_offset: estimates the offset of its images' stamps.
    :param readout_time: from an image's first row to its last, s; the stamp is that of the first.
    :param attitude_noise: initial noise of the ego attitude in its images, rad.
    :param rectified: whether its images are undistorted already.
    """

    def __init__(self, T_body_camera: Transform, time_offset: TimeOffset | None = None,
                 readout_time: float = 0.0,
                 attitude_noise: float = FilterParams.attitude_noise,
                 rectified: bool = False) -> None:
        self.T_body_camera = T_body_camera
        self.time_offset = time_offset or TimeOffset()
        self.readout_time = readout_time
        self.noise = LearnedNoise(attitude_noise)
        self.rectified = rectified
        self.restart(())

    def restart(self, names: Iterable[str]) -> None:
        """Reset all estimates and searches, for neighbors of these names."""
        self.noise.restart()
        self.time_offset.restart()
        self.searched = self.swept = -math.inf
        """Stamps, s, of the last search for a missing neighbor, and of the last without one."""
        self.vain: dict[str, float] = {}
        """Time, on the odometry's clock, of the last search without success, s."""
        self.newest = -math.inf
        """Stamp of the newest image, s."""
        self.interval = math.inf
        """Time from the previous image to the newest, s."""
        self.searched_near = False
        """Whether the last image was searched thoroughly near an expected place only."""
        self.portion = 0
        """Number of portions of whole images that were searched."""
        self.unchecked = dict.fromkeys(names, 0)
        """Number of images for which a neighbor's mirrored attitude need not be checked."""
        self.confirmed_at: dict[str, float] = {}
        """Stamp, s, of the last image in which not only a neighbor's smear was measured."""
        self.measured: dict[str, Measurement] = {}
        """The last measurement of each neighbor."""

    def take_stamp(self, stamp: float) -> None:
        """Record that an image of a stamp, s, has arrived; repetitions are ignored."""
        if stamp != self.newest:
            self.newest, self.interval = stamp, abs(stamp - self.newest)

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
Estimates the offset between the camera's stamps and the odometry's clock, from innovations.

An image of stamp t was exposed at t + offset on the odometry's clock. If the own pose is taken at
t, the computed position of a neighbour has the error offset * (w x r + v): the own vehicle turns
at rate w and moves at velocity v, and r is the vector to the neighbour. The filter follows part of
this bias. The rest of it in an innovation is known: the bias goes through the same transitions and
gains as the state (Friedland, "Treatment of bias in recursive filtering", IEEE Trans. Automatic
Control, 1969). The innovations are regressed on it, weighted by their covariances.

``MountedCamera`` holds what belongs to one camera on the body: mounting, clock, learnt noise, and
its last searches.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math
from typing import Final

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.neighbor_filter import Step
from flock_follower.perception.neighbor_motion import FilterParams, LearntNoise, SIZE

#: Initial standard deviation of an offset, s; largest offset that is applied, s.
PRIOR: Final[float] = 0.03
MOST: Final[float] = 0.2
#: Factor on the deviation: own and neighbour's motion are correlated, and not white noise.
WIDENING: Final[float] = 2.0
#: An estimate is certain if its deviation is below this, s.
SURE: Final[float] = 0.003
#: It is applied once it differs from the applied offset by this many deviations, and this much, s.
SIGNIFICANT: Final[float] = 4.0
LEAST: Final[float] = 0.001
#: Number of innovations that are used: clocks drift.
REMEMBERED: Final[float] = 3000.0
#: With several cameras the offsets are estimated again after this many innovations.
EVERY: Final[int] = 8
#: Number of innovations over which their misfit is averaged.
WATCHED: Final[int] = 100


class TimeOffset:
    """
    The offset of the camera's stamps, s: the ``applied`` one and the estimate of the innovations.

    ``before`` is the offset that was applied until the newest change.

    :param offset: initial value, applied from the start.
    :param fixed: whether to keep the initial value.
    """

    def __init__(self, offset: float = 0.0, fixed: bool = False) -> None:
        self._first, self.fixed = offset, fixed
        self.restart()

    def restart(self) -> None:
        """Reset the estimate."""
        self.applied = self.before = self._first
        self._information = 1.0 / PRIOR**2
        self._weighted = self._first / PRIOR**2
        self._misfit = 1.0
        self._count = 0
        self._found = False
        self._following: dict[str, Array] = {}

    @property
    def estimate(self) -> float:
        """Return what the innovations say, s."""
        return self._weighted / self._information

    @property
    def deviation(self) -> float:
        """Return the standard deviation of the estimate, s."""
        return WIDENING * math.sqrt(max(self._misfit, 1.0) / self._information)

    @property
    def describe(self) -> str:
        """Return the estimate and how it is used, as text."""
        if self.fixed:
            return f'{1e3 * self.applied:.1f} ms, as configured'
        known = f'{1e3 * self.estimate:.1f} +- {1e3 * self.deviation:.1f} ms'
        if self._found:
            return f'{known}, applied'
        return f'{known}, not applied: {1e3 * self.applied:.1f} ms is'

    def begin(self, name: str, moving: Array) -> None:
        """
        Take that a neighbour's track began with the newest measurement.

        :param moving: by how much the error state measured changes with the offset, (15,), 1/s.
        """
        self._following[name] = moving

    def forget(self, name: str) -> None:
        """Note that a neighbour's track began with a measurement of another camera."""
        self._following.pop(name, None)

    def take(self, name: str, step: Step, moving: Array) -> float:
        """
        Update the estimate with a filter step; return the change of the applied offset, s.

        The caller then moves all states by that change times :meth:`following`.
        """
        # Error of state and innovation per offset not applied: measurements lack ``moving``.
        seen = self.follow(name, step, moving)
        both = np.array([seen, step.innovation])
        # (2, 2): products of the two, weighted.
        (ss, si), (_, ii) = both.dot(cv2.solve(step.spread, both.T)[1]).tolist()
        off = self.estimate - self.applied
        self.watch((ii - 2.0 * off * si + off * off * ss) / len(seen))
        keep = 1.0 - 1.0 / REMEMBERED
        self._information = keep * self._information + ss
        self._weighted = keep * self._weighted + ss * self.applied + si
        return self.apply()

    def follow(self, name: str, step: Step, moving: Array | None = None) -> Array:
        """
        Update the bias of a neighbour's state after a step; return its part in the innovation.

        Both are per unit of offset not applied; :param moving: None if another camera measured.
        """
        ahead = step.transition.dot(self.following(name))
        seen: Array = step.jacobian.dot(ahead if moving is None else ahead - moving)
        self._following[name] = ahead - step.gain.dot(seen)
        return seen

    def watch(self, misfit: float) -> None:
        """Update the misfit with the chi^2 per dimension of an innovation."""
        self._count = min(self._count + 1, WATCHED)
        self._misfit += (min(misfit, 10.0) - self._misfit) / (self._count + 1)

    def know(self, estimate: float, information: float) -> None:
        """Set the joint estimate of several cameras, s, and its information, 1/s^2."""
        self._information, self._weighted = information, estimate * information

    def following(self, name: str) -> Array:
        """Return the bias of a neighbour's state, (15,), per unit of offset not applied."""
        return self._following.get(name, np.zeros(SIZE))

    def apply(self) -> float:
        """Apply the estimate if it is certain; return the change of the applied offset, s."""
        if self.fixed:
            return 0.0
        off = abs(self.estimate - self.applied)
        self._found = self._found or (
            self.deviation < SURE and off > max(LEAST, SIGNIFICANT * self.deviation))
        if not self._found:
            return 0.0
        self.before, self.applied = self.applied, min(max(self.estimate, -MOST), MOST)
        return self.applied - self.before


class JointOffsets:
    """
    The offsets of several cameras, estimated jointly.

    Each camera's offset also biases the predictions for the others: separate estimates would
    confuse the offsets of two cameras.
    """

    def __init__(self, offsets: Sequence[TimeOffset]) -> None:
        self._offsets = offsets
        self.restart()

    def restart(self) -> None:
        """Reset the estimate."""
        for offset in self._offsets:
            offset.restart()
        self._count = 0
        self._information = np.eye(len(self._offsets)) / PRIOR**2
        self._weighted = np.array([offset.estimate for offset in self._offsets]) / PRIOR**2

    def begin(self, camera: TimeOffset, name: str, moving: Array) -> None:
        """Take that a neighbour's track began; see :meth:`TimeOffset.begin`."""
        for offset in self._offsets:
            offset.forget(name)
        camera.begin(name, moving)

    def take(self, camera: TimeOffset, name: str, step: Step, moving: Array) -> list[float]:
        """Return by how much each applied offset changed; see :meth:`TimeOffset.take`."""
        if len(self._offsets) == 1:
            return [camera.take(name, step, moving)]
        both = np.array([*(offset.follow(name, step, moving if offset is camera else None)
                           for offset in self._offsets), step.innovation])
        products = both.dot(cv2.solve(step.spread, both.T)[1])
        seen, right_side = products[:-1, :-1], products[:-1, -1]
        applied = np.array([offset.applied for offset in self._offsets])
        off = np.array([offset.estimate for offset in self._offsets]) - applied
        camera.watch(float(products[-1, -1] - 2.0 * off.dot(right_side) + off.dot(seen).dot(off))
                     / len(step.innovation))
        keep = 1.0 - 1.0 / REMEMBERED
        self._information = keep * self._information + seen
        self._weighted = keep * self._weighted + seen.dot(applied) + right_side
        self._count += 1
        if self._count % EVERY:
            return [0.0] * len(self._offsets)
        for k, offset in enumerate(self._offsets):
            if offset.fixed:  # known: it explains nothing
                self._information[k, :] = self._information[:, k] = 0.0
                self._information[k, k], self._weighted[k] = 1.0, offset.applied
        spread = np.linalg.inv(self._information)
        for offset, estimate, variance in zip(
                self._offsets, spread.dot(self._weighted).tolist(), spread.diagonal().tolist()):
            offset.know(estimate, 1.0 / variance)
        return [offset.apply() for offset in self._offsets]


def row_delay(camera: CameraModel, readout_time: float, seen: Array) -> float:
    """
    Return how long after the first row a point (3,) in the optical frame was exposed, s.

    :param readout_time: from the first row to the last, s.
    """
    row = float(camera.project(seen[None])[0, 1])
    # Written so that NaN is the middle.
    share = row / camera.height if 0.0 <= row <= camera.height else 0.5
    return readout_time * share


class MountedCamera:
    """
    A camera mounted at ``T_body_camera`` (optical), and its state from image to image.

    :param time_offset: estimates the offset of its images' stamps.
    :param readout_time: from an image's first row to its last, s; the stamp is that of the first.
    :param attitude_noise: of the own attitude as its images show it, at least, rad.
    :param rectified: whether its images are undistorted already.
    """

    def __init__(self, T_body_camera: Transform, time_offset: TimeOffset | None = None,
                 readout_time: float = 0.0,
                 attitude_noise: float = FilterParams.attitude_noise,
                 rectified: bool = False) -> None:
        self.T_body_camera = T_body_camera
        self.time_offset = time_offset or TimeOffset()
        self.readout_time = readout_time
        self.noise = LearntNoise(attitude_noise)
        self.rectified = rectified
        self.restart(())

    def restart(self, names: Iterable[str]) -> None:
        """Reset all estimates and searches, for neighbours of these names."""
        self.noise.restart()
        self.searched: float | None = None
        """Stamp of the newest whole image searched, s."""
        self.swept: float | None = None
        """Stamp of the newest whole image searched although no neighbour was missing, s."""
        self.wanting: float | None = None
        """Stamp of the newest image in which a neighbour was missing, s."""
        self.thorough = False
        """Whether the next search of a whole image is thorough."""
        self.unchecked = dict.fromkeys(names, 0)
        """Number of images for which a neighbour's mirrored attitude need not be checked."""
        self.spacings: dict[str, tuple[float, float] | None] = dict.fromkeys(names)
        self.delays = dict.fromkeys(names, 0.5 * self.readout_time)
        """How long after an image's stamp a neighbour is exposed, s."""
        self.measured: dict[str, float] = {}
        """When it last saw a neighbour, by the clock of that neighbour's filter, s."""
        self.vain: dict[str, float] = {}
        """Stamp of the newest image without a neighbour that another camera sees, s."""

    def exposed(self, model: CameraModel, measurement: Measurement) -> float:
        """Return how long after the image's stamp a neighbour was exposed, s, and remember it."""
        if self.readout_time:
            self.delays[measurement.name] = row_delay(
                model, self.readout_time,
                measurement.T_camera_body.apply(measurement.reference))
        return self.delays[measurement.name]

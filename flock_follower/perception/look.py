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
One image in perception: the expected neighbors and the measured neighbors.

``CameraMotion`` is the camera's pose and motion at the time of an image, or of one row. A rolling
shutter exposes row r of an image of height h at the time r / h * readout_time after the first row.
The time of a measurement is the exposure of the row in the middle of the markers. The rows above
and below are exposed earlier and later, so the marker looks sheared or stretched. ``straightened``
removes this effect by the relative motion, which comes mostly from the ego angular velocity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception import search
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.innovation import to_body
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.measurement import angle, MAX_TURN, Measurement, PosePrior
from flock_follower.perception.neighbor_motion import (
    ATTITUDE,
    Estimate,
    POSITION,
    STATE_SIZE,
    VELOCITY,
)
from flock_follower.perception.pose import contradicts, locate, Target
from flock_follower.perception.prints import Fault
from flock_follower.perception.square_pose import refine
from flock_follower.perception.time_offset import MountedCamera

#: A fit to a smeared marker starts from the estimate: after this time, s, without a measurement
#: of another kind the marker is detected to confirm the fit.
CONFIRM_PERIOD = 0.2
#: Error of a measured direction that covariances of edges lack, px: blur, JPEG, and calibration.
DIRECTION_ERROR = 0.06
#: 1 for the variances of the velocity in those of an error state, (15, 15).
_VELOCITY_VARIANCES = np.zeros((STATE_SIZE, STATE_SIZE))
_VELOCITY_VARIANCES[VELOCITY, VELOCITY] = np.eye(3)


class CameraMotion(NamedTuple):
    """
    The ego state at the exposure, and the camera's pose in ``OdometryBuffer``'s smooth frame.

    ``rotation`` (3, 3) takes the body to odom.
    """

    own: OdometrySample
    rotation: Array
    T_smooth_camera: Transform

    @classmethod
    def of(cls, own: OdometrySample, T_body_camera: Transform) -> CameraMotion:
        """Return the view of a camera mounted at ``T_body_camera``."""
        body = own.smooth_pose
        return cls(own, body.rotation, body @ T_body_camera)

    @property
    def turning(self) -> Array:
        """Return the ego angular velocity (3,), rad/s, in odom."""
        return np.asarray(self.rotation.dot(self.own.angular_velocity))

    def prior(self, estimate: Estimate | None) -> PosePrior:
        """Return the expected pose of a neighbor, given its estimate or None."""
        return PosePrior(
            None if estimate is None else self.T_smooth_camera.inverse() @ estimate.pose,
            self.T_smooth_camera.rotation[2])

    def moving(self, sight: Array) -> Array:
        """Return the change of the measured state (15,) per s of time offset; sight (3,), m."""
        change = np.zeros(15)
        change[POSITION] = np.cross(self.turning, sight) + self.own.velocity
        change[ATTITUDE] = self.turning
        return change

    def passing(self, T_camera_body: Transform, reference: Array,
                estimate: Estimate | None) -> tuple[Array, Array]:
        """
        Return a neighbor's motion relative to the camera: velocity of a point, m/s; rates, rad/s.

        :param reference: the point (3,) on the body; :param estimate: the neighbor's state; if
            None, the neighbor is assumed to fly with the ego velocity.
        """
        to_camera = self.T_smooth_camera.rotation.T
        own_rates = to_camera.dot(self.turning)
        lever = self.T_smooth_camera.translation - self.own.travel
        velocity = -np.cross(own_rates, T_camera_body.apply(reference))
        if estimate is not None:
            camera = self.own.velocity + np.cross(self.turning, lever)
            velocity = velocity + to_camera.dot(estimate.velocity - camera)
        return velocity, -own_rates


def reported(estimate: Estimate, stamp: float, own: OdometrySample, attitude: float,
             velocity: float) -> Estimate:
    """
    Return a state of the filter at a stamp, s, in odom, with the noise of the ego state.

    :param attitude: variance of the white noise of the ego attitude, rad^2, and
        :param velocity: of the ego velocity, (m/s)^2, per axis: the filter averages over both.
    """
    x, y, z = (estimate.position - own.travel).tolist()
    covariance = estimate.covariance + velocity * _VELOCITY_VARIANCES
    covariance[POSITION, POSITION] += attitude * np.array(
        [[y * y + z * z, -x * y, -x * z], [-x * y, x * x + z * z, -y * z],
         [-x * z, -y * z, x * x + y * y]])
    return estimate._replace(stamp=stamp, position=estimate.position + own.correction,
                             covariance=covariance)


class MeasuredPose(NamedTuple):
    """
    A neighbor's body in the camera's optical frame, as measured in one image.

    ``covariance`` (6, 6): position of the body, m, and rotation vector, rad, along the camera's
    axes. It does not contain the errors of the ego attitude, which the filter adds, because they
    do not move a body in the camera's frame.
    """

    T_camera_body: Transform
    covariance: Array

    @classmethod
    def of(cls, measurement: Measurement, T_smooth_camera: Transform, T_smooth_body: Transform,
           scales: tuple[float, float], direction_noise: float,
           distance_noise: float) -> MeasuredPose:
        """
        Return the pose of a measurement.

        :param T_smooth_body: its pose, straightened.
        :param scales: factors on its deviations of position and attitude.
        :param direction_noise: of the line of sight, rad; :param distance_noise: a share of it.
        """
        T_camera_body = T_smooth_camera.inverse() @ T_smooth_body
        scale = np.repeat(scales, 3)
        covariance = measurement.covariance * np.outer(scale, scale)
        sight = T_camera_body.apply(measurement.reference)
        along = np.outer(sight, sight)
        covariance[:3, :3] += direction_noise**2 * (
            sight.dot(sight) * np.eye(3) - along) + distance_noise**2 * along
        to_origin = to_body(T_camera_body.rotation.dot(measurement.reference))
        return cls(T_camera_body, to_origin.dot(covariance).dot(to_origin.T))


def row_delay(camera: CameraModel, readout_time: float, seen: Array) -> float:
    """
    Return the delay between the exposures of the first row and of the row with the point, s.

    :param readout_time: from the first row to the last, s.
    :param seen: the point (3,), m, in the optical frame.
    """
    row = float(camera.project(seen[None])[0, 1])
    # Written so that NaN is the middle.
    share = row / camera.height if 0.0 <= row <= camera.height else 0.5
    return readout_time * share


def straightened(camera: CameraModel, readout_time: float, neighbor: MarkedNeighbor,
                 T_camera_body: Transform, reference: Array, velocity: Array,
                 rates: Array) -> Transform:
    """
    Return the pose of a neighbor at the time of one row, from the pose fitted to all rows.

    :param reference: the point (3,) on the body, m, that this row shows.
    :param velocity: of this point relative to the camera, m/s, and :param rates: of the body,
        rad/s, relative to the camera: (3,) along the camera's axes.
    """
    points = np.concatenate([
        marker.T_body_marker.apply(marker_corners(marker.side_length))
        for marker in neighbor.markers
        if _faces(T_camera_body @ marker.T_body_marker)] or [np.zeros((0, 3))])
    if not len(points):
        return T_camera_body
    seen = T_camera_body.apply(points)
    middle = T_camera_body.apply(reference)
    rows = camera.project(np.concatenate([seen, middle[None]]))[:, 1]
    later = readout_time / camera.height * (rows[:-1] - rows[-1])
    displacement = later[:, None] * (velocity + np.cross(rates, seen - middle))
    found = refine(camera.project(seen - displacement), camera, points, reference, T_camera_body)
    return T_camera_body if found is None else found[0]


def _faces(T_camera_marker: Transform) -> bool:
    normal = T_camera_marker.rotation[:, 2]
    return float(normal.dot(T_camera_marker.translation)) < 0.0


@dataclass
class Sighting:
    """
    The result of one image.

    ``estimates`` and ``measurements`` have the neighbors measured in this image, by name.
    ``poses`` return the measured poses with a plausible attitude. ``stage`` is the costliest stage
    of detection that was used; 'none' if the image could not be used, or no neighbor was searched.
    ``rejections`` has a pair (reason, detail) for each rejected measurement; ``other_ids`` are the
    ids of markers of no neighbor. ``duplicates`` are the states of measured candidates that are
    not the primary track, by names made of the neighbors' names. ``misprints``: by neighbor's
    name, why a detected marker was refused.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    measurements: dict[str, Measurement] = field(default_factory=dict)
    stage: str = 'none'
    rejections: list[tuple[str, str]] = field(default_factory=list)
    other_ids: list[int] = field(default_factory=list)
    duplicates: dict[str, Estimate] = field(default_factory=dict)
    misprints: dict[str, Fault] = field(default_factory=dict)
    poses: dict[str, Callable[[], MeasuredPose]] = field(default_factory=dict)

    @property
    def stages(self) -> dict[str, str]:
        """Return how each neighbor measured was found: 'track', 'roi' or 'full'."""
        return {name: measured.stage for name, measured in self.measurements.items()}


@dataclass
class Look:
    """
    An image of a camera: the neighbors expected, those to search for, and those measured.

    ``near`` are the neighbors that may be at their expected place in the image, ``anywhere`` the
    neighbors to search in the whole image if they are not found there. ``expected`` and
    ``measured`` are by neighbor; ``others`` are measurements of candidates, not of the primary
    track.
    """

    stamp: float
    exposed: float
    """
    Time of the exposure of the middle row by the camera's clock, s; ``view`` is of this time.
    """
    camera: MountedCamera
    model: CameraModel
    view: CameraMotion
    near: Sequence[str]
    anywhere: Sequence[str]
    expected: dict[str, PosePrior]
    measured: dict[str, Measurement] = field(default_factory=dict)
    others: list[Measurement] = field(default_factory=list)
    sighting: Sighting = field(default_factory=Sighting)

    @property
    def missing(self) -> list[str]:
        """Return the neighbors to search for that are not measured yet."""
        return [name for name in self.anywhere if name not in self.measured]

    def confirmed(self, image: GrayImage, found: Measurement, sought: Target,
                  dictionary: str) -> Measurement:
        """Return a measurement of a neighbor, or the fault of its detected marker."""
        name, confirmed_at = found.name, self.camera.confirmed_at
        if found.spacing is None:
            recent = self.stamp - confirmed_at.get(name, -math.inf) <= CONFIRM_PERIOD
            if recent or found.margin is not None:  # both would take too long for one image
                return found
            place, prior = found.T_camera_body, PosePrior(None, self.expected[name].up)
            ids, corners, _ = search.near(
                image, self.model, dictionary, sought.neighbor, place, False)
            for index, marker in enumerate(sought.neighbor.markers):
                middle = place.apply(marker.T_body_marker.translation)
                for outline in corners[ids == marker.marker_id]:
                    if not contradicts(
                            image, self.model, sought, index, outline, place, prior.up):
                        continue
                    again = locate(image, self.model, sought, index, outline, prior, 0.0)
                    if again is not None and angle(again.T_camera_body, place) > MAX_TURN and (
                            math.dist(again.T_camera_body.apply(marker.T_body_marker.translation),
                                      middle) < marker.side_length):
                        return again._replace(stage='roi')  # the next image is searched, too
        confirmed_at[name] = self.stamp
        return found

    def distance(self, measurement: Measurement) -> float:
        """Return a body's distance from the neighbor's expected place, or from the camera, m."""
        expected = self.expected[measurement.name].pose
        return math.dist(measurement.T_camera_body.translation,
                         np.zeros(3) if expected is None else expected.translation)

    def known(self, measurement: Measurement, side: float) -> bool:
        """Return whether a body was already measured at the same place, to within ``side``, m."""
        place = measurement.T_camera_body.translation
        return any(math.dist(each.T_camera_body.translation, place) < side
                   for each in self._of(measurement.name))

    def shown(self, corners: Array, name: str, marker: Marker) -> bool:
        """Return whether corners (4, 2), px, are those of a marker that was already measured."""
        size = 0.5 * float(np.max(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)))
        middles = [self.model.project((each.T_camera_body @ marker.T_body_marker)
                                      .translation[None])[0] for each in self._of(name)]
        return any(math.dist(middle, corners.mean(axis=0)) < size for middle in middles)

    def _of(self, name: str) -> list[Measurement]:
        """Return the measurements of a neighbor and of its candidates."""
        return [each for each in (*self.measured.values(), *self.others) if each.name == name]

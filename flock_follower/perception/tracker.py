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

"""From images and one's own odometry to the neighbours' states: the whole of perception."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
    skew,
    Transform,
)
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.neighbor_filter import (
    Estimate,
    FilterParams,
    NeighborFilter,
    Outcome,
)
from flock_follower.perception.neighbors import NeighborConfig
from flock_follower.perception.odometry import (
    Missing,
    OdometryBuffer,
    OdometryParams,
    OdometrySample,
)
from flock_follower.perception.pose import measure, Measurement, Prediction


def camera_mounting(position: ArrayLike, rpy: ArrayLike) -> Transform:
    """
    Return ``T_body_camera``, optical, of a camera's place on the body.

    ``position`` (3,), m, FLU; ``rpy`` roll, pitch, yaw, rad, of the camera *link*, whose x axis
    is the line of sight: zeros look straight ahead.
    """
    roll, pitch, yaw = np.asarray(rpy, dtype=float)
    link = quaternion_to_matrix(quaternion_from_rpy(roll, pitch, yaw))
    return Transform(link @ R_FLU_OPTICAL, np.asarray(position, dtype=float))


@dataclass
class Sighting:
    """
    What one image told.

    ``estimates`` by neighbour's name, for those measured in this image; ``rejections`` as
    (reason, detail), one for each thing dropped; ``other_ids`` of markers that are nobody's.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    rejections: list[tuple[str, str]] = field(default_factory=list)
    other_ids: list[int] = field(default_factory=list)


class Tracker:
    """
    The neighbours of one drone, seen by one camera mounted at ``T_body_camera`` (optical).

    Feed it odometry as it comes, and each image once :meth:`missing` says None for its stamp.
    """

    def __init__(self, config: NeighborConfig, T_body_camera: Transform,
                 filter_params: FilterParams | None = None,
                 odometry_params: OdometryParams | None = None) -> None:
        self.config = config
        self.filter_params = filter_params or FilterParams()
        self._T_body_camera = T_body_camera
        self._odometry = OdometryBuffer(odometry_params)
        self._neighbors = {n.name: n for n in config.neighbors}
        self._filters = {n.name: NeighborFilter(n.T_body_marker, self.filter_params)
                         for n in config.neighbors}

    def feed_odometry(self, sample: OdometrySample) -> bool:
        """Take in one's own state; return whether time jumped back and everything restarted."""
        jumped = self._odometry.add(sample)
        if jumped:
            for neighbor_filter in self._filters.values():
                neighbor_filter.reset()
        return jumped

    def missing(self, stamp: float, extrapolate: bool = False) -> Missing | None:
        """Return why an image of this stamp, s, cannot be processed (yet), or None."""
        state = self._odometry.at(stamp, extrapolate)
        return state if isinstance(state, Missing) else None

    def process_image(self, stamp: float, image: GrayImage, camera: CameraModel) -> Sighting:
        """
        Return what an image (H, W) uint8 of a stamp, s, tells of the neighbours.

        :raises ValueError: where the image is not of the camera's size.
        """
        sighting = Sighting()
        own = self._odometry.at(stamp)
        if isinstance(own, Missing):
            sighting.rejections.append((own.value, ''))
            return sighting
        # The filters live where own motion is smooth, their results in odom: see OdometryBuffer.
        T_smooth_camera = own.smooth_pose @ self._T_body_camera
        prediction = self._prediction(stamp, T_smooth_camera)
        measured = measure(image, camera, self.config, prediction)
        sighting.other_ids = measured.other_ids
        for measurement in measured.measurements:
            estimate = self._take_in(stamp, measurement, T_smooth_camera, own.travel, sighting)
            if estimate is not None:
                sighting.estimates[measurement.name] = replace(
                    estimate, position=estimate.position + own.correction)
        return sighting

    def _prediction(self, stamp: float, T_smooth_camera: Transform) -> Prediction:
        T_camera_smooth = T_smooth_camera.inverse()
        markers = {}
        for name, neighbor_filter in self._filters.items():
            expected = neighbor_filter.predict(stamp)
            if expected is not None:
                T_body_marker = self._neighbors[name].T_body_marker
                markers[name] = T_camera_smooth @ expected.pose @ T_body_marker
        return Prediction(up=T_camera_smooth.rotation[:, 2], markers=markers)

    def _take_in(self, stamp: float, measurement: Measurement, T_smooth_camera: Transform,
                 own_position: Array, sighting: Sighting) -> Estimate | None:
        """Return the estimate a measurement leads to, or None and a rejection."""
        name = measurement.name
        if measurement.rejected:
            sighting.rejections.append(
                (measurement.rejected, f'{name}, {measurement.rms:.1f} px'))
            return None
        T_smooth_marker = T_smooth_camera @ measurement.T_camera_marker
        turn = np.kron(np.eye(2), T_smooth_camera.rotation)
        # One's own attitude error e turns what is seen about oneself: it moves a marker at
        # range r by e x r, and tilts it by e.
        leverage = np.vstack([-skew(T_smooth_marker.translation - own_position), np.eye(3)])
        covariance = (turn @ measurement.covariance @ turn.T
                      + self.filter_params.attitude_noise**2 * leverage @ leverage.T)
        neighbor_filter = self._filters[name]
        outcome = neighbor_filter.update(stamp, T_smooth_marker, covariance)
        if outcome in (Outcome.OUTLIER, Outcome.LATE, Outcome.POSITION_ONLY):
            sighting.rejections.append((outcome.value, name))
        if outcome in (Outcome.OUTLIER, Outcome.LATE):
            return None
        estimate = neighbor_filter.predict(stamp)
        assert estimate is not None
        systematic = T_smooth_camera.rotation @ measurement.systematic
        widened = estimate.covariance.copy()
        widened[:3, :3] += np.outer(systematic, systematic)
        return replace(estimate, covariance=widened)

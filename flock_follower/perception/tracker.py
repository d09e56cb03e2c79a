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
From images and one's own odometry to the neighbours' states: the whole of perception.

Each image is looked at in up to three stages, the cheapest first:

=======  ==========================================================================
track    edges are fitted where the filter expects each neighbour's markers
roi      a neighbour not found that way is detected near its expected place
full     those missing even then are detected in the whole image, at a limited rate
=======  ==========================================================================
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
    Transform,
)
from flock_follower.odometry.history import (
    Missing,
    OdometryBuffer,
    OdometryParams,
    OdometrySample,
)
from flock_follower.perception import rolling_shutter, search
from flock_follower.perception.aruco import Detections
from flock_follower.perception.attitudes import PosePrior
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.learnt_noise import LearntNoise
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.neighbor_filter import (
    Estimate,
    FilterParams,
    NeighborFilter,
    UpdateOutcome,
)
from flock_follower.perception.neighbors import NeighborConfig
from flock_follower.perception.own_view import View
from flock_follower.perception.pose import locate, target, track
from flock_follower.perception.range_tracking import Ranged, Ranging, RangingParams, Rejection
from flock_follower.perception.time_offset import TimeOffset

#: Whole images are searched this often at most, s.
SEARCH_PERIOD = 0.1
#: The mirrored attitude is looked at in every image while its chi^2 is within this of the other's,
MARGIN = 100.0
#: and otherwise in one of so many.
MIRRORED_EVERY = 30


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

    ``estimates``, ``measurements`` and ``stages`` (how it was found: 'track', 'roi' or 'full') by
    neighbour's name, for those measured in this image and believed; ``stage`` is the costliest
    stage that was gone through, 'none' where the image could not be used. ``rejections`` are
    (reason, detail), one for each thing dropped; ``other_ids`` of markers that are nobody's.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    measurements: dict[str, Measurement] = field(default_factory=dict)
    stages: dict[str, str] = field(default_factory=dict)
    stage: str = 'none'
    rejections: list[tuple[str, str]] = field(default_factory=list)
    other_ids: list[int] = field(default_factory=list)


class Tracker:
    """
    The neighbours of one drone, seen by one camera mounted at ``T_body_camera`` (optical).

    Feed it odometry as it comes, and each image once :meth:`missing` says None for its stamp.

    :param time_offset: finds out by how much the images' stamps are off.
    :param readout_time: from an image's first row to its last, s; the stamp is that of the first.
    """

    def __init__(self, config: NeighborConfig, T_body_camera: Transform,
                 filter_params: FilterParams | None = None,
                 odometry_params: OdometryParams | None = None,
                 time_offset: TimeOffset | None = None, readout_time: float = 0.0,
                 ranging_params: RangingParams | None = None) -> None:
        self.config = config
        self.filter_params = filter_params or FilterParams()
        self._T_body_camera = T_body_camera
        self._odometry = OdometryBuffer(odometry_params)
        self._targets = {n.name: target(n, config.dictionary) for n in config.neighbors}
        self._filters = {n.name: NeighborFilter(self.filter_params) for n in config.neighbors}
        self.noise = LearntNoise(self.filter_params.attitude_noise)
        self.time_offset = time_offset or TimeOffset()
        self._readout_time = readout_time
        self._by_marker = config.by_marker()
        self.ranging = Ranging(config.neighbors, self._filters, self._odometry, ranging_params)
        self._forget()

    def restart(self) -> None:
        """Forget everything, one's own odometry too."""
        self._odometry.clear()
        self._forget()

    def _forget(self) -> None:
        for neighbor_filter in self._filters.values():
            neighbor_filter.reset()
        self.noise.restart()
        self.time_offset.restart()
        self.ranging.restart()
        self._searched: float | None = None
        self._thorough = False  # next time a whole image is searched
        self._unchecked = dict.fromkeys(self._targets, 0)
        self._spacings: dict[str, tuple[float, float] | None] = dict.fromkeys(self._targets)
        self._delays = dict.fromkeys(self._targets, 0.5 * self._readout_time)

    def feed_odometry(self, sample: OdometrySample) -> bool:
        """Take in one's own state; return whether time jumped back and everything restarted."""
        jumped = self._odometry.add(sample)
        walk = self.filter_params.odometry_walk if sample.derived else 0.0
        for neighbor_filter in self._filters.values():
            neighbor_filter.walk = walk
        if jumped:
            self._forget()
        return jumped

    def ranged(self) -> Iterator[Ranged | Rejection]:
        """Yield what became of the ranges that odometry has reached."""
        return self.ranging.due(lambda name, stamp: stamp - self.time_offset.applied)

    def missing(self, stamp: float, extrapolate: bool = False) -> Missing | None:
        """Return why an image of this stamp, s, cannot be processed (yet), or None."""
        last = stamp + self.time_offset.applied + self._readout_time
        return self._odometry.missing(last, extrapolate)

    def process_image(self, stamp: float, image: GrayImage, camera: CameraModel) -> Sighting:
        """
        Return what an image (H, W) uint8 of a stamp, s, tells of the neighbours.

        :raises ValueError: where the image is not of the camera's size, or not grey.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f'image = {image.dtype} of shape {image.shape}: must be (H, W) uint8')
        sighting = Sighting()
        views: dict[float, View] = {}  # by how long after the stamp
        for delay in self._delays.values():
            view = views.get(delay) or self._view(stamp, delay)
            if isinstance(view, Missing):
                sighting.rejections.append((view.value, ''))
                return sighting
            views[delay] = view
        expected = {name: self._expected(name, stamp, views[delay])
                    for name, delay in self._delays.items()}
        camera.check_image(image.shape[1], image.shape[0])
        measured = self._track(image, camera, expected)
        sighting.stage = 'track'
        if len(measured) < len(self._targets):
            self._detect(stamp, image, camera, expected, measured, sighting)
        for name, measurement in measured.items():
            self._spacings[name] = measurement.spacing
            delay = self._exposed(camera, measurement)
            view = views.get(delay) or self._view(stamp, delay)
            if isinstance(view, Missing):
                continue
            if self._take_in(stamp, measurement, view, camera, sighting):
                sighting.measurements[name] = measurement
                sighting.stages[name] = measurement.stage
                sighting.estimates[name] = self._told(name, stamp, view)
        return sighting

    def _view(self, stamp: float, delay: float) -> View | Missing:
        """Return the view so long, s, after an image's stamp."""
        own = self._odometry.at(stamp + self.time_offset.applied + delay)
        if isinstance(own, Missing):
            return own
        return View.of(self._odometry.steadied(own), self._T_body_camera, delay)

    def _exposed(self, camera: CameraModel, measurement: Measurement) -> float:
        """Return how long after the image's stamp a neighbour was exposed, s."""
        if self._readout_time:
            self._delays[measurement.name] = rolling_shutter.delay(
                camera, self._readout_time,
                measurement.T_camera_body.apply(measurement.reference))
        return self._delays[measurement.name]

    def _expected(self, name: str, stamp: float, view: View) -> PosePrior:
        return PosePrior(view.expected(self._filters[name].predict(stamp + view.delay)),
                         view.T_smooth_camera.rotation[2])

    def _told(self, name: str, stamp: float, view: View) -> Estimate:
        """Return a neighbour's state at the image's stamp, by the odometry's clock, in odom."""
        estimate = self._filters[name].near(stamp - self.time_offset.applied)
        assert estimate is not None, 'it was just taken in'
        exposed = self.time_offset.applied + view.delay
        own = self._odometry.at(stamp) if exposed else view.own
        if isinstance(own, Missing):
            own = view.own
        _, position, *others = estimate
        return Estimate(stamp, position + own.correction, *others)

    def _track(self, image: GrayImage, camera: CameraModel,
               expected: dict[str, PosePrior]) -> dict[str, Measurement]:
        found = {}
        for name, sought in self._targets.items():
            check = self._unchecked[name] == 0
            measurement = track(image, camera, sought, expected[name], self._spacings[name],
                                check)
            if measurement is None:
                continue
            found[name] = measurement
            if not check:
                self._unchecked[name] -= 1
            elif measurement.margin is not None and measurement.margin > MARGIN:
                self._unchecked[name] = MIRRORED_EVERY - 1
        return found

    def _detect(self, stamp: float, image: GrayImage, camera: CameraModel,
                expected: dict[str, PosePrior], measured: dict[str, Measurement],
                sighting: Sighting) -> None:
        """Look for the neighbours that are missing in ``measured``, and add them."""
        def missing() -> list[str]:
            return [name for name in self._targets if name not in measured]

        for thorough in (False, True):
            for name in missing():
                pose = expected[name].pose
                if pose is not None:
                    found = search.near(image, camera, self.config.dictionary,
                                        self._targets[name].neighbor, pose, thorough)
                    sighting.stage = 'roi'
                    self._locate(found, 'roi', image, camera, expected, measured, sighting)
        due = self._searched is None or not 0.0 <= stamp - self._searched < SEARCH_PERIOD - 1e-3
        if missing() and due:
            # The first time both ways: quickly, and if need be thoroughly; then they take turns.
            ways = (False, True) if self._searched is None else (self._thorough,)
            for thorough in ways:
                if missing():
                    found = search.everywhere(image, self.config.dictionary, thorough)
                    self._locate(found, 'full', image, camera, expected, measured, sighting)
                    self._thorough = not thorough
            sighting.stage, self._searched = 'full', stamp
        sighting.other_ids = sorted(set(sighting.other_ids))

    def _locate(self, found: Detections, stage: str, image: GrayImage, camera: CameraModel,
                expected: dict[str, PosePrior], measured: dict[str, Measurement],
                sighting: Sighting) -> None:
        """Turn detections into measurements of those who are missing in ``measured``."""
        candidates: dict[str, list[Measurement]] = {}
        for marker_id, corners in zip(found.ids.tolist(), found.corners):
            if marker_id not in self._by_marker:
                sighting.other_ids.append(marker_id)
                continue
            neighbor, marker = self._by_marker[marker_id]
            name = neighbor.name
            if name in measured:
                continue
            index = neighbor.markers.index(marker)
            measurement = locate(image, camera, self._targets[name], index, corners,
                                 expected[name])
            if measurement is None:
                sighting.rejections.append(('no pose suits the marker', f'{name}, {marker_id}'))
            else:
                candidates.setdefault(name, []).append(measurement._replace(stage=stage))
        for name, several in candidates.items():
            measured[name] = _likeliest(several, expected[name].pose)
            self._unchecked[name] = 0

    def _take_in(self, stamp: float, measurement: Measurement, view: View, camera: CameraModel,
                 sighting: Sighting) -> bool:
        """Take a measurement into the neighbour's filter; else say why, and return False."""
        name, neighbor_filter = measurement.name, self._filters[measurement.name]
        time = stamp + view.delay
        T_camera_body, reference = measurement.T_camera_body, measurement.reference
        if self._readout_time:
            T_camera_body = rolling_shutter.straightened(
                camera, self._readout_time, self._targets[name].neighbor, T_camera_body, reference,
                *view.passing(T_camera_body, reference, neighbor_filter.predict(time)))
        T_smooth_body = view.T_smooth_camera @ T_camera_body
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = view.T_smooth_camera.rotation
        covariance = turn.dot(measurement.covariance).dot(turn.T)
        covariance += self.noise.covariance(T_smooth_body.apply(reference) - view.own.travel)
        outcome = neighbor_filter.update(time, T_smooth_body, reference, covariance)
        if outcome in (UpdateOutcome.OUTLIER, UpdateOutcome.LATE, UpdateOutcome.POSITION_ONLY):
            sighting.rejections.append((outcome.value, name))
        if outcome in (UpdateOutcome.OUTLIER, UpdateOutcome.LATE):
            return False
        self._learn(name, view, T_smooth_body.translation - view.own.travel)
        return True

    def _learn(self, name: str, view: View, sight: Array) -> None:
        """Learn from how a neighbour was taken in, its body so far away (3,), m."""
        step = self._filters[name].step
        if step is None:
            self.time_offset.begin(name, view.moving(sight))
            return
        self.noise.take(step.innovation[:3], step.expected, sight)
        change = self.time_offset.take(name, step, view.moving(sight))
        if change:
            for each, neighbor_filter in self._filters.items():
                neighbor_filter.shift(change * self.time_offset.following(each))


def _likeliest(several: list[Measurement], expected: Transform | None) -> Measurement:
    """Return which measurement of one neighbour to believe: prints and reflections happen."""
    # A print on the wall behind is farther away.
    place = np.zeros(3) if expected is None else expected.translation
    return min(several, key=lambda m: float(np.linalg.norm(m.T_camera_body.translation - place)))

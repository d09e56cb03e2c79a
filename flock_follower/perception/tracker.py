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
Perception: from images and own odometry to the neighbours' states.

Detection in each image has up to three stages, the cheapest first:

=======  ==========================================================================
track    edges are fitted where the filter expects each neighbour's markers
roi      a neighbour not found that way is detected near its expected place
full     those missing even then are detected in the whole image, at a limited rate
=======  ==========================================================================

Once a second the whole image is searched even if no neighbour is missing: see ``hypotheses``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    quaternion_from_rpy,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
    Transform,
)
from flock_follower.odometry.buffer import Missing, OdometryBuffer, OdometrySample
from flock_follower.perception import search
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.camera_schedule import CameraSchedule
from flock_follower.perception.hypotheses import Hypotheses
from flock_follower.perception.images import GrayImage
from flock_follower.perception.look import Look, reported, Sighting, straightened, View
from flock_follower.perception.markers import Detections, NeighborConfig
from flock_follower.perception.measurement import likeliest, Measurement
from flock_follower.perception.neighbor_filter import (
    Estimate,
    FilterParams,
    NeighborFilter,
    UpdateOutcome,
)
from flock_follower.perception.neighbor_motion import ODOMETRY_WALK
from flock_follower.perception.pose import locate, target, track
from flock_follower.perception.range_tracking import Ranged, Ranging, RangingParams, Rejection
from flock_follower.perception.time_offset import MountedCamera, TimeOffset

#: The mirrored attitude is looked at in every image while its chi^2 is within this of the other's,
#: and otherwise in one of so many.
MARGIN, MIRRORED_EVERY = 100.0, 30


def camera_mounting(position: ArrayLike, rpy: ArrayLike) -> Transform:
    """
    Return ``T_body_camera``, optical, of a camera's place on the body.

    ``position`` (3,), m, FLU; ``rpy`` roll, pitch, yaw, rad, of the camera *link*, whose x axis
    is the line of sight: zeros look straight ahead.
    """
    roll, pitch, yaw = np.asarray(rpy, dtype=float)
    link = quaternion_to_matrix(quaternion_from_rpy(roll, pitch, yaw))
    return Transform(link @ R_FLU_OPTICAL, np.asarray(position, dtype=float))


class Tracker:
    """
    The neighbours of one drone, seen by one camera or several.

    The tracker needs every odometry message, and each image once :meth:`missing` returns None for
    its stamp. Cameras have names; a single camera has the name ''.

    :param cameras: of one its place on the body (optical), of several each by its name.
    :param time_offset: of one: finds out by how much the images' stamps are off.
    :param readout_time: of one: from an image's first row to its last, s; the stamp is that of
        the first.
    """

    def __init__(self, config: NeighborConfig, cameras: Transform | Mapping[str, MountedCamera],
                 filter_params: FilterParams | None = None,
                 time_offset: TimeOffset | None = None, readout_time: float = 0.0,
                 ranging_params: RangingParams | None = None) -> None:
        self.config = config
        self.filter_params = filter_params or FilterParams()
        if isinstance(cameras, Transform):
            cameras = {'': MountedCamera(cameras, time_offset, readout_time,
                                         self.filter_params.attitude_noise)}
        self.cameras = dict(cameras)
        self._odometry = OdometryBuffer()
        self._targets = {n.name: target(n, config.dictionary) for n in config.neighbors}
        self._side = {n.name: max(m.side_length for m in n.markers) for n in config.neighbors}
        self._hypotheses = {n.name: Hypotheses(self.filter_params) for n in config.neighbors}
        self._filters = {name: each.primary for name, each in self._hypotheses.items()}
        self._by_marker = config.by_marker()
        self._schedule = CameraSchedule(config.neighbors, list(self.cameras.values()))
        self.ranging = Ranging(config.neighbors, self._filters, self._odometry, ranging_params)
        self._forget()

    def restart(self) -> None:
        """Forget everything, the own odometry too."""
        self._odometry.clear()
        self._forget()

    def _forget(self) -> None:
        for hypotheses in self._hypotheses.values():
            hypotheses.reset()
        for camera in self.cameras.values():
            camera.restart(self._targets)
        self._schedule.restart()
        self.ranging.restart()
        self._planned: Look | Missing | None = None

    def feed_odometry(self, sample: OdometrySample) -> bool:
        """Take the own state; return whether time jumped back and everything restarted."""
        jumped = self._odometry.add(sample)
        walk = ODOMETRY_WALK if sample.derived else 0.0
        for hypotheses in self._hypotheses.values():
            for track_filter in hypotheses.tracks:
                track_filter.walk = walk
        if jumped:
            self._forget()
        return jumped

    def ranged(self) -> Iterator[Ranged | Rejection]:
        """Yield the result of each range that odometry has reached."""
        return self.ranging.due(self._schedule.by_odometry)

    def missing(self, stamp: float, extrapolate: bool = False,
                camera: str = '') -> Missing | None:
        """Return why an image of this stamp, s, cannot be processed (yet), or None."""
        source = self.cameras[camera]
        last = stamp + source.time_offset.applied + source.readout_time
        return self._odometry.missing(last, extrapolate)

    def wanted(self, stamp: float, model: CameraModel, camera: str = '') -> bool:
        """
        Return whether to process the image of a stamp, s: else it need not even be decoded.

        With one camera always; with several cameras, only if a neighbour may be in the image.
        """
        if len(self.cameras) == 1:
            return True
        look = self._planned = self._plan(stamp, model, camera)
        return isinstance(look, Missing) or bool(look.sought.near) or (
            bool(look.sought.anywhere) and self._schedule.search_due(look.camera, stamp)
        ) or self._schedule.sweep_due(look.camera, stamp)

    def process_image(self, stamp: float, image: GrayImage, model: CameraModel,
                      camera: str = '') -> Sighting:
        """
        Return the estimates of the neighbours from an image (H, W) uint8 of a stamp, s.

        :raises ValueError: if the image is not of the camera's size, or not grey.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f'image = {image.dtype} of shape {image.shape}: must be (H, W) uint8')
        look, self._planned = self._planned, None
        if not isinstance(look, Look) or (look.stamp, look.model, look.camera) != (
                stamp, model, self.cameras[camera]):
            look = self._plan(stamp, model, camera)
        if isinstance(look, Missing):
            return Sighting(rejections=[(look.value, '')])
        model.check_image(image.shape[1], image.shape[0])
        self._track(image, look)
        look.sighting.stage = 'track'
        if len(look.measured) < look.sought.number:
            self._detect(image, look)
        if self._schedule.sweep_due(look.camera, stamp):
            self._locate(search.everywhere(image, self.config.dictionary), 'full', image, look)
            look.camera.swept = stamp
        look.sighting.other_ids = sorted(set(look.sighting.other_ids))
        for name, measurement in look.measured.items():
            look.camera.spacings[name] = measurement.spacing
            self._update(look, measurement)
        for measurement in look.others:
            self._update(look, measurement, other=True)
        return look.sighting

    def _plan(self, stamp: float, model: CameraModel, name: str) -> Look | Missing:
        """Return the expected content of an image, or why nothing is known."""
        camera, sought = self.cameras[name], self._schedule.everybody
        times = {name: self._schedule.time(name, camera, stamp + delay)
                 for name, delay in camera.delays.items()}
        if self._schedule.shared:
            missing = self._odometry.missing(stamp + camera.time_offset.applied)
            if missing is not None:
                return missing
            sought = self._schedule.sought(
                camera, stamp, model, times,
                lambda name: self._place(name, times[name], stamp, camera))
        look = Look(stamp, camera, model, sought)
        for name, delay in camera.delays.items():
            if name in sought.near or name in sought.anywhere:
                view = self._view(look, delay)
                if isinstance(view, Missing):
                    return view
                look.expected[name] = view.prior(self._filters[name].predict(times[name]))
        return look

    def _place(self, name: str, time: float, stamp: float,
               camera: MountedCamera) -> Transform | None:
        """Return about where a neighbour is in an image, ``T_camera_body``, if that is known."""
        body = self._filters[name].place(time)
        own = self._odometry.at(stamp + camera.time_offset.applied)
        if body is None or isinstance(own, Missing):
            return None
        return (own.smooth_pose @ camera.T_body_camera).inverse() @ body

    def _view(self, look: Look, delay: float) -> View | Missing:
        """Return the view of an image's camera at a delay, s, after the image's stamp."""
        if delay not in look.views:
            own = self._odometry.at(look.stamp + look.camera.time_offset.applied + delay)
            if isinstance(own, Missing):
                return own
            look.views[delay] = View.of(
                self._odometry.steadied(own), look.camera.T_body_camera, delay)
        return look.views[delay]

    def _estimate(self, name: str, track_filter: NeighborFilter, look: Look,
                  view: View) -> Estimate:
        """Return the state of a track at the image's stamp, by the odometry's clock, in odom."""
        stamp = look.stamp
        estimate = track_filter.near(self._schedule.by_odometry(name, stamp))
        assert estimate is not None, 'it was just taken in'
        exposed = look.camera.time_offset.applied + view.delay
        own = self._odometry.at(stamp) if exposed else view.own
        if isinstance(own, Missing):
            own = view.own
        return reported(estimate, stamp, own, *self._odometry.white_noise)

    def _track(self, image: GrayImage, look: Look) -> None:
        """Measure the neighbours, and the other candidates, by their edges."""
        camera = look.camera
        for name in look.sought.near:
            check = camera.unchecked[name] == 0
            measurement = track(image, look.model, self._targets[name], look.expected[name],
                                camera.spacings[name], check)
            if measurement is None:
                continue
            if self._of_candidate(look, measurement):
                look.others.append(measurement)
                continue
            look.measured[name] = measurement
            if not check:
                camera.unchecked[name] -= 1
            elif measurement.margin is not None and measurement.margin > MARGIN:
                camera.unchecked[name] = MIRRORED_EVERY - 1
        for name, hypotheses in self._hypotheses.items():
            for candidate in hypotheses.candidates:
                delay = camera.delays[name]
                view = self._view(look, delay)
                if isinstance(view, Missing):
                    continue
                expected = view.prior(candidate.track.predict(
                    self._schedule.time(name, camera, look.stamp + delay)))
                if self._schedule.in_view(name, look.model, expected.pose):
                    measurement = track(image, look.model, self._targets[name], expected, None,
                                        True)
                    if measurement is not None and not look.known(measurement, self._side[name]):
                        look.others.append(measurement)

    def _of_candidate(self, look: Look, measurement: Measurement) -> bool:
        """Return whether a measurement is of a candidate, not of the primary track."""
        name, camera = measurement.name, look.camera
        if not self._hypotheses[name].candidates:
            return False
        place = look.views[camera.delays[name]].T_smooth_camera @ measurement.T_camera_body
        return self._hypotheses[name].candidate_at(
            self._schedule.time(name, camera, look.stamp + camera.delays[name]),
            place.translation) is not None

    def _detect(self, image: GrayImage, look: Look) -> None:
        """Look for the neighbours that are not measured yet."""
        (near, anywhere, _), camera = look.sought, look.camera

        def missing() -> list[str]:
            return [name for name in anywhere if name not in look.measured]

        for thorough in (False, True):
            for name in [n for n in near if n not in look.measured and (
                    not thorough or n in anywhere)]:
                pose = look.expected[name].pose
                if pose is not None:
                    found = search.near(image, look.model, self.config.dictionary,
                                        self._targets[name].neighbor, pose, thorough)
                    look.sighting.stage = 'roi'
                    self._locate(found, 'roi', image, look)
        if missing() and self._schedule.search_due(camera, look.stamp):
            # The first time both ways: quickly, and if need be thoroughly; then they take turns.
            ways = (False, True) if camera.searched is None else (camera.thorough,)
            for thorough in ways:
                if missing():
                    found = search.everywhere(image, self.config.dictionary, [
                        m for name in missing() for m in self._targets[name].neighbor.markers
                    ] if thorough else None)
                    self._locate(found, 'full', image, look)
                    camera.thorough = not thorough
            look.sighting.stage, camera.searched = 'full', look.stamp
        camera.vain.update((name, look.stamp) for name in near if name not in look.measured)

    def _locate(self, found: Detections, stage: str, image: GrayImage, look: Look) -> None:
        """Turn detections that are not measured yet into measurements."""
        candidates: dict[str, list[Measurement]] = {}
        for marker_id, corners in zip(found.ids.tolist(), found.corners):
            if marker_id not in self._by_marker:
                look.sighting.other_ids.append(marker_id)
                continue
            neighbor, marker = self._by_marker[marker_id]
            name = neighbor.name
            if name not in look.expected or look.shown(corners, name, marker):
                continue
            measurement = locate(image, look.model, self._targets[name],
                                 neighbor.markers.index(marker), corners, look.expected[name])
            if measurement is None:
                look.sighting.rejections.append(
                    ('no pose suits the marker', f'{name}, {marker_id}'))
            elif not look.known(measurement, self._side[name]):
                measurement = measurement._replace(stage=stage)
                if self._of_candidate(look, measurement):
                    look.others.append(measurement)
                else:
                    candidates.setdefault(name, []).append(measurement)
        for name, several in candidates.items():
            if name not in look.measured:
                look.measured[name] = likeliest(several, look.expected[name].pose)
                look.camera.unchecked[name] = 0
            for each in several:
                if not look.known(each, self._side[name]):
                    look.others.append(each)

    def _update(self, look: Look, measurement: Measurement, other: bool = False) -> None:
        """
        Update a neighbour's track with a measurement, and add the estimate to the sighting.

        :param other: whether it is of a candidate, not of the primary track.
        """
        name, camera, sighting = measurement.name, look.camera, look.sighting
        delay = camera.exposed(look.model, measurement)
        view = self._view(look, delay)
        if isinstance(view, Missing):
            return
        time = self._schedule.time(name, camera, look.stamp + delay)
        T_camera_body, reference = measurement.T_camera_body, measurement.reference
        if camera.readout_time:
            T_camera_body = straightened(
                look.model, camera.readout_time, self._targets[name].neighbor, T_camera_body,
                reference,
                *view.passing(T_camera_body, reference, self._filters[name].predict(time)))
        T_smooth_body = view.T_smooth_camera @ T_camera_body
        turn, (place, attitude) = np.zeros((6, 6)), camera.noise.scales
        turn[:3, :3] = place * view.T_smooth_camera.rotation
        turn[3:, 3:] = attitude * view.T_smooth_camera.rotation
        covariance = turn.dot(measurement.covariance).dot(turn.T)
        covariance += camera.noise.covariance(T_smooth_body.apply(reference) - view.own.travel)
        outcome, candidate = self._hypotheses[name].take(
            time, T_smooth_body, reference, covariance, other and name in sighting.estimates)
        refused = outcome in (UpdateOutcome.OUTLIER, UpdateOutcome.LATE)
        if not other and (refused or outcome is UpdateOutcome.POSITION_ONLY):
            sighting.rejections.append((outcome.value, name))
        if refused or (other and outcome is not UpdateOutcome.STARTED):
            if candidate is not None and candidate.confirmed:
                sighting.duplicates[candidate.name(name)] = self._estimate(
                    name, candidate.track, look, view)
            return
        self._schedule.saw(name, camera, time)
        if not other:
            self._learn(name, camera, view, look.stamp + delay, measurement)
        sighting.measurements[name] = measurement
        sighting.estimates[name] = self._estimate(name, self._filters[name], look, view)

    def _learn(self, name: str, camera: MountedCamera, view: View, time: float,
               measurement: Measurement) -> None:
        """Learn clock and noise from a neighbour's update with a measurement at a time, s."""
        change, estimate = self._filters[name].change, self._filters[name].newest
        if change is not None and estimate is not None:
            camera.noise.take(*change, estimate.position - view.own.travel)
        point = measurement.T_camera_body.apply(measurement.reference)
        shift = camera.time_offset.take(name, time, point, camera.T_body_camera, self._odometry)
        if not shift:
            return
        camera.noise.restart()
        for other, hypotheses in self._hypotheses.items():
            if self._schedule.seen_last_by(other, camera):
                for each in hypotheses.tracks:
                    if each.newest is not None:
                        each.shift(shift * view.moving(each.newest.position - view.own.travel))
        self._schedule.changed(camera)

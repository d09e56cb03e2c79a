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
Perception: from images and ego odometry to the neighbors' states.

Detection in each image has up to three stages, the cheapest first:

=======  ==========================================================================
track    edges are fitted where the filter expects each neighbor's markers
roi      a neighbor not found that way is detected near its expected place
full     those missing even then are detected in the whole image, a portion in each image
=======  ==========================================================================

Once a second the whole image is searched even if no neighbor is missing, see ``hypotheses``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
    Transform,
)
from flock_follower.messages import duplicate_name
from flock_follower.odometry.buffer import Missing, OdometryBuffer, OdometrySample
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.perception import prints, search
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.camera_schedule import CameraSchedule, Sought
from flock_follower.perception.hypotheses import Hypotheses, Taken
from flock_follower.perception.images import GrayImage
from flock_follower.perception.look import (
    CameraMotion,
    DIRECTION_ERROR,
    Look,
    MeasuredPose,
    reported,
    row_delay,
    Sighting,
    straightened,
)
from flock_follower.perception.markers import Detections
from flock_follower.perception.measurement import angle, Measurement, PosePrior
from flock_follower.perception.neighbor_filter import (
    Estimate,
    FilterParams,
    NeighborFilter,
    UpdateOutcome,
)
from flock_follower.perception.neighbor_motion import ODOMETRY_WALK
from flock_follower.perception.pose import locate, MAX_TURN, target, track
from flock_follower.perception.range_tracking import Ranging, RangingParams
from flock_follower.perception.time_offset import MountedCamera, TimeOffset

#: The mirrored attitude is fitted in every image while its chi^2 is within this of the other's.
SETTLED_MARGIN = 100.0
#: Images from one fit of the mirrored attitude to the next, otherwise.
MIRRORED_EVERY = 30
#: Images from one fit of the mirrored attitude of a smeared print to the next.
SMEARED_EVERY = 3
#: Probability of the mirrored attitude below which the other one is settled.
SETTLED = 0.05
#: Of a pose that another detector measured: it comes without an image.
NO_IMAGE = CameraModel(np.eye(3), np.zeros(5), 'plumb_bob', 1, 1)


def camera_mounting(position: ArrayLike, rpy: ArrayLike) -> Transform:
    """
    Return ``T_body_camera``, optical, of a camera's place on the body.

    ``position`` (3,), m, FLU; ``rpy`` roll, pitch, yaw, rad, of the camera *link*, whose x axis
    is the line of sight: zeros look straight ahead.
    """
    link = quaternion_to_matrix(quaternion_from_rpy(*np.asarray(rpy, dtype=float)))
    return Transform(link @ R_FLU_OPTICAL, np.asarray(position, dtype=float))


class _Placed(NamedTuple):
    """
    A measurement in the smooth frame of ``OdometryBuffer``, with the view at its exposure.

    The exposure was at ``exposed`` by the camera's clock, and at ``time`` by the filter's, s;
    ``covariance`` (6, 6) and ``alike`` are as ``NeighborFilter.update`` takes them.
    """

    view: CameraMotion
    exposed: float
    time: float
    T_smooth_body: Transform
    covariance: Array
    alike: Array | None


class Tracker:
    """
    The neighbors of one drone, seen by one camera or several.

    Pass every odometry message to the tracker, and each image once :meth:`missing` returns None
    for its stamp. A single camera has the name ''. All times of filters are on the odometry's
    clock.

    :param cameras: by name; for a single camera its place on the body (optical) is enough.
    :param alone: whether there is no odometry: the camera is then always at the origin, with an
        unknown attitude, and all states are relative to the camera.
    """

    def __init__(self, config: NeighborConfig, cameras: Transform | Mapping[str, MountedCamera],
                 filter_params: FilterParams | None = None,
                 ranging_params: RangingParams | None = None, alone: bool = False) -> None:
        self.alone = alone
        self.config = config
        params = filter_params or FilterParams()
        if isinstance(cameras, Transform):
            cameras = {'': MountedCamera(cameras, attitude_noise=params.attitude_noise)}
        self.cameras = dict(cameras)
        self._odometry = OdometryBuffer()
        marked = [n for n in config.neighbors if n.markers]
        self._targets = {n.name: target(n, config.dictionary) for n in marked}
        self._side = {n.name: max(m.side_length for m in n.markers) for n in marked}
        self._hypotheses = {
            n.name: Hypotheses(params, n.source is None) for n in config.neighbors}
        self._filters = {name: each.primary for name, each in self._hypotheses.items()}
        self._marked = {n.name: self._filters[n.name] for n in marked}
        self._sources = {n.name: MountedCamera(
            Transform(), TimeOffset(fixed=True), attitude_noise=params.attitude_noise)
            for n in config.neighbors if n.source is not None}
        self._by_marker = config.by_marker()
        self._schedule = CameraSchedule(marked, len(self.cameras))
        self.ranging = Ranging(config.neighbors, self._filters, self._odometry, ranging_params)
        self._forget()

    def restart(self) -> None:
        """Forget everything, the ego odometry too."""
        self._odometry.clear()
        self._forget()

    def _forget(self) -> None:
        for hypotheses in self._hypotheses.values():
            hypotheses.reset()
        for camera in self.cameras.values():
            camera.restart(self._targets)
        for name, source in self._sources.items():
            source.restart([name])
        self._schedule.restart()
        self.ranging.restart()
        self._planned: tuple[float, MountedCamera, Sought | Missing] | None = None
        """The result of :meth:`wanted`, for the image that is processed next."""

    def feed_odometry(self, sample: OdometrySample) -> bool:
        """Take the ego state; return whether time jumped back and everything restarted."""
        jumped = self._odometry.add(sample)
        walk = ODOMETRY_WALK if sample.derived else 0.0
        for hypotheses in self._hypotheses.values():
            for track_filter in hypotheses.tracks:
                track_filter.walk = walk
        if jumped:
            self._forget()
        return jumped

    def missing(self, stamp: float, camera: str = '') -> Missing | None:
        """Return why an image of a stamp, s, cannot be processed yet, or None."""
        source = self.cameras[camera]
        last = stamp + source.time_offset.applied + source.readout_time
        return self._odometry.missing(last, extrapolate=False)

    @property
    def newest_odometry(self) -> float | None:
        """Return the newest stamp of the odometry, s, or None without any."""
        return self._odometry.newest

    def missing_odometry(self, stamp: float) -> Missing | None:
        """Return why there is no odometry of a stamp, s, yet, or None."""
        return self._odometry.missing(stamp, extrapolate=False)

    def own_pose(self, stamp: float) -> Transform | None:
        """Return the pose of this vehicle in odom at a stamp, s, if known."""
        own = self._odometry.at(stamp)
        return None if isinstance(own, Missing) else Transform(
            quaternion_to_matrix(own.quaternion), own.position)

    def wanted(self, stamp: float, model: CameraModel, camera: str = '') -> bool:
        """
        Return whether to decode and process the image of a stamp, s.

        With one camera always True; with several cameras only if a neighbor may be in the image.
        """
        source = self.cameras[camera]
        source.take_stamp(stamp)
        sought = self._sought(stamp, model, source)
        self._planned = stamp, source, sought
        return isinstance(sought, Missing) or bool(sought.near) or (
            bool(sought.anywhere) and self._schedule.search_due(source, stamp)
        ) or self._schedule.sweep_due(source, stamp)

    def process_image(self, stamp: float, image: GrayImage, model: CameraModel,
                      camera: str = '') -> Sighting:
        """
        Return the estimates of the neighbors from an image (H, W) uint8 of a stamp, s.

        :raises ValueError: if the image has not the camera's size, or is not gray.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f'image = {image.dtype} of shape {image.shape}: must be (H, W) uint8')
        self.cameras[camera].take_stamp(stamp)
        look = self._look(stamp, model, self.cameras[camera])
        if isinstance(look, Missing):
            return Sighting(rejections=[(look.value, '')])
        model.check_image(image.shape[1], image.shape[0])
        look.sighting.stage = 'track'
        for name in look.near:
            self._measure(image, look, name, track(
                image, model, self._targets[name], look.expected[name],
                look.camera.measured.get(name), look.camera.unchecked[name] == 0))
        for name, expected in self._candidates(look):
            found = track(image, model, self._targets[name], expected, None, True)
            if found is not None and not look.known(found, self._side[name]):
                look.others.append(found)
        self._detect(image, look)
        if self._schedule.sweep_due(look.camera, stamp):
            self._locate(search.everywhere(image, self.config.dictionary), 'full', image, look)
            look.camera.swept = stamp
        look.camera.vain.update((name, stamp + look.camera.time_offset.applied)
                                for name in look.near if name not in look.measured)
        look.sighting.other_ids = sorted(set(look.sighting.other_ids))
        return self._take(look)

    def process_pose(self, stamp: float, name: str, T_frame_body: Transform, covariance: Array,
                     T_body_frame: Transform | None) -> Sighting:
        """
        Return the estimate of a neighbor from its pose as another detector measured it.

        :param covariance: (6, 6), position, m, and rotation vector, rad, along the frame's axes.
        :param T_body_frame: the frame on the ego body; None: the frame is that of odom.
        """
        camera = self._sources[name]
        camera.T_body_camera = T_body_frame or Transform()
        view = self._view(camera, stamp)
        if isinstance(view, Missing):
            return Sighting(rejections=[(view.value, '')])
        if T_body_frame is None:
            view = view._replace(T_smooth_camera=Transform(np.eye(3), -view.own.correction))
        measurement = Measurement(name, T_frame_body, np.zeros(3), covariance, 0.0, None)
        return self._take(Look(
            stamp, stamp, camera, NO_IMAGE, view, [], [], {}, measured={name: measurement}))

    def _take(self, look: Look) -> Sighting:
        """Update the tracks with all measurements; return the sighting."""
        for measurement in (*look.measured.values(), *look.others):
            placed = self._placed(look, measurement)
            if placed is not None:
                name = measurement.name
                self._report(look, measurement, placed, self._hypotheses[name].take(
                    placed.time, placed.T_smooth_body, measurement.reference, placed.covariance,
                    name in look.sighting.estimates, placed.alike))
        return look.sighting

    def _sought(self, stamp: float, model: CameraModel, camera: MountedCamera) -> Sought | Missing:
        """Return the neighbors to look for in an image, or why that is not known."""
        if len(self.cameras) == 1:
            return Sought([*self._marked], [*self._marked])
        time = stamp + camera.time_offset.applied
        own = self._odometry.at(time)
        if isinstance(own, Missing):
            return own
        T_camera_odom = (own.smooth_pose @ camera.T_body_camera).inverse()
        return self._schedule.sought(camera, time, model, T_camera_odom, self._marked)

    def _look(self, stamp: float, model: CameraModel, camera: MountedCamera) -> Look | Missing:
        """Return the expected content of an image, or why nothing is known."""
        planned, self._planned = self._planned, None
        sought = planned[2] if planned is not None and planned[:2] == (stamp, camera) else (
            self._sought(stamp, model, camera))
        if isinstance(sought, Missing):
            return sought
        exposed = stamp + 0.5 * camera.readout_time
        view = self._view(camera, exposed)
        if isinstance(view, Missing):
            return view
        return Look(stamp, exposed, camera, model, view, *sought, {
            name: self._prior(view, self._filters[name].predict(
                self._time(name, camera, exposed)))
            for name in {*sought.near, *sought.anywhere}})

    def _prior(self, view: CameraMotion, estimate: Estimate | None) -> PosePrior:
        """Return the expected pose; without odometry, the upward direction is unknown."""
        prior = view.prior(estimate)
        return prior._replace(up=None) if self.alone else prior

    def _view(self, camera: MountedCamera, exposed: float) -> CameraMotion | Missing:
        """Return the view of a camera at a time by its clock, s."""
        own = self._odometry.at(exposed + camera.time_offset.applied)
        if isinstance(own, Missing):
            return own
        return CameraMotion.of(self._odometry.steadied(own), camera.T_body_camera)

    def _time(self, name: str, camera: MountedCamera, exposed: float) -> float:
        """Return the time of a neighbor's filter, s, of an exposure by the camera's clock, s."""
        return self._schedule.time(name, camera, exposed + camera.time_offset.applied)

    def _measure(self, image: GrayImage, look: Look, name: str,
                 found: Measurement | None) -> None:
        """Take the measurement of a neighbor near its expected place, if it was found there."""
        if found is None:
            return
        if self._of_candidate(look, found):
            look.others.append(found)
            return
        found = look.confirmed(image, found, self._targets[name], self.config.dictionary)
        look.measured[name] = found
        unchecked, last = look.camera.unchecked, look.camera.measured.get(name)
        if found.margin is not None:
            unchecked[name] = self._images_unchecked(found, look.expected[name])
        elif found.spacing is None and last is not None and last.spacing is not None:
            unchecked[name] = 0  # its edges decided until now
        elif unchecked[name]:
            unchecked[name] -= 1

    def _images_unchecked(self, found: Measurement, expected: PosePrior) -> int:
        """Return the number of images until the mirrored attitude is checked again."""
        assert found.margin is not None
        if found.spacing is not None:
            return MIRRORED_EVERY - 1 if found.margin > SETTLED_MARGIN else 0
        # Both attitudes in one, with a margin of 0, may part soon.
        settled = found.margin > 0.0 and found.doubt < SETTLED and expected.pose is not None and (
            angle(found.T_camera_body, expected.pose) < 0.5 * MAX_TURN)
        return SMEARED_EVERY - 1 if settled else 0

    def _candidates(self, look: Look) -> Iterator[tuple[str, PosePrior]]:
        """Yield the name and the expected pose of each candidate in view."""
        for name in self._marked:
            for candidate in self._hypotheses[name].candidates:
                expected = self._prior(look.view, candidate.track.predict(
                    self._time(name, look.camera, look.exposed)))
                if expected.pose is not None and self._schedule.in_view(
                        name, look.model, expected.pose):
                    yield name, expected

    def _of_candidate(self, look: Look, measurement: Measurement) -> bool:
        """Return whether a measurement is of a candidate, not of the primary track."""
        name, hypotheses = measurement.name, self._hypotheses[measurement.name]
        return bool(hypotheses.candidates) and hypotheses.candidate_at(
            self._time(name, look.camera, look.exposed),
            (look.view.T_smooth_camera @ measurement.T_camera_body).translation) is not None

    def _detect(self, image: GrayImage, look: Look) -> None:
        """Look for the neighbors that are not measured yet."""
        camera, dictionary = look.camera, self.config.dictionary
        if look.measured.keys() >= {*look.near, *look.anywhere}:
            camera.portion, camera.searched_near = 0, False
            return
        camera.portion = camera.portion if look.missing else 0
        due = self._schedule.search_due(camera, look.stamp)
        for thorough in (False, True):
            for name in [n for n in look.near if n not in look.measured and (
                    not thorough or n in look.anywhere)]:
                pose = look.expected[name].pose
                if pose is not None and not (thorough and due and camera.searched_near):
                    look.sighting.stage = 'roi'
                    # In turns, for smeared and covered markers and for others.
                    smeared = name in camera.measured and camera.measured[name].smear is not None
                    self._locate(search.near(image, look.model, dictionary,
                                             self._targets[name].neighbor, pose, thorough,
                                             thorough and (camera.portion % 2 > 0) != smeared),
                                 'roi', image, look)
        # Unless images are rare, one has time for a thorough search near by, or for a portion.
        near = any(look.expected[name].pose is not None for name in look.missing
                   if name in look.near)
        camera.searched_near = near and not (due and camera.searched_near) and (
            not self._schedule.has_time_for_all(camera))
        if not look.missing or not due or camera.searched_near:
            return
        for _ in range(self._schedule.portions(camera, look.stamp)):
            if look.missing:
                markers = [m for n in look.missing for m in self._targets[n].neighbor.markers]
                unseen = any(self._filters[name].newest is None for name in look.missing)
                rounds, number = divmod(camera.portion, search.N_PORTIONS)
                self._locate(search.portion(
                    image, dictionary, markers, number, prints.border_sought(rounds) if unseen
                    else prints.BORDER_WIDTHS[0]), 'full', image, look)
                camera.portion += 1
        look.sighting.stage, camera.searched = 'full', look.stamp

    def _locate(self, found: Detections, stage: str, image: GrayImage, look: Look) -> None:
        """Fit poses to the detections that have no measurement yet."""
        located = []
        for marker_id, corners in zip(found.ids.tolist(), found.corners):
            if marker_id not in self._by_marker:
                look.sighting.other_ids.append(marker_id)
                continue
            neighbor, marker = self._by_marker[marker_id]
            name = neighbor.name
            if name not in look.expected or look.shown(corners, name, marker):
                continue
            expected = look.expected[name]
            # A neighbor that is tracked has shown its border.
            fault = prints.wrong_border(image, corners, self.config.dictionary, marker) if (
                expected.pose is None) else None
            measurement = None if fault else locate(
                image, look.model, self._targets[name], neighbor.markers.index(marker), corners,
                expected, found.most_rms)
            if measurement is not None:
                fault = prints.turned_print(measurement.T_camera_body, expected.up, marker)
            if fault is not None:
                look.sighting.rejections.append((fault.reason, f'{fault.seen}: {fault.remedy}'))
                look.sighting.misprints[name] = fault
            elif measurement is None:
                look.sighting.rejections.append(
                    ('no pose suits the marker', f'{name}, {marker_id}'))
            else:
                located.append(measurement._replace(stage=stage))
        for each in sorted(located, key=look.distance):
            name = each.name
            if look.known(each, self._side[name]):
                continue
            if name in look.measured or self._of_candidate(look, each):
                look.others.append(each)
            else:
                look.measured[name] = each
                look.camera.unchecked[name] = 0

    def _placed(self, look: Look, measurement: Measurement) -> _Placed | None:
        """Return a measurement in the smooth frame; None without odometry of its exposure."""
        camera, name = look.camera, measurement.name
        pose, reference = measurement.T_camera_body, measurement.reference
        view: CameraMotion | Missing = look.view
        exposed = look.stamp
        if camera.readout_time:
            exposed += row_delay(look.model, camera.readout_time, pose.apply(reference))
            view = self._view(camera, exposed)
        if isinstance(view, Missing):
            return None
        time = self._time(name, camera, exposed)
        if camera.readout_time:
            pose = straightened(
                look.model, camera.readout_time, self._targets[name].neighbor, pose, reference,
                *view.passing(pose, reference, self._filters[name].predict(time)))
        T_smooth_body = view.T_smooth_camera @ pose
        turn, (place, attitude) = np.zeros((6, 6)), camera.noise.scales
        turn[:3, :3] = place * view.T_smooth_camera.rotation
        turn[3:, 3:] = attitude * view.T_smooth_camera.rotation
        covariance = turn.dot(measurement.covariance).dot(turn.T)
        alike = measurement.alike * covariance if measurement.alike else None
        covariance += camera.noise.covariance(T_smooth_body.apply(reference) - view.own.travel)
        return _Placed(view, exposed, time, T_smooth_body, covariance, alike)

    def _report(self, look: Look, measurement: Measurement, placed: _Placed, taken: Taken) -> None:
        """Add the outcome of a measurement to the sighting, and learn from it."""
        name, camera, sighting = measurement.name, look.camera, look.sighting
        outcome, candidate = taken
        other = look.measured.get(name) is not measurement
        refused = outcome in (UpdateOutcome.OUTLIER, UpdateOutcome.OLDER)
        if not other and (refused or outcome is UpdateOutcome.POSITION_ONLY):
            sighting.rejections.append((outcome.value, name))
        if refused:
            if candidate is not None and candidate.confirmed:
                sighting.duplicates[duplicate_name(name, candidate.number)] = self._estimate(
                    candidate.track, look, placed)
            return
        self._schedule.saw(name, camera, placed.time)
        camera.measured[name] = measurement
        if not other:
            self._learn(camera, measurement, placed)
        sighting.measurements[name] = measurement
        sighting.estimates[name] = self._estimate(self._filters[name], look, placed)
        if outcome is not UpdateOutcome.POSITION_ONLY and name in self._marked:
            sighting.poses[name] = partial(  # few need it
                MeasuredPose.of, measurement, placed.view.T_smooth_camera, placed.T_smooth_body,
                camera.noise.scales, DIRECTION_ERROR / float(look.model.matrix[0, 0]),
                camera.noise.distance)

    def _estimate(self, track_filter: NeighborFilter, look: Look, placed: _Placed) -> Estimate:
        """Return the state of a track at the image's stamp, in odom."""
        estimate, own = track_filter.near(look.stamp), placed.view.own
        assert estimate is not None, 'it was just taken in'
        if look.camera.time_offset.applied or placed.exposed != look.stamp:
            stamped = self._odometry.at(look.stamp)
            own = own if isinstance(stamped, Missing) else stamped
        return reported(estimate, look.stamp, own, *self._odometry.white_noise)

    def _learn(self, camera: MountedCamera, measurement: Measurement, placed: _Placed) -> None:
        """Learn clock and noise from a neighbor's update with a measurement."""
        name, view = measurement.name, placed.view
        change, estimate = self._filters[name].change, self._filters[name].newest
        if change is not None and estimate is not None:
            camera.noise.take(*change, estimate.position - view.own.travel)
        point = measurement.T_camera_body.apply(measurement.reference)
        offset_change = camera.time_offset.take(
            name, placed.exposed, point, camera.T_body_camera, self._odometry)
        if not offset_change:
            return
        camera.noise.restart()
        for other, hypotheses in self._hypotheses.items():
            if self._schedule.seen_last_by(other, camera):
                for each in hypotheses.tracks:
                    if each.newest is not None:
                        sight = each.newest.position - view.own.travel
                        each.add_error(offset_change * view.moving(sight), offset_change)

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
Perception from messages to messages: calibrations, odometry, and the queue of images.

An image is processed as soon as odometry has reached its stamp. It waits at most a little longer
than recent images, and never longer than ``max_wait``.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from flock_follower.messages import DUPLICATE, Make, OdometryState
from flock_follower.messages.poses import (
    acceleration,
    pose_topic,
    pose_with_covariance,
    PoseState,
    RangeState,
)
from flock_follower.messages.state_writer import odometry
from flock_follower.odometry.buffer import Missing, OdometrySample
from flock_follower.odometry.choice import OdometryChoice
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode_image, DecodedImage, GrayImage
from flock_follower.perception.neighbor_filter import Estimate
from flock_follower.perception.observed_wait import N_OBSERVED, ObservedWait
from flock_follower.perception.pose_sources import PoseSources
from flock_follower.perception.range_tracking import Rejection
from flock_follower.perception.tracker import Sighting, Tracker

MOST_PENDING = 100  # images of a camera: 0.35 s at 250 Hz, and a bound on memory
#: Odometry is late after this factor times the longest observed wait, plus a margin.
LATE_FACTOR = 1.5
ODOMETRY_LAGS = 'odometry lags behind the images'
NO_CAMERA = 'no usable camera_info'
INVALID_IMAGE = 'invalid image'
UNKNOWN_ATTITUDE = 10.0  # rad^2, variance of an attitude of which nothing is known
_UNUSABLE = frozenset({NO_CAMERA, INVALID_IMAGE, *(missing.value for missing in Missing)})
JUMPED = ('time jumped back', 'every track starts anew')


class PendingImage(NamedTuple):
    """
    An image message, its time of arrival (s, any clock), its stamp in ns and s, its camera.

    ``model`` is the calibration, set by :meth:`Perceiver.process`; None before a usable
    calibration.
    """

    received: float
    stamp_ns: int
    stamp: float
    message: Any
    camera: str = ''
    model: CameraModel | None = None


class Processed(NamedTuple):
    """
    The result of one image.

    ``pixels`` is None if the image was not decoded, because it cannot be used, or no neighbor is
    searched in it. ``decoding`` and ``perception`` are the times spent, s.
    """

    image: PendingImage
    sighting: Sighting
    pixels: GrayImage | None
    decoding: float
    perception: float

    @property
    def usable(self) -> bool:
        """Return whether calibration, odometry and image were available for a search."""
        return not any(reason in _UNUSABLE for reason, _ in self.sighting.rejections)


class _Calibrated:
    """The calibration of one camera; without one, its fault."""

    def __init__(self) -> None:
        self.model: CameraModel | None = None
        self.fault = 'none came yet'
        self.calibration: tuple[Any, ...] = ()
        self.frame = ''  # of the camera, optical


class Perceiver:
    """
    Feeds a tracker from messages.

    ``now`` is in seconds on a clock without jumps, the same clock for all calls. Cameras have
    their names, as in the tracker; a single camera has the name ''.

    :param max_wait: the longest time for which an image waits for odometry of its stamp, s.
    """

    def __init__(self, tracker: Tracker, *, max_wait: float) -> None:
        self.tracker = tracker
        self.frame = ''
        self._choice = OdometryChoice()
        self._wait = ObservedWait(max_wait, LATE_FACTOR, N_OBSERVED)  # of images for odometry
        self._cameras = {name: _Calibrated() for name in tracker.cameras}
        self.sources = PoseSources(tracker, max_wait)
        self._epoch: int | None = None
        self._pending: list[PendingImage] = []  # by stamp: one from the future blocks no other

    @property
    def overdue(self) -> float | None:
        """Return the time at which the wait of an image ends, s, or None."""
        return min((image.received + self._wait.limit for image in self._pending), default=None)

    def model(self, camera: str = '') -> CameraModel | None:
        """Return the calibration of a camera; None before a usable one."""
        return self._cameras[camera].model

    def take_camera_info(self, message: Any, camera: str = '') -> bool:
        """
        Take a CameraInfo; return whether it holds another calibration than the one before.

        :raises ValueError: if it is unusable; no image is processed until a usable message comes.
        """
        roi, rectified = message.roi, self.tracker.cameras[camera].rectified
        # Of an image that is not rectified P does not count, and may be NaN, unlike itself.
        calibration = (tuple(message.k), tuple(message.d), rectified and tuple(message.p),
                       message.distortion_model, message.width, message.height,
                       roi.x_offset, roi.y_offset, roi.width, roi.height,
                       message.binning_x, message.binning_y)
        known = self._cameras[camera]
        if known.frame != message.header.frame_id:
            known.frame = message.header.frame_id
            self.sources.place_cameras(
                (each.frame, self.tracker.cameras[name].T_body_camera)
                for name, each in self._cameras.items())
        if calibration == known.calibration:
            return False
        known.model, known.calibration = None, ()
        try:
            known.model = CameraModel.from_info(message, rectified)
        except ValueError as error:
            known.fault = str(error)
            raise
        known.calibration = calibration
        return True

    def take_odometry(self, state: OdometryState) -> bool:
        """
        Take the ego state; return whether time jumped back and everything restarted.

        In this case the waiting images are forgotten.
        """
        if not self._choice.takes(state):
            return False
        if self.frame not in ('', state.frame):
            self.tracker.restart()  # its estimates are in the old frame
            self.sources.restart()
        self.frame = state.frame
        jumped = self.tracker.feed_odometry(
            OdometrySample.from_state(state, self._seconds(state.stamp)))
        if jumped:
            self._pending.clear()
            self.sources.restart()
        return jumped

    def take_image(self, message: Any, stamp: int, now: float,
                   camera: str = '') -> PendingImage | None:
        """
        Take an Image or CompressedImage; return the oldest waiting image if it was dropped.

        :param stamp: its stamp, ns.
        """
        image = PendingImage(now, stamp, self._seconds(stamp), message, camera)
        if self.tracker.alone:
            self._stand_still(image)
        insort(self._pending, image, key=lambda waiting: waiting.stamp_ns)
        most = MOST_PENDING * len(self._cameras)
        return self._pending.pop(0) if len(self._pending) > most else None

    def _stand_still(self, image: PendingImage) -> None:
        """Set the camera as the origin at the stamp of an image (``odometry: none``)."""
        header = getattr(image.message, 'header', None)
        self.frame = self._cameras[image.camera].frame if header is None else header.frame_id
        rest = np.zeros(3)
        last = image.stamp + self.tracker.cameras[image.camera].readout_time
        for stamp in sorted({image.stamp, last}):
            if self.tracker.feed_odometry(OdometrySample(
                    stamp, rest, np.array([0.0, 0.0, 0.0, 1.0]), rest, rest)):
                self._pending.clear()

    def process(self, now: float, clock: Callable[[], float] = lambda: 0.0,
                shown: Callable[[str], bool] = lambda _: False) -> Processed | None:
        """
        Process the next image that need not wait, and return its result; None if all wait.

        :param clock: measures the time spent, s.
        :param shown: returns, for a camera's name, whether its images are decoded in any case.
        """
        ready = next((each for each in self._pending if self._is_ready(each, now)), None)
        if ready is None:
            return None
        self._pending = [each for each in self._pending if each is not ready]
        image = ready._replace(model=self._cameras[ready.camera].model)
        sighting, pixels = Sighting(), None
        start = decoded = clock()
        try:
            if image.model is None:
                sighting.rejections.append((NO_CAMERA, self._cameras[image.camera].fault))
            elif shown(image.camera) or self.tracker.wanted(
                    image.stamp, image.model, image.camera):
                pixels = decode_image(image.message)
                decoded = clock()
                sighting = self.tracker.process_image(
                    image.stamp, pixels, image.model, image.camera)
        except ValueError as error:
            sighting.rejections.append((INVALID_IMAGE, str(error)))
        ahead = image.message.spent if isinstance(image.message, DecodedImage) else 0.0
        return Processed(
            image, sighting, pixels, ahead + (decoded - start), clock() - decoded)

    def _is_ready(self, image: PendingImage, now: float) -> bool:
        """Return whether to process an image now: it waits for calibration and odometry."""
        waited = now - image.received
        reached = self._cameras[image.camera].model is not None and self.tracker.missing(
            image.stamp, camera=image.camera) not in (Missing.TOO_NEW, Missing.EMPTY)
        if reached:
            self._wait.observe(waited)
        elif waited < self._wait.limit:
            return False
        else:
            self._wait.forget()
        return True

    def take_range(self, measured: RangeState) -> Rejection | None:
        """Take a range for ``tracker.ranging.due``; return why it is refused, or None."""
        return self.tracker.ranging.take(measured, self._seconds(measured.stamp))

    def take_pose(self, name: str, state: PoseState, now: float) -> Rejection | None:
        """Take another detector's pose for ``sources.due``; return why it is refused, or None."""
        return self.sources.take(name, state, self._seconds(state.stamp), now, self.frame)

    def take_frame(self, stamp: int, now: float) -> None:
        """Take the stamp, ns, of an image that another detector processes."""
        self.sources.take_frame(stamp, self._seconds(stamp), now)

    def messages(self, make: Make, stamp: int, name: str, estimate: Estimate) -> tuple[Any, Any]:
        """Return an estimate of a stamp, ns, as Odometry, and its AccelWithCovarianceStamped."""
        twist, covariance = estimate.child_twist, estimate.pose_covariance
        source = self.sources.sources.get(name.partition(DUPLICATE)[0])
        if source is not None and source.position_only:
            covariance[3:], covariance[:3, 3:] = 0.0, 0.0
            covariance[3:, 3:] = UNKNOWN_ATTITUDE * np.eye(3)
        return odometry(
            make, stamp, self.frame, name, estimate.position, estimate.quaternion,
            twist[:3], twist[3:], covariance, estimate.child_twist_covariance,
        ), acceleration(make, stamp, name, estimate.child_acceleration,
                        estimate.child_acceleration_covariance)

    def poses(self, make: Make, seen: Processed,
              wanted: Callable[[str], bool] = lambda _: True) -> Iterator[tuple[str, Any]]:
        """
        Yield the topic and PoseWithCovarianceStamped of each pose measured in an image.

        :param wanted: returns, for a topic, whether a message is needed.
        """
        image = seen.image
        header = getattr(image.message, 'header', None)  # pixels have none
        frame = self._cameras[image.camera].frame if header is None else header.frame_id
        for name, measured in seen.sighting.poses.items():
            if wanted(topic := pose_topic(name)):
                yield topic, pose_with_covariance(make, image.stamp_ns, frame, *measured())

    def _seconds(self, nanoseconds: int) -> float:
        """Return the seconds since the first stamp: small floats resolve a nanosecond."""
        if self._epoch is None:
            self._epoch = nanoseconds
        return (nanoseconds - self._epoch) * 1e-9

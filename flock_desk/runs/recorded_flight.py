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
A recorded flight through one follower: what a bag holds becomes its events.

A message comes when it was recorded, so images and odometry are as late, and in the same order,
as they were in flight. The planner is engaged and the vehicle armed, in the air and in offboard
mode from the first message on; its autopilot's own velocity and yaw are in no bag, so those of
``odom`` stand in where ``velocity_source`` asks for them.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, Final

from flock_follower.bags.bag import deserialize
from flock_follower.follower import Follower, ImageOutcome, Listener
from flock_follower.mavlink.dialects import VehicleStatus
from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.gate import Gate
from flock_follower.mavlink.velocity_check import AUTOPILOT
from flock_follower.messages import (
    from_range,
    Make,
    RANGE,
    read_stamp,
)
from flock_follower.odometry.cdr import read_odometry
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters import (
    planner_table,
    relative_pose_table,
)
from flock_follower.parameters.cameras_table import cameras
from flock_follower.parameters.spec import filled
from flock_follower.perception.images import GrayImage
from flock_follower.perception.pending_images import INVALID_IMAGE, Perceiver
from flock_follower.planner.loop import PlannerLoop

#: What the autopilot is taken to be while the bag was recorded.
FLYING: Final = VehicleStatus(True, 'OFFBOARD', 'active', True)
INVALID_ODOMETRY: Final = 'invalid odom'
#: Where a message with a header goes on after encapsulation and stamp.
_AFTER_STAMP: Final = 12


class RecordedFlight:
    """
    Feeds a follower from the messages of a bag, CDR bytes with the time of recording in ns.

    :param values: the checked values of every parameter, by node, see ``TABLE``.
    :param listener: receives the events of the flight.
    :param make: returns an empty message of a type.
    :param cpu_time: see ``Follower``.
    :raises ValueError: if values do not fit together, or the neighbours file is wrong.
    :raises OSError: if the neighbours file cannot be read.
    """

    def __init__(self, values: dict[str, dict[str, Any]], listener: Listener, make: Make,
                 cpu_time: Callable[[], float] = lambda: 0.0) -> None:
        perception, bridge = values['relative_pose'], values['mavlink_bridge']
        self.perceiver = Perceiver(
            relative_pose_table.build(perception), max_wait=perception['max_wait'])
        self.planner_params = planner_table.build(values['planner'])
        rpy = {camera.name: camera.rpy for camera in cameras(values['planner'])}
        # What else feeds the planner, such as require_bridge, is as when the bridge flies it.
        self.follower = Follower(
            PlannerLoop(), self.planner_params, Gate(
                filled(GateLimits(), bridge), bridge['velocity_source']),
            listener, make, perceiver=self.perceiver, stream_rate=bridge['stream_rate'],
            autopilot_velocity=bridge['velocity_source'] == AUTOPILOT,
            camera_rpy=rpy, cpu_time=cpu_time)
        self.source = OdometrySource(filled(SourceParams(), perception, 'odom_'))
        self._listener = listener
        self._calibrations: dict[str, bytes] = {}
        self._began = False

    def take_odometry(self, time: int, data: bytes, message: Any = None) -> None:
        """Take a nav_msgs/Odometry of ``odom``; ``message``: its fields, if they were read."""
        self._begin(time)
        try:
            state = self.source.take(message or read_odometry(data), time)
        except ValueError as error:
            self._reject(time, INVALID_ODOMETRY, error)
            return
        for event in self.source.new_events():
            self._listener.rejected(*event)
        if state is not None:
            self.follower.odometry(time, state)

    def take_camera_info(self, time: int, data: bytes, camera: str = '') -> None:
        """Take a sensor_msgs/CameraInfo, of one of several cameras by its name."""
        self._begin(time)
        calibration = data[_AFTER_STAMP:]
        if calibration == self._calibrations.get(camera):
            return  # all but the first, usually
        self._calibrations[camera] = calibration
        try:
            self.follower.camera_info(
                time, deserialize(data, 'sensor_msgs/msg/CameraInfo'), camera)
        except ValueError as error:
            self._reject(time, 'invalid camera_info', error)

    def take_image(self, time: int, msgtype: str, data: bytes, camera: str = '',
                   message: Any = None, pixels: GrayImage | None = None) -> None:
        """
        Take a sensor_msgs/Image or CompressedImage, of one of several cameras by its name.

        :param message: its fields, if they were read; ``pixels`` (H, W), if it was decoded.
        """
        self._begin(time)
        try:
            image = message or deserialize(data, msgtype)
            stamp = read_stamp(image.header.stamp)
        except ValueError as error:
            self._reject(time, INVALID_IMAGE, error)
            self._listener.image(ImageOutcome(time, camera=camera))
            return
        self.follower.image(time, image if pixels is None else pixels, stamp, camera)

    def take_range(self, time: int, data: bytes) -> None:
        """Take a sensor_msgs/Range of ``ranges``."""
        self._begin(time)
        try:
            measured = from_range(deserialize(data, RANGE))
        except ValueError as error:
            self._reject(time, 'invalid ranges', error)
            return
        self.follower.range(time, measured)

    def finish(self) -> None:
        """Process the images that still wait: no more will come."""
        self.follower.finish()

    def _reject(self, time: int, reason: str, error: ValueError) -> None:
        self.follower.advance(time)
        self._listener.rejected(reason, str(error))

    def _begin(self, time: int) -> None:
        """Begin the flight with the first message."""
        if not self._began:
            self._began = True
            self.follower.engage(time, True)
            self.follower.permit(time, -math.inf)
            self.follower.vehicle(time, FLYING)

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

"""The vehicle of another simulator node, which this one's camera sees as the leader."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib

from nav_msgs.msg import Odometry
import numpy as np
from rclpy.qos import QoSProfile

from flock_desk.closed_loop.flown import ExternalLeader
from flock_desk.external.external_motion import ExternalMotion, Motion
from flock_follower.geometry import normalize_quaternion
from flock_follower.messages import from_odometry
from flock_follower.nodes.support.runtime import FlockNode

SILENT_NS = 500_000_000


class VehicleAhead:
    """Receives the true motion of the vehicle on a topic, see ``SimulatorOutputs.motion``."""

    def __init__(self, node: FlockNode, topic: str) -> None:
        self._motion = ExternalMotion()
        node.subscribe(Odometry, topic, self._take, QoSProfile(depth=10))

    def left(self, now_ns: int) -> int | None:
        """Return the time of its last motion, ns, if it is silent since then; else None."""
        newest = self._motion.newest
        return newest if newest is not None and now_ns - newest > SILENT_NS else None

    def leader(self, epoch_ns: int, offset: Sequence[float]) -> ExternalLeader:
        """
        Return it as the leader of a flight that begins at ``epoch_ns`` of ROS time.

        :param offset: (3,), m, where the odom frame of that vehicle begins in ours.
        """
        return ExternalLeader(self._motion, epoch_ns, np.asarray(offset, dtype=float))

    def _take(self, message: Odometry) -> None:
        state = from_odometry(message)
        with contextlib.suppress(ValueError):  # not normalizable: no attitude
            self._motion.add(Motion(
                state.stamp, state.position, state.velocity,
                normalize_quaternion(state.quaternion), state.angular_velocity))

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

"""Inputs of the planner between two ticks, and one command per tick."""

from __future__ import annotations

from collections import deque
import math
from typing import Any

from numpy.typing import ArrayLike

from flock_follower.geometry import Array, yaw_from_quaternion
from flock_follower.messages import FUTURE_TOLERANCE, OdometryState, RELATIVE
from flock_follower.messages.accelerations import AccelerationState, with_acceleration
from flock_follower.messages.bridge_reading import BridgeState, effective_state, parse
from flock_follower.messages.bridge_state import ACTIVE, TAKEN_OVER
from flock_follower.messages.commands import Command
from flock_follower.odometry.choice import OdometryChoice
from flock_follower.planner.inputs import Neighbor, OwnState, propagate
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import odometry_fault, State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.sight import FieldOfView, FieldsOfView
from flock_follower.planner.step import Decision, Inputs, step

#: Largest standard deviation of a neighbor's yaw that is used, rad.
MAX_YAW_STD = 0.5
#: ns between the stamps of a neighbor's state and of its acceleration, two messages.
ACCELERATION_AGE = 100_000_000
#: Processed images of which the stamps are kept.
FRAMES = 20
#: Messages of odometry: 2 s at 10 Hz; a late one at 60 Hz counts for 0.3 s.
REMEMBERED = 20


class PlannerLoop:
    """
    Collects inputs, and passes them to one step of the core per tick.

    The planner is active while it is engaged, and the bridge reports that it flies the commands.
    ``memory`` is the state after the last step; ``missed`` counts the late ticks.

    :param require_bridge: whether this report is required; if not, the planner need only be
        engaged.
    """

    def __init__(self, require_bridge: bool = True) -> None:
        self.memory = Memory()
        self.missed = 0
        self.view: FieldsOfView = ()
        """Fields of view of the cameras; () if unknown."""
        self._fields: dict[str, FieldOfView] = {}
        self.ground: float | None = None
        """Height at which the vehicle was armed, in the frame of the odometry, m, if known."""
        self._require_bridge = require_bridge
        self.engaged = False
        """Whether commands are requested; set by :meth:`engage`."""
        self._disengaged_by = ''
        self._bridge: BridgeState | None = None
        self._interrupted = False
        self._frame = ''
        self._choice = OdometryChoice()
        self._own: OdometryState | None = None
        self._newest = 0
        self._ages: deque[float] = deque(maxlen=REMEMBERED)
        self._accelerations: list[AccelerationState] = []
        self._earlier_accelerations: list[AccelerationState] = []
        self._neighbors: list[tuple[OdometryState, bool]] = []
        self._looked: int | None = None
        self._frames: deque[int] = deque(maxlen=FRAMES)
        self._epoch: int | None = None

    def engage(self, requested: bool) -> None:
        """
        Request commands, or end the request.

        A repeated request has no effect, unless the planner has given up.
        """
        self.engaged, self._disengaged_by = requested, ''
        self._interrupted |= not requested or self.memory.given_up
        self.memory = self.memory._replace(given_up=False)

    def take_bridge_state(self, text: str, silence: float) -> BridgeState:
        """
        Take, and return, the state that the bridge reports; see ``bridge_state``.

        A takeover, by the pilot or a failsafe, disengages the planner: it commands only after it
        is engaged again. The bridge may name the cause later.

        :param silence: time since the previous message, s.
        """
        # If the vehicle does not fly now, the next tick or the next message finds it waiting.
        self._interrupted |= bool(self.waiting_reason(silence))
        before, self._bridge = self._bridge, parse(text)
        if not self._require_bridge or self._bridge.name != TAKEN_OVER:
            return self._bridge
        if begins := self.engaged and (before is None or before.name != TAKEN_OVER):
            self.engage(False)
        if begins or self._disengaged_by:
            why = f' ({self._bridge.reason})' if self._bridge.reason else ''
            self._disengaged_by = f'taken over{why}: call planner/engage to follow again'
        return self._bridge

    def waiting_reason(self, bridge_age: float = math.inf) -> str:
        """
        Return why the planner is not active although it is engaged, or ''.

        :param bridge_age: time since the last message of the bridge, s, by a steady clock.
        """
        if not self._require_bridge:
            return ''
        bridge = effective_state(self._bridge, bridge_age)
        return '' if bridge.name == ACTIVE else f'the bridge: {bridge}'

    def take_odometry(self, state: OdometryState, nanoseconds: int) -> None:
        """Take the ego state at a time, ns; only the newest since the last tick counts."""
        if not self._choice.takes(state):
            return
        stamp = self._newest
        if state.stamp < stamp:
            self._ages.clear()  # the clock jumped back, or another source took over
        elif state.stamp > stamp > 0:
            self._ages.append((nanoseconds - stamp) * 1e-9)
        self._newest, self._own, self._frame = state.stamp, state, state.frame

    def take_acceleration(self, state: AccelerationState) -> None:
        """Take the acceleration of a neighbor, before or after the neighbor's state."""
        self._accelerations.append(state)

    def take_neighbor(self, neighbor: OdometryState, received: bool = False) -> None:
        """
        Take a neighbor's state.

        :param received: whether another vehicle reported it; else this vehicle sees it.
        :raises ValueError: if it is not in the frame of the odometry.
        """
        if not self._frame:
            return  # without odometry nothing flies: step() reports that
        if neighbor.frame != self._frame:
            raise ValueError(f'{neighbor.child} is in frame {neighbor.frame!r}: '
                             f'must be in that of odom, {self._frame!r}')
        self._neighbors.append((neighbor, received))

    def take_camera_info(self, info: Any, rpy: ArrayLike, camera: str = '',
                         rectified: bool = False) -> None:
        """
        Take a CameraInfo of a camera, by its name if there are several.

        :param rpy: roll, pitch and yaw of the camera on the body, (3,), rad.
        :param rectified: whether its images are undistorted already.
        :raises ValueError: if that camera cannot keep a neighbor in sight.
        """
        self._fields[camera] = FieldOfView.of_camera(info, rpy, bool(camera), rectified)
        self.view = tuple(self._fields.values())

    def take_frame(self, nanoseconds: int, stamp: int) -> bool:
        """
        Record at a time, ns, that perception has processed the image of a stamp, ns.

        Return whether the stamp is new: the repeated stamp of a frozen camera is not.
        """
        if self._frames and stamp == self._frames[-1]:
            return False
        if self._frames and stamp < self._frames[-1]:
            self._frames.clear()  # the clock jumped back
        self._looked = nanoseconds
        self._frames.append(stamp)
        return True

    def seconds(self, nanoseconds: int) -> float:
        """Return the seconds since the first tick, as small floats, which resolve 1 ns."""
        return (nanoseconds - (self._epoch or 0)) * 1e-9

    def distance(self) -> tuple[str, float] | None:
        """Return name and distance, m, of the faced neighbor, else of the nearest, if any."""
        now, me, faced = self.memory.now, self.memory.own, self.memory.faced
        if now is None or me is None or not self.memory.neighbors:
            return None
        here = propagate(me, now).position
        return min(((n.name, math.dist(propagate(n, now).position, here))
                    for n in self.memory.neighbors.values()),
                   key=lambda known: (known[0] != faced, known[1], known[0]))

    def odometry_fault(self, nanoseconds: int, params: PlannerParams) -> str:
        """Return the fault of the newest odometry of a tick at a time, ns, or ''."""
        return odometry_fault(self.memory.own, self.seconds(nanoseconds), params)

    def tick(self, nanoseconds: int, params: PlannerParams, bridge_age: float = math.inf
             ) -> tuple[Decision, Command | None]:
        """
        Return the decision for a time, ns, and the command to publish, if any.

        :param bridge_age: see :meth:`waiting_reason`.
        """
        if self._epoch is None:
            self._epoch = nanoseconds
        now = self.seconds(nanoseconds)
        if self.memory.now is not None:
            self.missed += max(0, round((now - self.memory.now) / params.period) - 1)
        own = None if self._own is None else OwnState(
            self.seconds(self._own.stamp), self._own.position, self._own.velocity,
            yaw_from_quaternion(self._own.quaternion), tuple(self._ages),
            self._own.frame == RELATIVE)
        neighbors = [Neighbor(
            n.child, self.seconds(n.stamp), n.position, n.velocity, n.pose_covariance[:3, :3],
            n.velocity_covariance, None if received else self._acceleration(n), _yaw(n), received)
            for n, received in self._neighbors]
        if self.memory.now is not None and now < self.memory.now - FUTURE_TOLERANCE:
            self.ground = None  # of another run of the simulation, or recording
        self._own, self._neighbors = None, []
        self._earlier_accelerations, self._accelerations = self._accelerations, []
        if self._looked is not None:
            self._looked = min(self._looked, nanoseconds)  # the clock may have jumped back
        looked = None if self._looked is None else self.seconds(self._looked)
        if self._interrupted:  # even if only for a moment between two ticks
            self.memory, self._interrupted = self.memory.begun_afresh(), False
        waiting = self.waiting_reason(bridge_age) if self.engaged else self._disengaged_by
        self.memory, decision = step(self.memory, Inputs(
            now, self.engaged, own, neighbors, looked, waiting, self.view, self.ground,
            [(stamp - self._epoch) * 1e-9 for stamp in self._frames]), params)
        if any(rejection.reason == 'odometry jumped' for rejection in decision.rejected):
            self.ground = None  # it is of another frame
        if decision.acceleration is None or decision.yaw is None:
            return decision, None
        # The stamp of the estimate on which the command rests, or that of the tick.
        stamp = nanoseconds if decision.stamp is None else min(
            nanoseconds, self._epoch + round(decision.stamp * 1e9))
        return decision, Command(
            decision.acceleration, decision.yaw, decision.yaw_rate, decision.separation_axis,
            self._frame, stamp, nanoseconds - stamp, decision.altitude,
            decision.state is State.RELATIVE, decision.retreat)

    def _acceleration(self, n: OdometryState) -> Array | None:
        """Return the acceleration (3,), m/s^2, of a neighbor, by the message nearest in time."""
        near = [each for each in (*self._earlier_accelerations, *self._accelerations)
                if each.child == n.child and abs(n.stamp - each.stamp) <= ACCELERATION_AGE]
        if not near:
            return n.acceleration
        return with_acceleration(n, min(near, key=lambda each: (
            abs(n.stamp - each.stamp), each.stamp, each.vector.tolist()))).acceleration


def _yaw(n: OdometryState) -> float | None:
    """Return a neighbor's yaw, rad, or None if it is not known."""
    return yaw_from_quaternion(n.quaternion) if (
        0.0 <= n.pose_covariance[5, 5] <= MAX_YAW_STD ** 2) else None  # NaN is not known

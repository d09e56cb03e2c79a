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
Perception, planner and setpoint gate over the messages of a bag, in lock step, without ROS.

Time is the bag's: a message comes when it was recorded, so images and odometry are as late, and
in the same order, as they were in flight. Computing takes no time at all, neither does passing
messages on: an estimate reaches the planner at the moment its image, or the odometry that image
waited for, was recorded; a command reaches the gate at the tick. The planner is engaged from the
start, and requires no bridge whatever ``require_bridge`` says; it ticks every ``period``, and
where images cease; the gate every 1 / ``stream_rate``. Both begin one interval after the first
message. Of what falls on the same nanosecond, ticks come first: an image that has waited in vain,
then the planner, then the gate, then the message.

The autopilot is taken to be heard, armed and in offboard mode; its own velocity and yaw are in no
bag, so those of ``odom`` stand in where ``velocity_source`` asks for them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any, Protocol

from flock_follower.bags.bag import deserialize
from flock_follower.geometry import yaw_from_quaternion
from flock_follower.mavlink import gate
from flock_follower.mavlink.setpoint_gate import SetpointGate
from flock_follower.messages import (
    AccelerationCommand,
    from_odometry,
    from_trajectory,
    Make,
    NANOSECONDS,
    ODOMETRY,
    OdometryState,
    stamp_age,
    stamp_to_nanoseconds,
    STATE,
    TRAJECTORY,
    trajectory,
)
from flock_follower.parameters import mavlink_bridge_table as mavlink_bridge
from flock_follower.parameters import planner_table as planner
from flock_follower.parameters import relative_pose_table as relative_pose
from flock_follower.perception.pending_images import (
    decode_image,
    INVALID_IMAGE,
    JUMPED,
    LAGGING,
    PendingImage,
    Perceiver,
    processed,
)
from flock_follower.perception.tracker import Sighting
from flock_follower.planner.inputs import OwnState
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.step import Decision, State

TABLE = {'relative_pose': relative_pose.SPECS, 'planner': planner.SPECS,
         'mavlink_bridge': mavlink_bridge.SPECS}
#: In a silence of the bag longer than this everything has long come to rest, ns: it is skipped.
LONGEST_SILENCE = 10 * NANOSECONDS
#: Where a message with a header goes on after encapsulation and stamp.
_AFTER_STAMP = 12


@dataclass
class Frame:
    """
    What became of one image: its stamp, ns, what was seen, and the CPU time it took, s.

    ``sighting`` is None where the image was dropped before perception saw it.
    """

    stamp: int
    sighting: Sighting | None = None
    decoding: float = 0.0
    perception: float = 0.0


@dataclass
class Tick:
    """One tick of the planner, at a time in ns, with the own state it acted on."""

    time: int
    decision: Decision
    own: OwnState | None
    cpu: float


@dataclass
class Setpoint:
    """One cycle of the gate, at a time in ns; nothing is sent where the kind is 'none'."""

    time: int
    decision: gate.Setpoint
    cpu: float


class Listener(Protocol):
    """Whom :class:`Lockstep` tells everything, in the order in which it happens."""

    def publish(self, topic: str, msgtype: str, time: int, message: Any) -> None:
        """Take a message that a node would publish, at a time in ns."""

    def odometry(self, state: OdometryState) -> None:
        """Take one's own state."""

    def frame(self, frame: Frame) -> None:
        """Take the outcome of an image."""

    def tick(self, tick: Tick) -> None:
        """Take the outcome of a tick of the planner."""

    def setpoint(self, setpoint: Setpoint) -> None:
        """Take the outcome of a cycle of the gate."""

    def rejected(self, reason: str, detail: str) -> None:
        """Take the reason for which something was dropped."""


class Lockstep:
    """
    The three nodes' logic on one clock, the bag's.

    :param values: the checked values of every parameter, by node, see ``TABLE``.
    :param listener: whom to tell what happens.
    :param make: returns an empty message of a type.
    :param cpu_time: a clock of CPU time, s, read around decoding, perception, planner and gate;
        nothing but the times told depends on it.
    :raises ValueError: where values do not fit together, or the neighbours file is wrong.
    :raises OSError: where the neighbours file cannot be read.
    """

    def __init__(self, values: dict[str, dict[str, Any]], listener: Listener, make: Make,
                 cpu_time: Callable[[], float] = lambda: 0.0) -> None:
        perception, bridge = values['relative_pose'], values['mavlink_bridge']
        self.perceiver = Perceiver(
            relative_pose.build(perception), max_wait=perception['max_wait'],
            rectified=perception['rectified'])
        self.planner_params = planner.build(values['planner'])
        self._loop = PlannerLoop(require_bridge=False)  # there is none in a bag
        self._loop.engage(True)
        self._gate = SetpointGate(mavlink_bridge.build(bridge), bridge['velocity_source'])
        self._gate_source = (
            gate.AUTOPILOT if bridge['velocity_source'] == gate.AUTOPILOT else gate.ODOM)
        self._twist_frames = [values[node]['odom_twist_frame'] for node in TABLE]
        self._listener, self._make, self._cpu_time = listener, make, cpu_time
        self._period = _nanoseconds(self.planner_params.period)
        self._cycle = _nanoseconds(1.0 / bridge['stream_rate'])
        self._longest_blink = _nanoseconds(self.planner_params.perception_timeout)
        self._silence: int | None = None
        self._start: int | None = None
        self._now = self._next_tick = self._next_cycle = 0
        self._camera_info = b''
        self._odom_frame = 'odom'
        self._gate_odometry: OdometryState | None = None
        self._gate_received = 0
        self._state: State | None = None

    def take_odometry(self, time: int, data: bytes) -> None:
        """Take a nav_msgs/Odometry of ``odom``, CDR bytes recorded at a time in ns."""
        self._advance(time)
        try:
            message = deserialize(data, ODOMETRY)
            states = {frame: from_odometry(message, frame) for frame in set(self._twist_frames)}
        except ValueError as error:
            self._listener.rejected('invalid odom', str(error))
            return
        for_perception, for_planner, for_gate = (states[frame] for frame in self._twist_frames)
        self._listener.odometry(for_perception)
        if self.perceiver.take_odometry(for_perception):
            self._listener.rejected(*JUMPED)
        self._loop.take_odometry(for_planner, time)
        self._gate_odometry = for_gate
        self._gate_received = time
        self._odom_frame = for_gate.frame
        self._process_due()

    def take_camera_info(self, time: int, data: bytes) -> None:
        """Take a sensor_msgs/CameraInfo, CDR bytes recorded at a time in ns."""
        self._advance(time)
        calibration = data[_AFTER_STAMP:]
        if calibration == self._camera_info:
            return  # all but the first, usually
        self._camera_info = calibration
        try:
            self.perceiver.take_camera_info(deserialize(data, 'sensor_msgs/msg/CameraInfo'))
        except ValueError as error:
            self._listener.rejected('invalid camera_info', str(error))
        self._process_due()

    def take_image(self, time: int, msgtype: str, data: bytes) -> None:
        """Take a sensor_msgs/Image or CompressedImage, CDR bytes recorded at a time in ns."""
        self._advance(time)
        try:
            image = deserialize(data, msgtype)
        except ValueError as error:
            self._listener.rejected(INVALID_IMAGE, str(error))
            self._listener.frame(Frame(time))
            return
        stamp = stamp_to_nanoseconds(image.header.stamp)
        if dropped := self.perceiver.take_image(image, stamp, self._seconds()):
            self._listener.rejected(LAGGING, '')
            self._listener.frame(Frame(dropped.stamp_ns))
        self._process_due()

    def finish(self) -> None:
        """Process the images that still wait, without odometry: no more will come."""
        while (overdue := self.perceiver.overdue) is not None:
            self._now = max(self._now, self._start_plus(overdue))
            self._process_due()

    def _seconds(self, time: int | None = None) -> float:
        """Return seconds from the first message to a time, or now: near zero, floats are exact."""
        return ((self._now if time is None else time) - (self._start or 0)) * 1e-9

    def _advance(self, time: int) -> None:
        """Let everything happen that is due before a message of a time, ns."""
        if self._start is None:
            self._now = self._start = time
            self._next_tick, self._next_cycle = time + self._period, time + self._cycle
        if time - self._now > LONGEST_SILENCE:
            self._run_until(self._now + LONGEST_SILENCE)
            self._next_tick = _on_grid(self._next_tick, self._period, time)
            self._next_cycle = _on_grid(self._next_cycle, self._cycle, time)
        self._run_until(time)
        self._now = time

    def _run_until(self, time: int) -> None:
        while True:
            overdue = self.perceiver.overdue
            waited = time + 1 if overdue is None else self._start_plus(overdue)
            silence = time + 1 if self._silence is None else self._silence
            next_time = min(waited, silence, self._next_tick, self._next_cycle)
            if next_time > time:
                return
            self._now = max(self._now, next_time)
            if next_time == waited:
                self._process_due()
            elif next_time == silence:
                self._silence = None
                self._tick()
            elif next_time == self._next_tick:
                self._next_tick += self._period
                self._tick()
            else:
                self._next_cycle += self._cycle
                self._send_setpoint()

    def _start_plus(self, seconds: float) -> int:
        # Rounded up: by then the image has waited long enough in seconds, too.
        return (self._start or 0) + math.ceil(seconds * NANOSECONDS) + 1

    def _process_due(self) -> None:
        while (image := self.perceiver.due(self._seconds())) is not None:
            frame = Frame(image.stamp_ns)
            try:
                self._process(image, frame)
            except ValueError as error:
                self._listener.rejected(INVALID_IMAGE, str(error))
            self._listener.frame(frame)

    def _process(self, image: PendingImage, frame: Frame) -> None:
        if (obstacle := self.perceiver.obstacle()) is not None:
            self._listener.rejected(*obstacle)
            return
        start = self._cpu_time()
        pixels = decode_image(image.message)
        decoded = self._cpu_time()
        frame.sighting = self.perceiver.process(image.stamp, pixels)
        frame.decoding, frame.perception = decoded - start, self._cpu_time() - decoded
        for rejection in frame.sighting.rejections:
            self._listener.rejected(*rejection)
        for name, estimate in frame.sighting.estimates.items():
            message = self.perceiver.neighbor(self._make, image.stamp_ns, name, estimate)
            self._listener.publish('neighbors', ODOMETRY, self._now, message)
            try:
                self._loop.take_neighbor(message)
            except ValueError as error:
                self._listener.rejected('invalid neighbors', str(error))
        if processed(frame.sighting) and self._loop.take_frame(self._now, image.stamp_ns):
            self._silence = self._now + self._longest_blink

    def _tick(self) -> None:
        start = self._cpu_time()
        decision, command = self._loop.tick(self._now, self.planner_params)
        cpu = self._cpu_time() - start
        for rejection in decision.rejected:
            self._listener.rejected(*rejection)
        if decision.state is not self._state:
            self._state = decision.state
            message = self._make(STATE)
            message.data = decision.state.value
            self._listener.publish('planner/state', STATE, self._now, message)
        if command is not None:
            message = trajectory(self._make, command)
            self._listener.publish('command/trajectory', TRAJECTORY, self._now, message)
            self._take_command(from_trajectory(message, self._odom_frame))
        self._listener.tick(Tick(self._now, decision, self._loop.memory.own, cpu))

    def _take_command(self, command: AccelerationCommand) -> None:
        age, source_age = command.ages(self._now)
        refused = self._gate.accept_command(
            command.acceleration, command.yaw, age, self._seconds(), source_age=source_age,
            yaw_rate=command.yaw_rate)
        if refused:
            self._listener.rejected(f'command {refused}', f'stamp {age:.3f} s old')

    def _update_gate(self) -> None:
        """Hand the gate the newest odometry since its last cycle: no other counts."""
        state, self._gate_odometry = self._gate_odometry, None
        if state is None:
            return
        received = self._seconds(self._gate_received)
        refused = self._gate.update_velocity(
            self._gate_source, state.velocity, stamp_age(state.stamp, self._gate_received),
            received)
        if refused:
            self._listener.rejected(f'odom {refused}', '')
        else:
            self._gate.update_yaw(
                self._gate_source, yaw_from_quaternion(state.quaternion), received)

    def _send_setpoint(self) -> None:
        start = self._cpu_time()
        self._update_gate()
        decision = self._gate.decide(self._seconds()).setpoint
        cpu = self._cpu_time() - start
        if decision.kind != gate.NONE:
            yaw = math.nan if decision.yaw is None else decision.yaw
            self._listener.publish('setpoint', TRAJECTORY, self._now, trajectory(
                self._make, AccelerationCommand(self._odom_frame, self._now, 0,
                                                decision.acceleration, yaw, decision.yaw_rate)))
        self._listener.setpoint(Setpoint(self._now, decision, cpu))


def _nanoseconds(seconds: float) -> int:
    return round(seconds * NANOSECONDS)


def _on_grid(first: int, step: int, time: int) -> int:
    """Return the first of first, first + step, ... at or after a time."""
    return first + max(0, -((first - time) // step)) * step

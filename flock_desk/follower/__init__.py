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
One follower as one object: events in, each with its time; estimates, commands and setpoints out.

Perception, planner and setpoint control are the same three objects that the nodes drive, each in
a process of its own. Here they share the clock of the caller: the bag's time in ``evaluate``, the
simulated time in ``flights``, which runs no perception. Computation and messages take no time: an
estimate reaches the planner when its image arrives, or, if the image waits for odometry, when this
odometry arrives; a command reaches the control at the tick.

The planner ticks every ``period``, and when images stop; the control sends every 1 /
``stream_rate``. Both start one interval after the first event. Messages of other followers reach
the planner just before its tick, and own messages are sent then. Events of the same nanosecond
happen in this order: an image that waited for odometry too long, the planner's tick, the control's
cycle, the event.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import math
from types import MappingProxyType
from typing import Any, Final

from flock_desk.follower.outcomes import ControlCycle, ImageOutcome, Listener, Tick
from flock_follower.flock.exchange import Sharing
from flock_follower.gate.gate import Gate
from flock_follower.gate.setpoint_rules import NONE
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.gate.velocity_check import AUTOPILOT, MotionReport, ODOM
from flock_follower.geometry import Array
from flock_follower.messages import (
    Make,
    NANOSECONDS,
    OdometryState,
    stamp_age,
    STATE,
    to_nanoseconds,
)
from flock_follower.messages.accelerations import from_acceleration, with_acceleration
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.messages.command_writer import TRAJECTORY, trajectory
from flock_follower.messages.commands import Command
from flock_follower.messages.poses import ACCELERATION, POSE, PoseState, RangeState
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import ODOMETRY
from flock_follower.perception.neighbor_motion import Estimate
from flock_follower.perception.pending_images import JUMPED, ODOMETRY_LAGS, Perceiver
from flock_follower.perception.pose_sources import Sourced
from flock_follower.perception.range_tracking import Ranged
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams

#: After a silence of this, ns, nothing changes any more: the rest of the silence is skipped.
LONGEST_SILENCE = 10 * NANOSECONDS


#: Step by which an image is waited for longer if seconds from the start are too coarse, ns.
_ROUNDING = 100


#: One camera that looks ahead, and whose images are not rectified.
AHEAD: Final = MappingProxyType({'': ((0.0, 0.0, 0.0), False)})


class Follower:
    """
    Perception, planner and setpoint control on one clock; every time is in ns.

    :param planner: collects inputs and takes one step per tick, with ``params``.
    :param control: the setpoint gate.
    :param listener: receives all outcomes.
    :param make: returns an empty message of a type; None if no messages are wanted.
    :param perceiver: None if neighbors come from elsewhere.
    :param stream_rate: of setpoints, Hz.
    :param cycle_phase: time from the planner's tick to the next cycle, s.
    :param cameras: for the planner, of each camera by its name, '' of a single one: roll, pitch
        and yaw on the body, rad, and whether its images are rectified.
    :param sharing: messages to and from other followers; None without them.
    :param autopilot_velocity: whether odometry replaces the autopilot's own estimate, too.
    :param cpu_time: a clock of CPU time, s; only the reported times depend on it.
    """

    def __init__(self, planner: PlannerLoop, params: PlannerParams, control: Gate,
                 listener: Listener, make: Make | None = None, *,
                 perceiver: Perceiver | None = None, stream_rate: float = 20.0,
                 cycle_phase: float = 0.0, autopilot_velocity: bool = False,
                 sharing: Sharing | None = None,
                 cameras: Mapping[str, tuple[Sequence[float], bool]] = AHEAD,
                 cpu_time: Callable[[], float] = lambda: 0.0) -> None:
        self.planner, self.params, self.perceiver = planner, params, perceiver
        self.sharing = sharing
        self._control = control
        self._source = AUTOPILOT if autopilot_velocity else ODOM
        self._cameras = cameras
        self._listener, self._make, self._cpu_time = listener, make, cpu_time
        self._period = to_nanoseconds(params.period)
        self._cycle = to_nanoseconds(1.0 / stream_rate)
        self._phase = to_nanoseconds(cycle_phase)
        self._longest_blink = to_nanoseconds(params.perception_timeout)
        self._silence: int | None = None
        self._start: int | None = None
        self._now = self._next_tick = self._next_cycle = 0
        self._odom_frame = 'odom'
        self._gate_odometry: OdometryState | None = None
        self._gate_received = 0
        self._state: State | None = None
        self._bridge_state = ''
        self._bridge_ended: int | None = None  # when the bridge died, ns, while it is dead

    # Events.

    def engage(self, time: int, requested: bool) -> None:
        """Take a call of ``planner/engage``."""
        self.advance(time)
        self.planner.engage(requested)

    def permit(self, time: int, since: float) -> None:
        """Take a request for offboard; HEARTBEATs after the time ``since``, s, answer it."""
        self.advance(time)
        self._control.permit(self._control.permission.request(since))
        self._announce_bridge_state()

    def vehicle(self, time: int, status: VehicleStatus, airborne: bool = True) -> None:
        """Take the status of the vehicle."""
        self.advance(time)
        self._control.take_status(status, self._seconds(), airborne)
        self._announce_bridge_state()

    def estimate(self, time: int, velocity: Array) -> None:
        """Take the autopilot's own velocity (3,), m/s, ENU."""
        self.advance(time)
        self._control.take_motion(AUTOPILOT, MotionReport(velocity), 0.0, self._seconds())

    def attitude(self, time: int, quaternion: Array, rates: Array) -> OdometryState | None:
        """
        Take the autopilot's attitude, (x, y, z, w), FLU to ENU, and its rates (3,), rad/s, FLU.

        :returns: the motion without odometry, while the vehicle flies on this motion.
        """
        self.advance(time)
        motion = self._control.take_attitude(
            quaternion, rates, self._seconds(), self._seconds())
        if motion is None or self._bridge_ended is not None:
            return None
        motion = motion._replace(stamp=time)
        self._take_motion(time, motion)
        self._process_due()
        return motion

    def height(self, time: int, altitude: float, height: float) -> None:
        """Take an altitude of the autopilot's barometer, m; the first one is at ``height``, m."""
        self.advance(time)
        self._control.take_height(altitude, self._seconds())
        if not self._control.heights.has_reference:
            self._control.heights.refer(height, self._seconds())

    def bridge_died(self, time: int) -> None:
        """Simulate the end of the bridge: no setpoint is sent; the planner keeps its state."""
        self.advance(time)
        self._bridge_ended = self._now

    def bridge_started(self, time: int, control: Gate) -> None:
        """Simulate the start of a new bridge, without the state of the last bridge."""
        self.advance(time)
        self._control, self._bridge_ended = control, None
        self._announce_bridge_state()

    def odometry(self, time: int, state: OdometryState) -> None:
        """Take the ego state."""
        self.advance(time)
        self._listener.odometry(state)
        self._take_motion(time, state)
        if self.sharing is not None:
            self.sharing.take_own(state)
        self._gate_odometry, self._gate_received = state, time
        self._odom_frame = state.frame
        self._process_due()

    def _take_motion(self, time: int, state: OdometryState) -> None:
        if self.perceiver is not None and self.perceiver.take_odometry(state):
            self._listener.reject(*JUMPED)
        self.planner.take_odometry(state, time)

    def camera_info(self, time: int, message: Any, camera: str = '') -> None:
        """
        Take a CameraInfo of a camera, by its name if there are several.

        :raises ValueError: if it is unusable.
        """
        self.advance(time)
        if self.perceiver is not None and self.perceiver.take_camera_info(message, camera):
            rpy, rectified = self._cameras[camera]
            self.planner.take_camera_info(message, rpy, camera, rectified)
        self._process_due()

    def image(self, time: int, message: Any, stamp: int, camera: str = '') -> None:
        """Take an Image or CompressedImage of a stamp, ns."""
        self.advance(time)
        if self.perceiver is not None and (
                dropped := self.perceiver.take_image(message, stamp, self._seconds(), camera)):
            self._listener.reject(ODOMETRY_LAGS, '')
            self._listener.image(ImageOutcome(dropped.stamp_ns, camera=dropped.camera))
        self._process_due()

    def range(self, time: int, measured: RangeState) -> None:
        """Take a range to a neighbor."""
        self.advance(time)
        if self.perceiver is not None:
            if (rejection := self.perceiver.take_range(measured)) is not None:
                self._listener.reject(*rejection)
            self._use_ranges(self.perceiver)

    def pose(self, time: int, name: str, state: PoseState) -> None:
        """Take a neighbor's pose by another detector."""
        self.advance(time)
        if self.perceiver is not None:
            rejection = self.perceiver.take_pose(name, state, self._seconds())
            if rejection is not None:
                self._listener.reject(*rejection)
            self._use_sources(self.perceiver)

    def source_frame(self, time: int, stamp: int) -> None:
        """Take the stamp, ns, of an image that another detector processes."""
        self.advance(time)
        if self.perceiver is not None:
            self.perceiver.take_frame(stamp, self._seconds())
            self._use_sources(self.perceiver)

    def neighbor(self, time: int, state: OdometryState) -> None:
        """Take a neighbor's state."""
        self.advance(time)
        if self.sharing is not None:
            self.sharing.take_seen(state)
        self._take_neighbor(state)

    def _take_neighbor(self, state: OdometryState, received: bool = False) -> None:
        try:
            self.planner.take_neighbor(state, received)
        except ValueError as error:
            self._listener.reject('invalid neighbors', str(error))

    def frame(self, time: int, stamp: int) -> None:
        """Take the stamp of a processed image, ns, whether or not it shows a neighbor."""
        self.advance(time)
        self._see_frame(stamp)

    def receive(self, time: int, state: OdometryState) -> None:
        """Take a message of another vehicle; see ``sharing``."""
        self.advance(time)
        if self.sharing is not None:
            self.sharing.take_message(state, time)

    def advance(self, time: int) -> None:
        """Process all events that are due up to a time, ns."""
        if self._start is None:
            self._now = self._start = time
            self._next_tick = time + self._period
            self._next_cycle = time + (self._phase or self._cycle)
        if time - self._now > LONGEST_SILENCE:
            self._run_until(self._now + LONGEST_SILENCE)
            self._next_tick = _on_grid(self._next_tick, self._period, time)
            self._next_cycle = _on_grid(self._next_cycle, self._cycle, time)
        self._run_until(time)
        self._now = max(self._now, time)

    def finish(self) -> None:
        """Process the waiting images without odometry, because the inputs have ended."""
        while (waited := self._wait_end()) is not None:
            self._now = max(self._now, waited)
            self._process_due()

    # Due work.

    def _seconds(self, time: int | None = None) -> float:
        """Return seconds from the first event to a time, or to now: small floats are exact."""
        return ((self._now if time is None else time) - (self._start or 0)) * 1e-9

    def _wait_end(self) -> int | None:
        """Return the time, ns, at which the oldest image stops waiting for odometry, or None."""
        overdue = None if self.perceiver is None else self.perceiver.overdue
        # Rounded up: by then the image has waited long enough in seconds, too.
        return None if overdue is None else (
            (self._start or 0) + math.ceil(overdue * NANOSECONDS) + 1)

    def _run_until(self, time: int) -> None:
        while True:
            waited, silence = self._wait_end(), self._silence
            next_time = min(self._next_tick, self._next_cycle)
            if waited is not None and waited < next_time:
                next_time = waited
            if silence is not None and silence < next_time:
                next_time = silence
            if next_time > time:
                return
            self._now = max(self._now, next_time)
            if next_time == waited:
                self._process_due()
                if self._wait_end() == next_time:  # seconds are rounded: long after the start
                    self._now += _ROUNDING
            elif next_time == silence:
                self._silence = None
                self._tick()
            elif next_time == self._next_tick:
                self._next_tick += self._period
                self._tick()
            else:
                self._next_cycle += self._cycle
                if self._bridge_ended is None:
                    self._send()

    def _process_due(self) -> None:
        perceiver = self.perceiver
        if perceiver is None:
            return
        while (seen := perceiver.process(self._seconds(), self._cpu_time)) is not None:
            image, sighting = seen.image, seen.sighting
            for rejection in sighting.rejections:
                self._listener.reject(*rejection)
            for name, estimate in (*sighting.estimates.items(), *sighting.duplicates.items()):
                self._publish_neighbor(perceiver, image.stamp_ns, name, estimate)
            if self._make is not None:
                for topic, pose in perceiver.poses(self._make, seen):
                    self._listener.publish(topic, POSE, self._now, pose)
            if seen.usable:
                self._see_frame(image.stamp_ns)
            self._listener.image(ImageOutcome(
                image.stamp_ns, sighting, seen.decoding, seen.perception, image.camera))
        self._use_ranges(perceiver)
        self._use_sources(perceiver)

    def _use_sources(self, perceiver: Perceiver) -> None:
        for outcome in perceiver.sources.due(self._seconds()):
            if isinstance(outcome, int):
                self._see_frame(outcome)
            elif isinstance(outcome, Sourced):
                sighting = outcome.sighting
                for rejection in sighting.rejections:
                    self._listener.reject(*rejection)
                for name, estimate in (*sighting.estimates.items(), *sighting.duplicates.items()):
                    self._publish_neighbor(perceiver, outcome.stamp, name, estimate)
                self._listener.image(ImageOutcome(outcome.stamp, sighting))
            else:
                self._listener.reject(*outcome)

    def _use_ranges(self, perceiver: Perceiver) -> None:
        for outcome in perceiver.tracker.ranging.due():
            if isinstance(outcome, Ranged):
                self._publish_neighbor(perceiver, outcome.stamp, outcome.name, outcome.estimate)
            else:
                self._listener.reject(*outcome)

    def _publish_neighbor(self, perceiver: Perceiver, stamp: int, name: str,
                          estimate: Estimate) -> None:
        assert self._make is not None, 'perception gives messages'
        message, accelerating = perceiver.messages(self._make, stamp, name, estimate)
        self._listener.publish('neighbors', ODOMETRY, self._now, message)
        self._listener.publish('neighbors/acceleration', ACCELERATION, self._now, accelerating)
        self.neighbor(self._now, with_acceleration(
            from_odometry(message), from_acceleration(accelerating)))

    def _see_frame(self, stamp: int) -> None:
        if self.planner.take_frame(self._now, stamp):
            self._silence = self._now + self._longest_blink

    def _tick(self) -> None:
        if self.sharing is not None:
            for state in self.sharing.neighbors(self._now):
                self._take_neighbor(state, received=True)
            if messages := self.sharing.messages(self._now):
                self._listener.send(self._now, messages)
            for event in self.sharing.new_events():
                self._listener.reject(*event)
        start = self._cpu_time()
        bridge_age = (0.0 if self._bridge_ended is None
                      else (self._now - self._bridge_ended) * 1e-9)
        decision, command = self.planner.tick(self._now, self.params, bridge_age)
        cpu = self._cpu_time() - start
        for rejection in decision.rejected:
            self._listener.reject(*rejection)
        if decision.state is not self._state:
            self._state = decision.state
            if self._make is not None:
                message = self._make(STATE)
                message.data = decision.state.value
                self._listener.publish('planner/state', STATE, self._now, message)
        if command is not None:
            if self._make is not None:  # the gate takes the command from the message
                message = trajectory(self._make, command)
                self._listener.publish('command/trajectory', TRAJECTORY, self._now, message)
                command = from_trajectory(message, self._odom_frame)
            if self._bridge_ended is None:
                age, source_age = command.ages(self._now)
                if refused := self._control.take_command(
                        command, age, self._seconds(), source_age):
                    self._listener.reject(f'command {refused}', f'stamp {age:.3f} s old')
        self._listener.tick(Tick(self._now, decision, self.planner.memory.own, cpu))

    def _send(self) -> None:
        start, control = self._cpu_time(), self._control
        state, self._gate_odometry = self._gate_odometry, None
        if state is not None:  # the newest since the last cycle: no other counts
            received = self._seconds(self._gate_received)
            age = stamp_age(state.stamp, self._gate_received)
            if refused := control.take_motion(
                    self._source, MotionReport.from_odometry(state), age, received):
                self._listener.reject(f'odom {refused}', '')
        setpoint, _ = control.decide(self._seconds())
        cpu = self._cpu_time() - start
        if setpoint.kind != NONE and self._make is not None:
            yaw = math.nan if setpoint.yaw is None else setpoint.yaw
            self._listener.publish('setpoint', TRAJECTORY, self._now, trajectory(
                self._make, Command(setpoint.acceleration, yaw, frame=self._odom_frame,
                                    stamp=self._now)))
        self._listener.cycle(ControlCycle(self._now, setpoint, cpu))

    def _announce_bridge_state(self) -> None:
        """Pass a new announcement of the bridge to the planner."""
        text = self._control.permission.announcement()
        if text != self._bridge_state and self._bridge_ended is None:
            self._bridge_state = text
            self.planner.take_bridge_state(text, 0.0)


def _on_grid(first: int, step: int, time: int) -> int:
    """Return the first of first, first + step, ... at or after a time."""
    return first + max(0, -((first - time) // step)) * step

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
The bridge without ROS: what comes in, one cycle of the control loop, and the way out.

``receive`` and ``cycle`` are called from one thread, the rest from any.
"""

from __future__ import annotations

import math
import threading
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.mavlink import px4
from flock_follower.mavlink.commands import Goal, leave_offboard, Request, StatusTexts
from flock_follower.mavlink.gate import (
    AUTOPILOT,
    Command,
    GateLimits,
    ODOM,
    SetpointDecision,
    SetpointGate,
)
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.px4 import VehicleStatus
from flock_follower.mavlink.telemetry import HEARTBEAT_PERIOD, Telemetry

#: Telemetry is asked for again when it has been missing for this long, s.
STREAM_REQUEST_PERIOD: Final[float] = 2.0
#: On the way out, braking ends below this speed, m/s, or after STOP_TIMEOUT, s.
STOPPED_SPEED: Final[float] = 0.1
STOP_TIMEOUT: Final[float] = 1.0


class Cycle(NamedTuple):
    """What one cycle did."""

    decision: SetpointDecision
    sent: bool
    """Whether a setpoint went out."""
    first: Command | None
    """The command, where it went out for the first time."""


class Bridge:
    """
    Turns commands and odometry into a stream of setpoints over a link.

    :param setpoint_mode: a key of ``px4.SETPOINT_MASKS``.
    :param link_timeout: s, see ``Telemetry.alive``.
    """

    def __init__(self, link: Link, gate: SetpointGate, *, now: float,
                 setpoint_mode: str = 'acceleration_yaw', link_timeout: float = 1.0) -> None:
        self.link = link
        self.link_timeout = link_timeout
        self.texts = StatusTexts()
        self.request: Request | None = None
        self._gate = gate
        self._gate_lock = threading.Lock()
        self._setpoint_mode = setpoint_mode
        self._start = now
        self._heartbeat_sent = -math.inf
        self._streams_requested = -math.inf
        self._stream_since = now
        self._last_setpoint = -math.inf
        self._last_number = 0
        self._altitude: float | None = None
        self._stopping_since: float | None = None

    @property
    def telemetry(self) -> Telemetry:
        """Return what the autopilot last said."""
        return self.link.telemetry

    def status(self, now: float) -> VehicleStatus | None:
        """Return the vehicle's status, None while the link is not alive."""
        return self.telemetry.status if self.alive(now) else None

    def alive(self, now: float) -> bool:
        """Return whether the autopilot is heard."""
        return self.telemetry.alive(now, self.link_timeout)

    def engaged(self, now: float) -> bool:
        """Return whether the vehicle, as far as known, flies our setpoints."""
        # A lost link leaves it flying them: take its last word.
        status = self.telemetry.status
        return status is not None and status.armed and status.offboard

    def set_limits(self, limits: GateLimits) -> None:
        """Use other limits from now on."""
        with self._gate_lock:
            self._gate.limits = limits

    def on_command(self, acceleration: ArrayLike, yaw: float, age: float, now: float, *,
                   source_age: float | None = None, yaw_rate: float = 0.0) -> str:
        """Take a command, see ``SetpointGate.accept_command``."""
        with self._gate_lock:
            if self._stopping_since is not None:
                return 'stopping'
            return self._gate.accept_command(acceleration, yaw, age, now, source_age=source_age,
                                             yaw_rate=yaw_rate)

    def on_odometry(self, velocity: ArrayLike, yaw: float, age: float, now: float) -> str:
        """Take velocity (3,), m/s, and yaw, rad, of the odometry, ENU."""
        with self._gate_lock:
            refused = self._gate.update_velocity(ODOM, velocity, age, now)
            if not refused:
                self._gate.update_yaw(ODOM, yaw, now)
            return refused

    def yaw_difference(self, now: float) -> float | None:
        """Return the yaw of the odometry minus the autopilot's, rad, or None."""
        with self._gate_lock:
            return self._gate.yaw_difference(now)

    def misaligned(self, now: float) -> str:
        """Return why the frames do not fit together, or ''."""
        difference = self.yaw_difference(now)
        if difference is None or abs(difference) <= self._gate.limits.yaw_disagreement:
            return ''
        return (f'yaw of odom and of the autopilot differ by {math.degrees(difference):.0f} deg: '
                'their frames are not aligned, commands would go the wrong way')

    def begin(self, goal: Goal, now: float) -> Request:
        """Start asking the autopilot for something; the outcome appears in the request."""
        request = Request(goal, now)
        pending = self.request
        if pending is not None and pending.outcome is None:
            if not goal.ends_flight:
                return request.refuse(f'still waiting for {pending.goal.name}')
            pending.refuse(f'superseded by {goal.name}')
        if goal.needs_stream:
            if reason := self.misaligned(now):
                return request.refuse(reason)
            with self._gate_lock:
                blind = self._gate.speed(now) is None
            if blind and self.alive(now):
                return request.refuse('no velocity known: neither odom nor LOCAL_POSITION_NED')
        self.request = request
        return request

    def receive(self, now: float) -> list[Any]:
        """Take what has arrived and return the autopilot's messages."""
        messages = self.link.receive(now)
        for message in messages:
            kind = message.get_type()
            if kind == 'STATUSTEXT':
                self.texts.add(message, now)
            elif kind == 'COMMAND_ACK' and self.request is not None:
                self.request.acknowledge(message.command, message.result, now)
        position, attitude = self.telemetry.local_position, self.telemetry.attitude
        with self._gate_lock:
            if position is not None and position.time == now:
                self._gate.update_velocity(AUTOPILOT, position.velocity, 0.0, now)
            if attitude is not None and attitude.time == now:
                self._gate.update_yaw(AUTOPILOT, attitude.yaw, now)
        return messages

    def cycle(self, now: float) -> Cycle:
        """Send what is due at ``now``: HEARTBEAT, requests, and a setpoint."""
        if now - self._heartbeat_sent >= HEARTBEAT_PERIOD - 1e-3 and self.link.send_heartbeat():
            self._heartbeat_sent = now
        self._ask_for_streams(now)
        engaged = self.engaged(now)
        with self._gate_lock:
            decision = self._gate.decide(now, link_alive=self.alive(now), engaged=engaged)
        sent = decision.kind != 'none' and self._send(decision, engaged, now)
        self._step_request(now)
        first = None
        if sent and decision.command and decision.command.number != self._last_number:
            first = decision.command
            self._last_number = first.number
        return Cycle(decision, sent, first)

    def stop(self, now: float) -> None:
        """Take no more commands: the following cycles brake."""
        with self._gate_lock:
            self._stopping_since = now
            self._gate.forget_command()

    def stopped(self, now: float) -> bool:
        """Return whether, after ``stop``, there is nothing left to wait for."""
        with self._gate_lock:
            speed = self._gate.speed(now)
        since = self._stopping_since
        return (not self.engaged(now) or speed is None or speed < STOPPED_SPEED
                or (since is not None and now - since >= STOP_TIMEOUT))

    def finish(self, now: float) -> None:
        """
        Send the last words.

        A vehicle still in OFFBOARD is asked to hold its position. The very last message is a level
        setpoint: PX4 obeys it for another second, and a braking one would by then have turned
        into flying backwards.
        """
        if self.engaged(now):
            goal = leave_offboard()
            self.link.send_command(goal.command, goal.params)
        with self._gate_lock:
            decision = self._gate.decide(now, link_alive=self.alive(now), engaged=True)
        self._send(decision._replace(acceleration=np.zeros(3), yaw_rate=0.0), True, now)

    def _send(self, decision: SetpointDecision, engaged: bool, now: float) -> bool:
        position = self.telemetry.local_position
        if not engaged or self._altitude is None:
            # The altitude to keep is the one at which the autopilot began to obey.
            self._altitude = None if position is None else float(position.position[2])
        setpoint = px4.encode_setpoint(
            decision.acceleration, decision.yaw, mode=self._setpoint_mode,
            altitude=self._altitude, yaw_rate=decision.yaw_rate)
        if not self.link.send_setpoint(setpoint, round((now - self._start) * 1e3)):
            return False
        if now - self._last_setpoint > 1.0 / px4.MINIMUM_STREAM_RATE:
            self._stream_since = now
        self._last_setpoint = now
        return True

    def _ask_for_streams(self, now: float) -> None:
        if not self.alive(now) or now - self._streams_requested < STREAM_REQUEST_PERIOD:
            return
        position, attitude = self.telemetry.local_position, self.telemetry.attitude
        if (math.isinf(self._streams_requested) or position is None or attitude is None
                or now - min(position.time, attitude.time) > STREAM_REQUEST_PERIOD):
            self.link.request_streams()
            self._streams_requested = now

    def _step_request(self, now: float) -> None:
        request = self.request
        if request is None or request.outcome is not None:
            return
        streaming_for = (now - self._stream_since
                         if now - self._last_setpoint < 1.0 / px4.MINIMUM_STREAM_RATE else 0.0)
        confirmation = request.step(self.status(now), streaming_for=streaming_for,
                                    texts=self.texts, now=now)
        if confirmation is not None:
            self.link.send_command(request.goal.command, request.goal.params, confirmation)

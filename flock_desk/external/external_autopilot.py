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
The links on which external autopilots report the poses of their vehicles.

An external autopilot flies the follower; a second one, with a link of its own, can fly the leader.
Both vehicles share a frame, ENU from the follower's first reported place, since both truths are
latitude, longitude and height.

A separate thread receives, since messages of ground truth have no time: their time is that of
arrival. The link requests the messages that it needs (MAV_CMD_SET_MESSAGE_INTERVAL), and commands
nothing else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import math
import select
import threading
import time
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.external.external_motion import (
    ATTITUDE,
    CLOCK,
    ESTIMATE,
    ExternalMotion,
    HIL_STATE,
    POSE_GAP,
    SIM_STATE,
)
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.transport import open_transport

POSE_RATE: Final[float] = 50.0
"""Hz, asked for."""
SLOW_RATE: Final[float] = 2.0
"""Hz, of slow values."""
LANDED: Final[str] = 'EXTENDED_SYS_STATE'
ASK_PERIOD: Final[float] = 2.0
"""s between requests of the messages."""
TRUTH_TIMEOUT: Final[float] = 6.0
"""s without ground truth after the first message; then the estimate is used."""
POSE_TIMEOUT: Final[float] = 30.0
"""s for the first pose of a vehicle."""
REPORTED_SILENCE: Final[float] = 0.5
"""s without a pose, after which it is reported."""
LOST: Final[float] = 10.0
"""s without a pose of the follower; then the simulation ends."""
FORWARDED: Final[str] = 'odometry made of it is forwarded: it would feed itself'
TWO_ORIGINS: Final[str] = 'two vehicles are flown elsewhere: each estimate has its own origin'
# The truth of each; an autopilot may complain of messages that it does not know.
_TRUTH_OF: Final[dict[str, str]] = {'px4': HIL_STATE, 'ardupilot': SIM_STATE}
_COMPONENT: Final[int] = mavlink.MAV_COMP_ID_USER1


class ExternalAutopilot:
    """
    Collects the messages of one autopilot, and keeps ``motion`` up to date with them.

    :param url: see ``mavlink.transport``; :param parameter: that gave it, for errors.
    :raises ValueError: if the URL is not one. :raises OSError: if it cannot be opened.
    """

    def __init__(self, url: str, target_system: int = 1,
                 parameter: str = 'truth_connection') -> None:
        self.url, self.parameter = url, parameter
        self.motion = ExternalMotion()
        self._link = Link(open_transport(url), target_system=target_system,
                          source_component=_COMPONENT)
        self._arrived: deque[tuple[Any, int]] = deque(maxlen=10_000)
        self._news = threading.Event()
        self._stopping = False
        self._next_request = 0.0
        self._first_received = 0.0
        self._thread = threading.Thread(target=self._listen, name='truth', daemon=True)
        self._thread.start()

    def receive(self, wait: float) -> None:
        """Take the arrived messages into ``motion``; wait for it for ``wait`` seconds at most."""
        if wait > 0.0 and not self._arrived:
            self._news.wait(wait)
        self._news.clear()
        while self._arrived:
            self.motion.take(*self._arrived.popleft())

    @property
    def known(self) -> float:
        """Return the time, s on the monotonic clock, until which the motion is known."""
        newest = self.motion.newest
        return -math.inf if newest is None else newest * 1e-9

    def await_pose(self, timeout: float, why_truth: str, wanted: Callable[[], bool]) -> None:
        """
        Wait until the motion is known; take the autopilot's estimate if no truth comes.

        :param why_truth: why an estimate is not sufficient; '': it is.
        :param wanted: returns whether to go on waiting.
        :raises ValueError: if nothing comes within ``timeout`` s, or no truth although it must.
        """
        deadline = time.monotonic() + timeout
        while wanted():
            self.receive(0.1)
            now, newest = time.monotonic(), self.motion.newest
            if newest is not None and self.motion.knows(newest):
                return
            received = self._first_received and now - self._first_received
            if received > TRUTH_TIMEOUT and not self.motion.source:
                if why_truth:
                    raise ValueError(f'{self.parameter} = {self.url!r}: {self.silence()}; its own '
                                     f'estimate is not sufficient: {why_truth}')
                self.motion.source = ESTIMATE
            if now > deadline:
                raise ValueError(f'{self.parameter} = {self.url!r}: no pose of a vehicle within '
                                 f'{timeout:g} s: {self.silence()}')

    @property
    def armed(self) -> bool:
        """Return whether it is armed, by its last HEARTBEAT."""
        status = self._link.telemetry.status
        return status is not None and status.armed

    @property
    def flying(self) -> bool:
        """Return whether it has reported that it is in the air."""
        return self._link.telemetry.landed == mavlink.MAV_LANDED_STATE_IN_AIR

    @property
    def mode(self) -> str:
        """Return the mode of its last HEARTBEAT, '' before any."""
        status = self._link.telemetry.status
        return '' if status is None else status.mode

    def silence(self) -> str:
        """Return the reason, as text, why there is no pose."""
        link = self._link
        if link.transport.fault:
            return link.transport.fault
        if link.telemetry.dialect is None:
            return link.silence()
        dialect = link.telemetry.dialect
        missing = f'{ESTIMATE}: it has no position' if self.motion.estimated else (
            _TRUTH_OF.get(dialect.name, 'truth'))
        return f'{dialect.title} is connected, but sends no {missing}'

    def close(self) -> None:
        """End the thread and release the port."""
        self._stopping = True
        self._thread.join(timeout=1.0)
        self._link.transport.close()

    # The thread: the link is its own.

    def _listen(self) -> None:
        while not self._stopping:
            fd = self._link.transport.fileno()
            if fd < 0:
                time.sleep(0.05)
            else:
                select.select([fd], [], [], 0.1)
            now_ns = time.monotonic_ns()
            now = now_ns * 1e-9
            messages = self._link.receive(now)
            self._arrived.extend((message, now_ns) for message in messages)
            if messages:
                self._first_received = self._first_received or now
                self._news.set()
            if now >= self._next_request:
                self._request(now)

    def _request(self, now: float) -> None:
        """Request the messages that place the vehicle; a link that was lost is requested again."""
        dialect = self._link.telemetry.dialect
        if dialect is None:
            return
        self._next_request = now + ASK_PERIOD
        rates = {CLOCK: SLOW_RATE, LANDED: SLOW_RATE}
        if self.motion.estimated:
            rates |= {ESTIMATE: POSE_RATE, ATTITUDE: POSE_RATE}
        elif dialect.name in _TRUTH_OF:
            rates[_TRUTH_OF[dialect.name]] = POSE_RATE
        for name, rate in rates.items():
            self._link.send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                                    (getattr(mavlink, f'MAVLINK_MSG_ID_{name}'), 1e6 / rate))


class ExternalVehicles:
    """
    The links of a flight; both motions count from the follower's first reported place.

    :param follower: to its autopilot.
    :param leader: link of the leader; None: the scenario's own leader.
    """

    def __init__(self, follower: ExternalAutopilot, leader: ExternalAutopilot | None) -> None:
        self.follower, self.leader = follower, leader
        self.start_ns = 0
        """Time zero of the flight on the monotonic clock, ns: that of the newest pose."""
        self._links = [('vehicle', follower)] + ([] if leader is None else [('leader', leader)])

    def find(self, forwarded: bool, wanted: Callable[[], bool]) -> None:
        """
        Wait until the positions of the vehicles are known.

        :param forwarded: whether the follower receives odometry that is made from its own pose.
        :param wanted: returns whether to go on waiting.
        :raises ValueError: if a vehicle sends no pose, or no truth although it has to.
        """
        why_truth = TWO_ORIGINS if self.leader else FORWARDED if forwarded else ''
        self.follower.await_pose(POSE_TIMEOUT, why_truth, wanted)
        if self.leader is not None:
            self.leader.motion.origin = self.follower.motion.origin
            self.leader.await_pose(POSE_TIMEOUT, why_truth, wanted)
        self.receive(0.0)
        self.start_ns = self.follower.motion.newest or time.monotonic_ns()

    def receive(self, wait: float) -> None:
        """Take the arrived messages; wait for the follower for ``wait`` seconds at most."""
        for _, link in self._links:
            link.receive(wait)
            wait = 0.0

    def known(self, now: float) -> float:
        """Return until when, s on the monotonic clock, the follower's motion is known."""
        return self.follower.known

    def step(self, now: float) -> None:
        """Do nothing: they fly by themselves."""

    def close(self) -> None:
        """Release the ports."""
        for _, link in self._links:
            link.close()

    @property
    def sources(self) -> dict[str, str]:
        """Return the messages that place the ``vehicle``, and the ``leader`` if it is here."""
        return {name: link.motion.source for name, link in self._links}

    def gone(self, now: float) -> str:
        """Return a text if the follower's messages have ended for good; '' while they arrive."""
        return '' if now - self.known(now) <= LOST else (
            f'no pose of the vehicle for {LOST:g} s on {self.follower.url}: '
            f'{self.follower.silence()}')

    def stalled(self, now: float, time_ns: int) -> str:
        """Return a text that names the poses missing at a time of the flight; '' for none."""
        problems = []
        for name, link in self._links:
            # Whether the leader's poses reach up to now is known a little later.
            at = self.start_ns + time_ns - (POSE_GAP if name == 'leader' else 0)
            lacking = 'no image' if name == 'leader' else 'no image, no odometry'
            age = now - link.known
            if age > REPORTED_SILENCE:
                problems.append(
                    f'no pose of the {name} for {age:.1f} s: {lacking}: {link.silence()}')
            elif time_ns > 2 * POSE_GAP and not link.motion.knows(at):  # one pose at first
                problems.append(f'poses of the {name} come too far apart: {lacking} between them')
        return '; '.join(problems)

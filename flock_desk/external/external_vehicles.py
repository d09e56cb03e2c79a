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
The vehicles that external autopilots fly in one flight: the follower, perhaps its leader.

Each has its own link. Both vehicles share a frame, ENU from the follower's first reported place,
since both truths are latitude, longitude and height.
"""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Final

from flock_desk.external.external_autopilot import ExternalAutopilot
from flock_desk.external.external_motion import LONGEST_GAP

POSE_TIMEOUT: Final[float] = 30.0
"""s for the first pose of a vehicle."""
LATE: Final[float] = 0.5
"""s without a pose, after which it is reported."""
LOST: Final[float] = 10.0
"""s without a pose of the follower after which there is nothing to simulate."""
PACE_WINDOW: Final[float] = 5.0
"""s over which the time of an autopilot is compared with ours."""
SLOW: Final[float] = 0.95
"""Least pace relative to the own clock: a slower simulator is less agile than its model."""
FORWARDED: Final[str] = 'odometry made of it is forwarded: it would feed itself'
TWO_ORIGINS: Final[str] = 'two vehicles are flown elsewhere: each estimate has its own origin'


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
        Wait until it is known where the vehicles are.

        :param forwarded: whether the follower is sent odometry made of where it is.
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
        """Take what has arrived; wait for the follower for ``wait`` seconds at most."""
        for _, link in self._links:
            link.receive(wait)
            wait = 0.0

    def known(self, now: float) -> float:
        """Return until when, s on the monotonic clock, the follower's motion is known."""
        return self.follower.known(now)

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
        """Return, for people, that the follower is gone for good; '' while it is there."""
        return '' if now - self.known(now) <= LOST else (
            f'no pose of the vehicle for {LOST:g} s on {self.follower.url}: '
            f'{self.follower.silence()}')

    def stalled(self, now: float, time_ns: int) -> str:
        """Return, for people, which poses are missing at a time of the flight; '' for none."""
        problems = []
        for name, link in self._links:
            # Whether the leader's poses reach up to now is known a little later.
            at = self.start_ns + time_ns - (LONGEST_GAP if name == 'leader' else 0)
            lacking = 'no image' if name == 'leader' else 'no image, no odometry'
            age = now - link.known(now)
            if age > LATE:
                problems.append(
                    f'no pose of the {name} for {age:.1f} s: {lacking}: {link.silence()}')
            elif time_ns > 2 * LONGEST_GAP and not link.motion.knows(at):  # one pose at first
                problems.append(f'poses of the {name} come too far apart: {lacking} between them')
        return '; '.join(problems)

    def slow(self, now: float) -> str:
        """Return, for people, whose simulator is too slow; '' if none is."""
        paces = ((name, link.motion.pace(now - PACE_WINDOW)) for name, link in self._links)
        return '; '.join(
            f'the time of the autopilot of the {name} goes at {pace:.2f} of ours: its simulator '
            'is too slow, or this machine too busy' for name, pace in paces if pace < SLOW)

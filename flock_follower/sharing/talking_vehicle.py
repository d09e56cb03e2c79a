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
What one vehicle keeps of another that talks: where it says that it, and those it sees, are.

A vehicle whose own odometry leaps has begun a new frame: what it told before is worth nothing.
One that leaps again and again is lost, or there are two of one name; these also talk too often.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
import math
from typing import NamedTuple

from flock_follower.geometry import wrap_angle, yaw_from_quaternion
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.sharing.told_tracks import ToldTrack
from flock_follower.sharing.word_checks import WordAges

#: An odometry that is further from where it led, m or rad, has leapt ...
LEAP, TURN = 0.25, 0.4
#: ... and by what it may do in between: m/s^2, rad/s. After LONGEST, s, nothing can be told.
PUSH, SPIN, LONGEST = 3.0, 2.0, 3.0
#: So many leaps in this time, ns, are too many; for as long it is not listened to.
LEAPS, BAN = 3, 5 * NANOSECONDS
#: So many words of oneself within this time, ns, come from two: one tells at 10 Hz.
OFTEN, TOO_SHORT = 20, 1_400_000_000
#: Refused in a row: from DOUBTED on nothing is taken from it, from WRONG on its frame is sought
#: anew.
DOUBTED, WRONG = 2, 5


def leapt(before: OdometryState, now: OdometryState) -> str:
    """Return by how much an odometry leapt between two of its states, in words, or ''."""
    elapsed = (now.stamp - before.stamp) / NANOSECONDS
    if not 0.0 <= elapsed <= LONGEST:
        return ''
    expected = before.position + 0.5 * elapsed * (before.velocity + now.velocity)
    off = math.dist(expected, now.position)
    turn = abs(wrap_angle(yaw_from_quaternion(now.quaternion)
                          - yaw_from_quaternion(before.quaternion)))
    if off > LEAP + 0.5 * PUSH * elapsed ** 2:
        return f'by {off:.2f} m'
    return f'by {turn:.2f} rad' if turn > TURN + SPIN * elapsed else ''


class TellerStatus(NamedTuple):
    """
    How it stands with one teller.

    ``why`` says why its words are not used, '' where they are. ``position_std``, m, and
    ``yaw_std``, rad, are of its frame; ``silent`` s since its last word; ``slow`` is what its
    words' ages give away.
    """

    name: str
    why: str
    position_std: float
    yaw_std: float
    silent: float
    slow: str


@dataclass
class TalkingVehicle:
    """One vehicle that talks: tracks and newest states by the name of whom it tells."""

    name: str
    tracks: dict[str, ToldTrack] = field(default_factory=dict)
    states: dict[str, OdometryState] = field(default_factory=dict)
    ages: WordAges = field(default_factory=WordAges)
    doubted: set[str] = field(default_factory=set)
    """Whose newest states do not fit what was known: of the next it is seen who is right."""
    heard: int = 0
    """When it was heard last, ns."""
    refused: int = 0
    """Of what its frame was related by, in a row."""
    _leaps: deque[int] = field(default_factory=lambda: deque(maxlen=LEAPS))
    _spoken: deque[int] = field(default_factory=lambda: deque(maxlen=OFTEN))
    _ban: tuple[int, str] = (0, '')

    def forget(self) -> None:
        """Forget all that was told in a frame that is no more."""
        self.tracks.clear()
        self.states.clear()
        self.doubted.clear()
        self.refused = 0

    def leapt_at(self, received: int) -> None:
        """Note that its odometry leapt."""
        self._leaps.append(received)
        if len(self._leaps) == LEAPS and received - self._leaps[0] <= BAN:
            self.ban(received, f'leapt {LEAPS} times in {BAN // NANOSECONDS} s')
            self._leaps.clear()

    def spoke_at(self, stamp: int, received: int) -> None:
        """Note the stamp of a word of itself."""
        self._spoken.append(stamp)
        if len(self._spoken) == OFTEN and stamp - self._spoken[0] < TOO_SHORT:
            rate = (OFTEN - 1) * NANOSECONDS / max(stamp - self._spoken[0], 1)
            self.ban(received, f'talks at {rate:.0f} Hz, one does at 10 Hz')
            self._spoken.clear()

    def ban(self, received: int, why: str) -> None:
        """Do not listen to it for a while."""
        self._ban = received + BAN, why

    def banned(self, now: int) -> str:
        """Return why it is not listened to for a while, or ''."""
        until, why = self._ban
        return why if now < until else ''

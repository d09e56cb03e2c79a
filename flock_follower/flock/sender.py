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

"""A vehicle that sends messages: its messages, and the relation of its frame to the own one."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field
import math

from flock_follower.flock.alignment import Frame, MOST, Pair
from flock_follower.flock.peers import Track
from flock_follower.messages import NANOSECONDS, OdometryState, POSITION_STD_MAX

YAW_STD_MAX = 0.1  # rad: a frame with a larger standard deviation of the yaw is not used
#: Relations refused in a row: from DOUBTED on the sender is not used, from WRONG on its frame is
#: aligned anew.
DOUBTED, WRONG = 2, 5
#: A sender whose stamps are wrong is ignored for this time, ns.
BAN = 5 * NANOSECONDS
#: This many own states within this time, ns, come from two senders: one sends at 10 Hz.
OFTEN, TOO_SHORT = 20, 1_400_000_000
#: Messages whose ages are kept, and the least age, s, that is reported.
AGES, SLOW = 50, 0.25


@dataclass
class Sender:
    """One vehicle that sends messages, and the newest states that it sent, by vehicle."""

    name: str
    states: dict[str, OdometryState] = field(default_factory=dict)
    tracks: defaultdict[str, Track] = field(default_factory=lambda: defaultdict(Track))
    """Tracks of vehicles in its frame."""
    frame: Frame | None = None
    """Estimate of its frame; None while it is not known."""
    hops: float = math.inf
    """1 if its frame is related to the own one directly, 2 by one other sender, ..."""
    pairs: deque[Pair] = field(default_factory=lambda: deque(maxlen=MOST))
    """Relations until the first fit."""
    yaw_std: float = math.pi
    """Standard deviation of the yaw of its frame, rad, at the last fit."""
    related: dict[str, int] = field(default_factory=dict)
    """Stamps of the last relations, ns, by vehicle."""
    refused: int = 0
    """Relations refused in a row."""
    received: int = 0
    """When its last message was received, ns."""
    ages: deque[float] = field(default_factory=lambda: deque(maxlen=AGES))
    """Ages of its last messages on reception, s."""
    sent: deque[int] = field(default_factory=lambda: deque(maxlen=OFTEN))
    """Stamps of the last states of itself, ns."""
    ban: tuple[int, str] = (0, '')
    """Until when, ns, and why it is ignored."""

    def sent_at(self, stamp: int, received: int) -> None:
        """Note the stamp of a state of itself; a sender that sends too often is ignored."""
        self.sent.append(stamp)
        if len(self.sent) == OFTEN and stamp - self.sent[0] < TOO_SHORT:
            self.ban = received + BAN, f'sends {OFTEN} times in {TOO_SHORT / 1e9:g} s'
            self.sent.clear()

    @property
    def vague(self) -> bool:
        """Return whether its frame is unknown or too uncertain."""
        if self.frame is None:
            return True
        place, yaw = self.frame.stds
        return not (place <= POSITION_STD_MAX and yaw <= YAW_STD_MAX)  # NaN is vague

    def unusable(self, now: int) -> str:
        """Return why its messages are not used at a time, ns, or ''."""
        if now < self.ban[0]:
            return self.ban[1]
        if self.frame is None:
            return ('neither sees the other, nor do both see one vehicle' if not self.pairs else
                    f'its yaw is known to {self.yaw_std:.1f} rad: a vehicle must move')
        if self.refused >= DOUBTED:
            return f'{self.refused} times in a row it did not fit'
        return 'its frame is known to {:.2f} m and {:.2f} rad, limits {:g} m and {:g} rad'.format(
            *self.frame.stds, POSITION_STD_MAX, YAW_STD_MAX) if self.vague else ''

    @property
    def slow(self) -> str:
        """Return a warning if all of its last messages were old on reception, or ''."""
        least = min(self.ages, default=0.0)
        return '' if least < SLOW else (
            f'messages are {least:.2f} s old or more: a slow way, or its clock is behind')

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

"""A vehicle that sends messages: its states, and the relation of its frame to the ego frame."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field
import math

from flock_follower.flock.alignment import Frame, MAX_PAIRS, Pair
from flock_follower.flock.peers import Track
from flock_follower.messages import NANOSECONDS, OdometryState, POSITION_STD_MAX

YAW_STD_MAX = 0.1  # rad: a frame with a larger standard deviation of the yaw is not used
DOUBT_REFUSALS = 2  # relations refused in a row after which the sender is not used
REALIGN_REFUSALS = 5  # relations refused in a row after which its frame is aligned anew
BAN_TIME = 5 * NANOSECONDS  # ns for which a sender whose stamps are wrong is ignored
# One sender sends at 10 Hz: more own states in a time come from two senders.
BURST_COUNT = 20  # own states of two senders
BURST_TIME = 1_400_000_000  # ns in which two senders send so many
N_AGES = 50  # messages whose ages are kept
SLOW_LINK = 0.25  # s: the least age that is reported


@dataclass
class Sender:
    """One vehicle that sends messages, and the newest states that it sent, by vehicle."""

    name: str
    states: dict[str, OdometryState] = field(default_factory=dict)
    tracks: defaultdict[str, Track] = field(default_factory=lambda: defaultdict(Track))
    """Tracks of vehicles in the sender's frame."""
    frame: Frame | None = None
    """Estimate of the sender's frame; None while it is unknown."""
    hops: float = math.inf
    """1 if its frame is related to the ego frame directly, 2 by one other sender, ..."""
    pairs: deque[Pair] = field(default_factory=lambda: deque(maxlen=MAX_PAIRS))
    """Positions known in both frames, kept until the first fit."""
    yaw_std: float = math.pi
    """Standard deviation of the yaw of the sender's frame, rad, at the last fit."""
    related: dict[str, int] = field(default_factory=dict)
    """Stamps of the last relations, ns, by vehicle."""
    refused: int = 0
    """Number of successive relations that were refused."""
    received: int = 0
    """Time at which the sender's last message was received, ns."""
    ages: deque[float] = field(default_factory=lambda: deque(maxlen=N_AGES))
    """Ages of the sender's last messages at their reception, s."""
    sent: deque[int] = field(default_factory=lambda: deque(maxlen=BURST_COUNT))
    """Stamps of the sender's last own states, ns."""
    ban: tuple[int, str] = (0, '')
    """The time until which the sender is ignored, ns, and the reason."""

    def sent_at(self, stamp: int, received: int) -> None:
        """Record the stamp of the sender's own state; ignore a sender that sends too often."""
        self.sent.append(stamp)
        if len(self.sent) == BURST_COUNT and stamp - self.sent[0] < BURST_TIME:
            self.ban = received + BAN_TIME, f'sends {BURST_COUNT} times in {BURST_TIME / 1e9:g} s'
            self.sent.clear()

    @property
    def vague(self) -> bool:
        """Return whether the sender's frame is unknown or too uncertain."""
        if self.frame is None:
            return True
        place, yaw = self.frame.stds
        return not (place <= POSITION_STD_MAX and yaw <= YAW_STD_MAX)  # NaN is vague

    def unusable_reason(self, now: int) -> str:
        """Return why the sender's messages are not used at a time, ns, or ''."""
        if now < self.ban[0]:
            return self.ban[1]
        if self.frame is None:
            return ('neither sees the other, nor do both see one vehicle' if not self.pairs else
                    f'its yaw is known to {self.yaw_std:.1f} rad: a vehicle must move')
        if self.refused >= DOUBT_REFUSALS:
            return f'{self.refused} times in a row it did not fit'
        return 'its frame is known to {:.2f} m and {:.2f} rad, limits {:g} m and {:g} rad'.format(
            *self.frame.stds, POSITION_STD_MAX, YAW_STD_MAX) if self.vague else ''

    @property
    def slow(self) -> str:
        """Return a warning if all recent messages of the sender were old on arrival, or ''."""
        least = min(self.ages, default=0.0)
        return '' if least < SLOW_LINK else (
            f'messages are {least:.2f} s old or more: a slow way, or its clock is behind')

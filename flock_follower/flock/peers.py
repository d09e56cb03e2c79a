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
What followers take for granted of each other's words: limits, drifts, noises.

Where one vehicle was in one frame of odometry, remembered for a moment and interpolated.

What is wrong with a word as such: before anything is believed of it.

What can be known of clocks one-way: a word that comes before its stamp is from a clock ahead by at
least as much, whatever the way took. A clock that is behind looks like a slow way: the least age
of many words is the most by which it can be behind, and no more can be told without an answer.

What one vehicle keeps of another that talks: where it says that it, and those it sees, are.

A vehicle whose own odometry leaps has begun a new frame: what it told before is worth nothing.
One that leaps again and again is lost, or there are two of one name; these also talk too often.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
import math
import re
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, wrap_angle, yaw_from_quaternion
from flock_follower.messages import NANOSECONDS, OdometryState

#: A vehicle's name: it goes into frame ids, and comes from a namespace.
NAME = re.compile(r'[A-Za-z0-9_.-]{1,64}')


POSITION_STD_MAX = 0.5  # m: a frame or a position known worse is not used; as in the planner
YAW_STD_MAX = 0.1  # rad: likewise the yaw of a frame
WORD_AGE_MAX = 1.0  # s up to which a received state is accepted and given out
CLOCK_TOLERANCE = 0.02  # s by which a message may be ahead of the own clock
SEEN_TIMEOUT = 0.5  # s after an own sighting in which received states of that vehicle are not used
POSITION_DRIFT = 0.025  # m/sqrt(s): random walk of the odometry of each vehicle
YAW_DRIFT = 0.0025  # rad/sqrt(s): likewise of its yaw
ODOMETRY_NOISE = 0.02  # m: noise of a position from odometry
SIGHTING_NOISE = 0.02  # m: slowly varying error of a sighting beyond its covariance
ATTITUDE_NOISE = 0.06  # rad: likewise of the yaw of a vehicle seen, as markers are mounted askew
ACCELERATION_STD = 0.5  # m/s^2: unknown acceleration of a received vehicle since its stamp
TELLERS_MAX = 32  # senders at most


def checked_name(name: str) -> str:
    """
    Return a vehicle's name.

    :raises ValueError: if it cannot be the name of a vehicle.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f'vehicle_name = {name!r}: must be 1 to 64 letters, digits, _ . '
                         'or -, unique in the flock; by default it is the namespace')
    return name


HORIZON = 3 * NANOSECONDS
#: Moments further apart than this, ns, are not interpolated: at 10 Hz three words may be lost.
LONGEST_GAP = 450_000_000
#: How far, ns, the newest is carried on.
REACH = 50_000_000
#: Moments nearer to each other than this, ns, are not needed.
SPACING = 18_000_000


class Moment(NamedTuple):
    """
    Where a vehicle was, in some frame.

    ``stamp`` ns; ``position`` (3,), m, with ``covariance`` (3, 3); ``velocity`` (3,), m/s;
    ``yaw``, rad, with its variance, infinite where the yaw is not known.
    """

    stamp: int
    position: Array
    velocity: Array
    covariance: Array
    yaw: float
    yaw_variance: float

    def carried(self, stamp: int) -> Moment:
        """Return where it is at another stamp, ns, if it goes on as it did."""
        ahead = (stamp - self.stamp) / NANOSECONDS
        return self._replace(stamp=stamp, position=self.position + ahead * self.velocity)


def moment(state: OdometryState, covariance: Array, yaw_variance: float) -> Moment:
    """Return the moment of a state, with another covariance (3, 3), and variance of the yaw."""
    return Moment(state.stamp, state.position, state.velocity, covariance,
                  yaw_from_quaternion(state.quaternion), yaw_variance)


class ToldTrack:
    """The moments of one vehicle in one frame, of the last ``HORIZON``."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._moments: list[Moment] = []

    def add(self, moment: Moment) -> None:
        """Remember a moment, the newest; one that comes too soon after another takes its place."""
        if self._stamps and moment.stamp <= self._stamps[-1]:
            self._stamps.clear()  # time has jumped back: whoever hands it in has seen to that
            self._moments.clear()
        if len(self._stamps) > 1 and moment.stamp - self._stamps[-2] < SPACING:
            self._stamps[-1], self._moments[-1] = moment.stamp, moment
            return
        self._stamps.append(moment.stamp)
        self._moments.append(moment)
        if self._stamps[0] < moment.stamp - HORIZON:
            first = bisect_left(self._stamps, moment.stamp - HORIZON // 2)
            del self._stamps[:first], self._moments[:first]

    def at(self, stamp: int) -> Moment | None:
        """Return where the vehicle was at a stamp, ns, or None where that is not known."""
        k = bisect_left(self._stamps, stamp)
        if k == len(self._stamps):
            near = bool(k) and stamp - self._stamps[-1] <= REACH
            return self._moments[-1].carried(stamp) if near else None
        after = self._moments[k]
        if after.stamp == stamp:
            return after
        if k == 0 or after.stamp - self._stamps[k - 1] > LONGEST_GAP:
            return None
        return _between(self._moments[k - 1], after, stamp)


def _between(before: Moment, after: Moment, stamp: int) -> Moment:
    """Return the moment between two: a cubic through both positions, with both velocities."""
    gap = (after.stamp - before.stamp) / NANOSECONDS
    f = (stamp - before.stamp) / (after.stamp - before.stamp)
    rest = 1.0 - f
    position = (rest * rest * (1.0 + 2.0 * f) * before.position
                + f * f * (3.0 - 2.0 * f) * after.position
                + gap * f * rest * (rest * before.velocity - f * after.velocity))
    return Moment(
        stamp, position, rest * before.velocity + f * after.velocity,
        rest * before.covariance + f * after.covariance,
        before.yaw + f * wrap_angle(after.yaw - before.yaw),
        max(before.yaw_variance, after.yaw_variance))


#: The frame of NAME is NAME/odom.
FRAME = '/odom'
FARTHEST = 1e5  # m from the origin of its odometry
FASTEST = 50.0  # m/s, as the planner has it
#: Variances of a position, m^2, or a velocity, (m/s)^2, beyond this say nothing.
VAGUE = 25.0
#: Words whose ages are kept, and the age of the youngest from which on it is told, s.
AGES, SLOW = 50, 0.25
Refusal = tuple[str, str]
#: The reason for which a teller is not listened to for a while: all its stamps are wrong.
FUTURE = 'word from the future'


def teller_of(frame: str) -> str:
    """Return whose frame it is, '' where it is nobody's own."""
    name = frame.removesuffix(FRAME)
    return name if name != frame and NAME.fullmatch(name) else ''


def malformed(state: OdometryState) -> Refusal | None:
    """Return what is wrong with a state, whoever tells it, or None."""
    position, velocity, quaternion = state.position, state.velocity, state.quaternion
    if not (np.shape(position) == np.shape(velocity) == (3,) and np.shape(quaternion) == (4,)
            and np.shape(state.pose_covariance) == np.shape(state.twist_covariance) == (6, 6)):
        return 'malformed', f'{state.child}: not 3 coordinates, or no quaternion'
    if not (np.all(np.abs(position) <= FARTHEST) and np.all(np.isfinite(state.angular_velocity))):
        return 'not finite, or too far', f'{state.child}: position {_shown(position)}'
    if not math.hypot(*velocity.tolist()) <= FASTEST:
        return 'not finite, or too fast', f'{state.child}: velocity {_shown(velocity)}'
    if not 0.9 < float(quaternion @ quaternion) < 1.1:
        return 'without an attitude', f'{state.child}: quaternion {_shown(quaternion)}'
    return None


def is_covariance(matrix: Array) -> bool:
    """Return whether a matrix (3, 3) can be a covariance that says something."""
    (a, d, e), (d2, b, f), (e2, f2, c) = matrix.tolist()
    # NaN, zeros and -1 are not known; written so that NaN fails.
    if not (0.0 < a <= VAGUE and 0.0 < b <= VAGUE and 0.0 < c <= VAGUE):
        return False
    slack = 1e-6 * max(a, b, c)
    if not (abs(d - d2) <= slack and abs(e - e2) <= slack and abs(f - f2) <= slack):
        return False
    # No principal minor is negative.
    return (a * b - d * d >= -slack * slack and a * c - e * e >= -slack * slack
            and b * c - f * f >= -slack * slack
            and a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
            >= -slack * slack * slack)


def untold(state: OdometryState, received: int) -> Refusal | None:
    """Return why a word of another's frame, received at a time, ns, is not heeded, or None."""
    teller, age = teller_of(state.frame), (received - state.stamp) / NANOSECONDS
    if not NAME.fullmatch(state.child):
        return 'word of a vehicle without a name', f'{teller}: child_frame_id {state.child[:70]!r}'
    if problem := malformed(state):
        return f'word {problem[0]}', f'{teller}: {problem[1]}'
    if age < -CLOCK_TOLERANCE:
        return FUTURE, (
            f'{teller}: by {-age:.3f} s: its clock is ahead by that at least')
    if age > WORD_AGE_MAX:
        return 'word too old', (f'{teller}: {age:.2f} s: its clock is behind, or the way is slow')
    known = state.child == teller or is_covariance(state.pose_covariance[:3, :3])
    return None if known else ('word without a covariance', f'{teller} tells of {state.child}')


def _shown(numbers: Array) -> str:
    return str([round(float(number), 3) for number in numbers])


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
    ages: deque[float] = field(default_factory=lambda: deque(maxlen=AGES))
    """Of its last messages on reception, s."""
    doubted: set[str] = field(default_factory=set)
    """Whose newest states do not fit what was known: of the next it is seen who is right."""
    heard: int = 0
    """When it was heard last, ns."""
    refused: int = 0
    """Of what its frame was related by, in a row."""
    _leaps: deque[int] = field(default_factory=lambda: deque(maxlen=LEAPS))
    _spoken: deque[int] = field(default_factory=lambda: deque(maxlen=OFTEN))
    _ban: tuple[int, str] = (0, '')

    @property
    def slow(self) -> str:
        """Return a warning if all of its last messages were old on reception, or ''."""
        least = min(self.ages, default=0.0)
        return '' if least < SLOW else (
            f'words are {least:.2f} s old or more: a slow way, or its clock is behind')

    def forget(self) -> None:
        """Forget the states received in a frame that no longer exists."""
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

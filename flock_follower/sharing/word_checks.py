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
What is wrong with a word as such: before anything is believed of it.

What can be known of clocks one-way: a word that comes before its stamp is from a clock ahead by at
least as much, whatever the way took. A clock that is behind looks like a slow way: the least age
of many words is the most by which it can be behind, and no more can be told without an answer.
"""

from __future__ import annotations

from collections import deque
import math

import numpy as np

from flock_follower.geometry import Array
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.sharing.sharing_params import NAME, SharingParams

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


def untold(state: OdometryState, params: SharingParams, received: int) -> Refusal | None:
    """Return why a word of another's frame, received at a time, ns, is not heeded, or None."""
    teller, age = teller_of(state.frame), (received - state.stamp) / NANOSECONDS
    if not NAME.fullmatch(state.child):
        return 'word of a vehicle without a name', f'{teller}: child_frame_id {state.child[:70]!r}'
    if problem := malformed(state):
        return f'word {problem[0]}', f'{teller}: {problem[1]}'
    if age < -params.clock_tolerance:
        return FUTURE, (
            f'{teller}: by {-age:.3f} s: its clock is ahead by that at least')
    if age > params.word_age_max:
        return 'word too old', (f'{teller}: {age:.2f} s: its clock is behind, or the way is slow')
    known = state.child == teller or is_covariance(state.pose_covariance[:3, :3])
    return None if known else ('word without a covariance', f'{teller} tells of {state.child}')


def _shown(numbers: Array) -> str:
    return str([round(float(number), 3) for number in numbers])


class WordAges:
    """How old the words of one teller are when they come."""

    def __init__(self) -> None:
        self._ages: deque[float] = deque(maxlen=AGES)

    def add(self, age: float) -> None:
        """Take the age of a word, s."""
        self._ages.append(age)

    @property
    def least(self) -> float:
        """Return the least of late, s; 0 before the first."""
        return min(self._ages, default=0.0)

    @property
    def slow(self) -> str:
        """Return what is to be said where all are old, or ''."""
        return '' if self.least < SLOW else (
            f'words are {self.least:.2f} s old or more: a slow way, or its clock is behind')

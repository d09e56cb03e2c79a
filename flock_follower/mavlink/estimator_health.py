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
Whether the autopilot's velocity may be used, and whether its messages arrive often enough.

An estimator that has lost its last source integrates gyros and accelerometers, and still reports a
velocity for seconds. Braking with this wrong velocity accelerates the vehicle: on PX4 1.16 after
the loss of vision to 5.6 m/s within 12 s, while LOCAL_POSITION_NED continued.
"""

from __future__ import annotations

from collections import defaultdict, deque
from itertools import pairwise
import math
from typing import Any, Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.geometry import Array
from flock_follower.mavlink.dialects import Dialect
from flock_follower.ranges import first_reason

#: The estimate uses forwarded odometry for this long after the last ODOMETRY, s: PX4's limit.
FORWARDED_TIMEOUT: Final[float] = 0.2
#: A status older than this, s, is not used.
STATUS_TIMEOUT: Final[float] = 3.0
#: The flags that a flight needs, by number; those of EKF_STATUS_REPORT have the same numbers and
#: names. Without PRED_POS_HORIZ_REL the position has no source, without POS_HORIZ_ABS no origin.
_NEEDED: Final[dict[int, str]] = {
    mavlink.ESTIMATOR_ATTITUDE: 'ATTITUDE',
    mavlink.ESTIMATOR_VELOCITY_HORIZ: 'VELOCITY_HORIZ',
    mavlink.ESTIMATOR_VELOCITY_VERT: 'VELOCITY_VERT',
    mavlink.ESTIMATOR_POS_HORIZ_REL: 'POS_HORIZ_REL',
    mavlink.ESTIMATOR_POS_HORIZ_ABS: 'POS_HORIZ_ABS',
    mavlink.ESTIMATOR_POS_VERT_ABS: 'POS_VERT_ABS',
    mavlink.ESTIMATOR_PRED_POS_HORIZ_REL: 'PRED_POS_HORIZ_REL'}
#: For this long, s, after its fix was lost an estimator may still report a valid velocity: 7 s on
#: PX4 and on ArduPilot. If it reports one afterwards, it has another source, such as optical flow.
GPS_SILENCE: Final[float] = 10.0

#: An estimate further than this, m, from odometry or from the home position is another place.
FARTHEST_ESTIMATE: Final[float] = 1000.0
#: From this coordinate on, m, two neighboring numbers of LOCAL_POSITION_NED (float32) are 0.5 m
#: apart.
COARSE_COORDINATE: Final[float] = 2.0 ** 22


class GpsFix(NamedTuple):
    """GPS_RAW_INT: whether the receiver has a position fix."""

    fixed: bool
    lost: float
    """Time at which the fix was lost, s; minus infinity if never."""
    accuracy: float = 0.0
    """Standard deviation of the horizontal position, m; 0 if not reported."""


class EstimatorStatus(NamedTuple):
    """ESTIMATOR_STATUS of PX4, EKF_STATUS_REPORT of ArduPilot."""

    time: float
    """Time of reception, s."""
    has_velocity: bool
    """Whether the estimator has a horizontal velocity, and a source for it."""
    missing: tuple[str, ...]
    """The names of the required flags that are not set."""


def estimator_status(message: Any, dialect: Dialect, now: float) -> EstimatorStatus:
    """Return the status in an ESTIMATOR_STATUS or EKF_STATUS_REPORT."""
    flags, (needed, forbidden) = message.flags, dialect.velocity_flags
    return EstimatorStatus(now, flags & (needed | forbidden) == needed, tuple(
        name for flag, name in _NEEDED.items() if not flags & flag))


def explain_refusal(refusal: str, status: EstimatorStatus | None, now: float) -> str:
    """Return a refusal of the autopilot at ``now``, s, with the flags that its estimator lacks."""
    if status is None or now - status.time > STATUS_TIMEOUT or not status.missing:
        return refusal
    return f'{refusal}; its estimator lacks {", ".join(status.missing)}'


def gps_fix(message: Any, before: GpsFix | None, now: float) -> GpsFix:
    """Return the state of the GPS fix after a GPS_RAW_INT."""
    fixed = mavlink.GPS_FIX_TYPE_3D_FIX <= message.fix_type <= mavlink.GPS_FIX_TYPE_PPP
    accuracy = message.h_acc * 1e-3 if fixed else 0.0
    before = before or GpsFix(False, -math.inf)
    return GpsFix(fixed, now if before.fixed and not fixed else before.lost, accuracy)


def velocity_fault(status: EstimatorStatus | None, gps: GpsFix | None, forwarded: float,
                   now: float) -> str:
    """
    Return why the autopilot's velocity is invalid at ``now``, s, or ''.

    :param status: the newest status, None if the autopilot sends none.
    :param gps: the newest GPS fix, None if the autopilot sends none.
    :param forwarded: time since ODOMETRY was last sent, s; infinite if never.
    """
    return first_reason(
        (FORWARDED_TIMEOUT < forwarded < math.inf, 'rests on odometry that is lost'),
        (math.isinf(forwarded) and gps is not None and not gps.fixed
         and now - gps.lost <= GPS_SILENCE, 'rests on GPS, whose fix is lost'),
        (status is not None and now - status.time <= STATUS_TIMEOUT and not status.has_velocity,
         'is invalid according to its estimator'))


#: Rates and pauses are reported over this time, s.
REPORT_WINDOW: Final[float] = 5.0
#: A rate is measured over this time at least, s.
RATE_WINDOW: Final[float] = 1.0
#: A rate is measured over the time of this many messages at least.
MIN_MESSAGES: Final[int] = 5
#: The id that stands for all messages.
ALL_MESSAGES: Final[int] = -1
#: A rate below this share of the requested one is too low; autopilots round intervals.
ENOUGH: Final[float] = 0.7


class Arrivals:
    """Times of reception, s, of the messages of one autopilot, by message id."""

    def __init__(self) -> None:
        self._times: defaultdict[int, deque[float]] = defaultdict(deque)

    def take(self, message_id: int, now: float) -> None:
        """Take a message that arrived at ``now``."""
        for times in (self._times[message_id], self._times[ALL_MESSAGES]):
            times.append(now)
            while now - times[0] > REPORT_WINDOW:
                times.popleft()

    def recent(self, message_id: int, now: float, window: float = REPORT_WINDOW) -> list[float]:
        """Return the times of a message within ``window``, s, at most ``REPORT_WINDOW``."""
        # A copy: other threads read too.
        return [time for time in self._times[message_id].copy() if now - time < window]

    def rate(self, message_id: int, now: float) -> float:
        """Return the rate of a message within REPORT_WINDOW, Hz."""
        return len(self.recent(message_id, now)) / REPORT_WINDOW

    def longest_pause(self, now: float) -> float:
        """Return the longest time without any message within the last REPORT_WINDOW, s."""
        times = [*self.recent(ALL_MESSAGES, now), now]
        return max((later - time for time, later in pairwise(times)), default=0.0)

    def too_seldom(self, message_id: int, wanted: float, now: float) -> bool:
        """Return whether the rate of a message is well below the requested rate, Hz."""
        window = min(max(RATE_WINDOW, MIN_MESSAGES / wanted), REPORT_WINDOW)
        # One message more or less is chance.
        return len(self.recent(message_id, now, window)) + 1 < ENOUGH * wanted * window


def find_misplacement(position: Array | None, home: Array | None, odometry: Array | None) -> str:
    """
    Return why the estimated position must be wrong, or ''.

    :param position: LOCAL_POSITION_NED (3,), m, ENU; None: not known.
    :param home: HOME_POSITION (3,) in the same frame, m; None: not known.
    :param odometry: position of the odometry (3,), m; None: not known.
    """
    if position is None:
        return ''
    if not float(np.max(np.abs(position))) < COARSE_COORDINATE:
        return 'LOCAL_POSITION_NED has steps of 0.5 m: reboot the autopilot'
    for name, other in (('odom', odometry), ('HOME_POSITION', home)):
        if other is None or not np.all(np.isfinite(other)):
            continue
        away = math.dist(position, other)
        if not away <= FARTHEST_ESTIMATE:
            return (f'LOCAL_POSITION_NED is {away / 1000.0:.0f} km from {name}: '
                    'reboot the autopilot')
    return ''

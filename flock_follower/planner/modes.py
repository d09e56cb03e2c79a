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
The planner's states, from the freshness of its inputs.

=======  ================================================  ===================================
state    when                                              horizontal command
=======  ================================================  ===================================
IDLE     not engaged, or no vehicle flies the commands     none at all
SEARCH   engaged, no fresh estimate since                  brake to a hover, turn to look round
TRACK    an estimate of at most ``predict_timeout``, or    the flocking law, guarded
         one received of at most ``heard_timeout``
COAST    the last one used at most ``coast_timeout`` old   zero; turn after the neighbor
HOLD     all are older than that, the neighbor is         brake to a hover; look where it was
         occluded, odometry is overdue, or no image was    lost, then all round
         processed for a while
RELATIVE odometry lost or contradicted, and the bridge     see ``relative``; without an
         flies on (``relative_flight``)                    estimate of 0.5 s no command
=======  ================================================  ===================================

For a vehicle at rest, braking is zero acceleration; a moving vehicle would drift away with zero
acceleration. Without fresh odometry no state has a command. In COAST and HOLD the vehicle backs
away from the lost neighbor. In SEARCH and HOLD the planner resumes following by itself until
``resume_timeout``; after that the state remains, and the planner sends no command until it is
engaged again. No function reads a clock.
"""

from __future__ import annotations

import enum

from flock_follower.planner.inputs import OwnState, untimely
from flock_follower.planner.params import PlannerParams


class State(str, enum.Enum):
    """State of the planner; see above."""

    IDLE = 'IDLE'
    SEARCH = 'SEARCH'
    TRACK = 'TRACK'
    COAST = 'COAST'
    HOLD = 'HOLD'
    RELATIVE = 'RELATIVE'


def next_state(engaged: bool, fault: str, youngest: float | None, followed: float | None,
               params: PlannerParams, waiting: str = '', given_up: bool = False,
               received: float | None = None, occluded: bool = False) -> tuple[State, str]:
    """
    Return the state, and the reason for it unless it is TRACK of a neighbor in sight.

    :param fault: fault of the ego odometry or of perception, or ''.
    :param youngest: age of the youngest estimate of a neighbor in sight, s, or None.
    :param followed: age of the newest estimate that was followed since IDLE, s, or None.
    :param waiting: reason why the planner may not command, or why it was disengaged, or ''.
    :param given_up: whether it had no neighbor for too long, and must be engaged again.
    :param received: age of the youngest estimate reported by another vehicle, s, or None.
    :param occluded: whether the faced neighbor is occluded.
    """
    lost = State.SEARCH if followed is None else State.HOLD
    unseen = 0.0 if followed is None else followed
    in_sight = youngest is not None and youngest <= params.predict_timeout
    heard = received is not None and received <= params.heard_timeout
    rules = (  # the first that applies counts
        (not engaged, State.IDLE, 'not engaged: {waiting}' if waiting else 'not engaged'),
        (given_up, State.IDLE if waiting else lost,
         'no neighbor followed for more than {longest:g} s: sends no more commands, call '
         f'planner/engage to follow again{" ({fault})" if fault else ""}'),
        (waiting, State.IDLE, 'engaged, waiting for {waiting}'),
        (fault, lost, '{fault}'),
        (in_sight, State.TRACK, ''),
        (heard, State.TRACK, 'no neighbor in sight: follows received states'),
        (followed is None, State.SEARCH, 'no neighbor seen since engaging'),
        (occluded, State.HOLD, 'neighbor occluded, seen {unseen:.1f} s ago'),
        (unseen <= params.coast_timeout, State.COAST, 'no neighbor seen for {unseen:.1f} s'),
        (True, State.HOLD, 'no neighbor seen for {unseen:.1f} s'))
    state, reason = next((state, reason) for applies, state, reason in rules if applies)
    return state, reason.format(
        waiting=waiting, longest=params.resume_timeout, fault=fault, unseen=unseen)


def odometry_fault(own: OwnState | None, now: float, params: PlannerParams) -> str:
    """Return the fault of the newest odometry at the time ``now``, or ''."""
    if own is None:
        return 'no odometry'
    fault = untimely(own.stamp, now, params.odom_timeout)
    return f'odometry {fault.reason} ({fault.detail})' if fault else ''


NEVER_LATE_SHARE = 0.5  # share of odom_timeout: younger odometry is never late
ALWAYS_LATE_SHARE = 0.8  # share of odom_timeout: older odometry is late, to brake in time
OVERDUE_FACTOR = 1.2  # factor on the greatest age that the last messages reached


def odometry_delay(own: OwnState | None, now: float, params: PlannerParams) -> str:
    """
    Return the reason if odometry is late, or its source is too slow, or ''.

    Between two messages the age of odometry grows: at 10 Hz and 60 ms of latency it is 0.16 s
    just before the next message arrives. A fast source is late at ``NEVER_LATE_SHARE`` of the
    timeout, a slow source if its message becomes older than the last messages did.
    """
    if own is None:
        return ''
    age, latest = now - own.stamp, ALWAYS_LATE_SHARE * params.odom_timeout
    usual = sorted(own.ages)[len(own.ages) // 2] if own.ages else 0.0
    if usual > latest:
        return f'odometry too slow ({usual:.2f} s old when the next message arrives)'
    longest = max(NEVER_LATE_SHARE * params.odom_timeout,
                  OVERDUE_FACTOR * max(own.ages, default=0.0))
    return f'odometry late ({age:.2f} s)' if age > min(longest, latest) else ''


def blind(looked: float | None, now: float, params: PlannerParams) -> str:
    """Return the reason if perception, or its camera, has stopped, or ''."""
    silent = 0.0 if looked is None else now - looked
    # The tolerance lets a timer that fires exactly at the timeout brake at once.
    return (f'no image processed for {silent:.2f} s'
            if silent > params.perception_timeout - 1e-6 else '')

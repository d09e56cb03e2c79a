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
IDLE     not engaged, or nobody flies the commands         none at all
SEARCH   engaged, no fresh estimate since                  brake to a hover, turn to look round
TRACK    an estimate of at most ``predict_timeout``, or    the flocking law, guarded
         one told by others of at most ``heard_timeout``
COAST    the last one used at most ``coast_timeout`` old   zero; turn after the neighbour
HOLD     all are older than that, the neighbour is         brake to a hover; look where it was
         occluded, odometry is overdue, or no image was    lost, then all round
         processed for a while
=======  ================================================  ===================================

Braking is zero acceleration for a vehicle at rest; for one that moves, zero acceleration would
let it drift off. Without fresh odometry no state gives a command. In COAST and HOLD it keeps out
of the way of whom it no longer sees, a little. From SEARCH and HOLD it follows by itself until
``resume_timeout``. After that the state stays, and no command is given until it is engaged anew.
"""

from __future__ import annotations

import enum

from flock_follower.planner.inputs import OwnState, untimely
from flock_follower.planner.odometry_rhythm import overdue
from flock_follower.planner.params import PlannerParams


class State(str, enum.Enum):
    """What the planner does; see above."""

    IDLE = 'IDLE'
    SEARCH = 'SEARCH'
    TRACK = 'TRACK'
    COAST = 'COAST'
    HOLD = 'HOLD'


def next_state(engaged: bool, fault: str, youngest: float | None, followed: float | None,
               params: PlannerParams, waiting: str = '', given_up: bool = False,
               heard: float | None = None, occluded: bool = False) -> tuple[State, str]:
    """
    Return the state, and the reason for it where it is not TRACK of somebody seen.

    :param fault: what is wrong with the own odometry, or with perception, or ''.
    :param youngest: age of the youngest estimate at hand of somebody seen, s, or None.
    :param followed: age of the newest estimate followed since leaving IDLE, s, or None.
    :param waiting: why it may not command yet, though engaged, or why it was disengaged, or ''.
    :param given_up: whether it followed nobody for too long to command anything unasked.
    :param heard: age of the youngest estimate at hand that another vehicle told, s, or None.
    :param occluded: whether the neighbour that it faces is covered by something.
    """
    if not engaged:
        return State.IDLE, f'not engaged: {waiting}' if waiting else 'not engaged'
    lost = State.SEARCH if followed is None else State.HOLD
    if given_up:
        return State.IDLE if waiting else lost, (
            f'nobody followed for more than {params.resume_timeout:g} s: sends no more commands, '
            f'call planner/engage to follow again{f" ({fault})" if fault else ""}')
    if waiting:
        return State.IDLE, f'engaged, waiting for {waiting}'
    if fault:
        return lost, fault
    if youngest is not None and youngest <= params.predict_timeout:
        return State.TRACK, ''
    if heard is not None and heard <= params.heard_timeout:
        return State.TRACK, 'nobody seen: flies by what others tell'
    if followed is None:
        return State.SEARCH, 'no neighbor seen since engaging'
    if occluded:
        return State.HOLD, f'neighbor occluded, seen {followed:.1f} s ago'
    reason = f'no neighbor seen for {followed:.1f} s'
    return State.COAST if followed <= params.coast_timeout else State.HOLD, reason


def odometry_fault(own: OwnState | None, now: float, params: PlannerParams) -> str:
    """Return why odometry taken in earlier cannot be flown on at the time ``now``, or ''."""
    if own is None:
        return 'no odometry'
    fault = untimely(own.stamp, now, params.odom_timeout)
    return f'odometry {fault.reason} ({fault.detail})' if fault else ''


def late(own: OwnState | None, slow: float | None, now: float, params: PlannerParams) -> str:
    """Return that odometry is too old to fly on, or will be soon, or ''."""
    if own is None:
        return ''
    if slow is not None:
        return f'odometry too slow ({slow:.2f} s old before the next comes)'
    age = now - own.stamp
    return f'odometry late ({age:.2f} s)' if overdue(age, own.spans, params.odom_timeout) else ''


def blind(looked: float | None, now: float, params: PlannerParams) -> str:
    """Return that perception, or the camera before it, has fallen silent, or ''."""
    silent = 0.0 if looked is None else now - looked
    # The tolerance lets a timer that fires exactly at the timeout brake at once.
    return (f'no image processed for {silent:.2f} s'
            if silent > params.perception_timeout - 1e-6 else '')

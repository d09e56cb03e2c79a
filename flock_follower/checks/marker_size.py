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

"""Whether the marker is as large as told, and the camera mounted so: by a marker at rest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import math
from typing import Final

import numpy as np

from flock_follower.checks.findings import error, Finding, ok, unmeasured, warning
from flock_follower.checks.image_motion import interpolated, optical
from flock_follower.checks.observations import Observations
from flock_follower.checks.resting_marker import fit_rest, OwnPath, RestFit, Sightings
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
    rpy_from_matrix,
)
from flock_follower.messages import NANOSECONDS, OdometryState

#: The camera has to be moved by so much, m RMS.
MOVED: Final = 0.1
#: A marker is at rest where what is left unexplained is at most this share of how it moves before
#: the camera, and it sways by less, rad, half the time: a leader that follows its course does not
#: keep to a multiple of what the follower does.
LEFT, SWAYED = 0.15, 0.1
SCALES: Final = (0.4, 2.5)
#: Sizes wrong by more are told, and keep it from flying; known to better than that, 3 deviations.
SIZE, BAD_SIZE = 0.05, 0.1
SURE: Final = 3.0
#: The same of the mounting, rad.
LOOKS, BAD_LOOKS = math.radians(4.0), math.radians(10.0)
#: A mounting wrong by more is another order of axes: that has a line of its own.
OTHER_AXES: Final = 0.7
HOW: Final = 'stand the leader on the ground, and carry the camera before it by 1 m, to and fro'


def check_marker_size(seen: Observations, states: list[OdometryState]) -> Iterator[Finding]:
    """
    Yield whether the marker's size and the camera's mounting are as told.

    :param states: the odometry, as our nodes read it.
    """
    if not seen.sightings or len(states) < 3:
        return
    number, _ = Counter(int(row[1]) for row in seen.sightings).most_common(1)[0]
    rpy = seen.value('relative_pose', 'camera_rpy', [0.0, 0.0, 0.0])
    fit = _fit(seen, states, number, quaternion_to_matrix(quaternion_from_rpy(*rpy)))
    yield _size(seen, number, fit)
    yield _mounting(fit, rpy)


def _size(seen: Observations, number: int, fit: RestFit | None) -> Finding:
    what, wanted = 'marker size', 'as far as odometry moves'
    if fit is None or not at_rest(fit) or SURE * fit.deviation > 3.0 * SIZE:
        return unmeasured(what, _why(fit), wanted)
    off = abs(fit.scale - 1.0)
    told = f'moves {fit.scale:.2f} ± {fit.deviation:.2f} times as far'
    if off <= max(SIZE, SURE * fit.deviation):
        return ok(what, told, wanted)
    side = seen.marker_sides.get(number, 0.0)
    return (error if off > BAD_SIZE else warning)(
        what, told, wanted,
        f'measure marker {number}, its black square from edge to edge: {side / fit.scale:.3f} m '
        f'would fit, config/neighbors.yaml says {side:g}. If that is right: is the calibration '
        'of this lens, and the scale of the odometry right?')


def _mounting(fit: RestFit | None, rpy: list[float]) -> Finding:
    what, wanted = 'camera mounting', f'within {math.degrees(LOOKS):.0f} deg of camera_rpy'
    if fit is None or not at_rest(fit):
        return unmeasured(what, _why(fit), wanted)
    known = SURE * fit.turn_deviations < LOOKS
    if not known.any():
        return unmeasured(what, f'turned too little; {HOW}, and turn it', wanted)
    turn = np.where(known & (np.abs(fit.turn) > SURE * fit.turn_deviations), fit.turn, 0.0)
    off = float(np.linalg.norm(turn))
    if off <= LOOKS:
        return ok(what, f'off by {math.degrees(off):.0f} deg', wanted)
    fitting = rpy_from_matrix(rotation_vector_to_matrix(turn)
                              @ quaternion_to_matrix(quaternion_from_rpy(*rpy)))
    shown = ','.join(str(round(angle, 3) + 0.0) for angle in fitting.tolist())
    return (error if off > BAD_LOOKS else warning)(
        what, f'camera {_words(turn)} than told', wanted,
        f'camera_rpy:=[{shown}] would fit, in relative_pose and planner; or is the pose of the '
        'odometry on the body (odom_child_rpy) wrong?')


def _words(turn: Array) -> str:
    """Return in words how a camera that is turned so, rad, FLU, looks."""
    ways = (('rolled left', 'rolled right'), ('looks higher', 'looks lower'),
            ('looks further right', 'looks further left'))
    told = [f'{way[angle > 0.0]} by {abs(math.degrees(angle)):.0f} deg'
            for way, angle in zip(ways, turn.tolist()) if abs(angle) > 0.5 * LOOKS]
    return ', '.join(told)


def at_rest(fit: RestFit) -> bool:
    """Return whether the marker was at rest, and the camera moved."""
    return (fit.moved >= MOVED and SCALES[0] <= fit.scale <= SCALES[1]
            and fit.left <= LEFT * min(fit.scale, 1.0) * fit.moved and fit.swayed <= SWAYED
            and float(np.abs(fit.turn).max()) < OTHER_AXES)


def _why(fit: RestFit | None) -> str:
    if fit is not None and fit.moved >= MOVED and not at_rest(fit):
        return 'the leader moves'
    return HOW


def _fit(seen: Observations, states: list[OdometryState], number: int,
         camera_rotation: Array) -> RestFit | None:
    """Return the fit to the sightings of a marker."""
    rows = np.array([row for row in seen.sightings if row[1] == number])
    rows = rows[np.argsort(rows[:, 0])]
    start = states[0].stamp
    stamps = np.array([(state.stamp - start) / NANOSECONDS for state in states])
    # Near zero, floats resolve a nanosecond.
    times = rows[:, 0] - start / NANOSECONDS
    attitude = interpolated(stamps, np.array([state.quaternion for state in states]))
    quaternions, known = attitude(times)
    rows, times, quaternions = rows[known], times[known], quaternions[known]
    position, velocity, rate = (
        np.column_stack([np.interp(times, stamps, column) for column in np.array(values).T])
        for values in ([state.position for state in states],
                       [state.velocity for state in states],
                       [state.angular_velocity for state in states]))
    own = OwnPath(times, position, velocity,
                  np.array([quaternion_to_matrix(q) for q in quaternions]), rate)
    R_base_optical = optical(camera_rotation)
    return fit_rest(Sightings(
        rows[:, 2:5] @ R_base_optical.T, rows[:, 5],
        np.array([R_base_optical @ quaternion_to_matrix(q) for q in rows[:, 6:10]]),
        np.array(seen.value('relative_pose', 'camera_position', [0.0, 0.0, 0.0]))), own)

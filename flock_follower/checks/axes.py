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

"""The axes of the odometry: is up up, is ahead ahead; with them the camera's stamps and lens."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Final

import numpy as np

from flock_follower.checks.findings import error, Finding, ok, unmeasured, warning
from flock_follower.checks.image_motion import AxesFit, fit_axes, interpolated, optical
from flock_follower.checks.observations import Observations
from flock_follower.checks.pictures import camera_model
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    rpy_from_matrix,
)
from flock_follower.messages import OdometryState
from flock_follower.odometry.reader import SourceParams

#: Lean of base_link on average, deg: told from, too much from.
LEAN, LYING = 20.0, 40.0
#: How images moved tells something where this share of it is explained by how it turned. Another
#: order of axes, or offset of stamps, is told where it leaves so much less unexplained.
EXPLAINED: Final = 0.6
TURNED, SHIFTED = 0.4, 0.8
#: Offsets of the camera's stamps, s: reported from, an error from. At 20, 30 and 50 ms the squared
#: errors of a neighbour's position are 10, 30 and 350 times what its covariance says.
OFFSET, BAD_OFFSET = 0.010, 0.030
#: Between attitudes further apart, s, it is not known well enough how it turned for that.
SLOW: Final = 0.06
#: Focal lengths wrong by so much are told, where that explains so much.
ZOOM, ZOOMED = 0.2, 0.9
AHEAD: Final = 'images move as odometry turns'
IN_TIME: Final = f'within {1e3 * OFFSET:.0f} ms of the odometry'


def check_axes(seen: Observations, states: list[OdometryState], period: float,
               params: SourceParams) -> Iterator[Finding]:
    """
    Yield whether up is up, whether ahead is ahead, and the offset of the camera's stamps.

    :param states: the odometry, as our nodes read it.
    :param period: the longest time between two of them, s.
    :param params: how they read it.
    """
    up = np.mean([quaternion_to_matrix(s.quaternion)[2] for s in states], axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    lean = math.degrees(math.acos(min(1.0, max(-1.0, float(up[2])))))
    fit = _fit(seen, states, up if lean >= LYING else None)
    turned = fit is not None and fit.best >= EXPLAINED and (
        1.0 - fit.best < TURNED * (1.0 - fit.configured))
    what, wanted = 'odom up', "base_link's z up"
    rpy = _rpy(np.eye(3) if fit is None else fit.turn, params)
    if lean >= LYING:
        axis = _axis(up)
        yield error(what, f'{axis} of base_link is up (leans {lean:.0f} deg)', wanted,
                    f'odom_child_rpy:={rpy} fits the images' if turned else _mounting(axis))
    elif turned and fit is not None and fit.turn[2, 2] < -0.5:
        yield error(what, 'images turn the other way round: its z is down', wanted,
                    'have its source send ENU and FLU (REP-103) instead of NED and FRD; or is '
                    'the camera upside down (camera_rpy)?')
        return
    elif lean >= LEAN:
        yield warning(what, f'leans {lean:.0f} deg on average', wanted,
                      'hold it level; else give the pose of its IMU on the body (odom_child_rpy)')
    else:
        yield ok(what, f'leans {lean:.0f} deg on average', wanted)
    if fit is None:
        yield unmeasured('odom ahead', 'turned too little: turn it by hand, 30 deg', AHEAD)
        yield unmeasured('camera time offset', 'turned too little', IN_TIME)
        return
    yield from _ahead(seen, fit, period, rpy if turned else '', lean < LYING)


def _ahead(seen: Observations, fit: AxesFit, period: float, rpy: str,
           level: bool) -> Iterator[Finding]:
    """Yield whether images move as odometry turns; ``rpy`` is what would fit better, or ''."""
    what, wanted = 'odom ahead', AHEAD
    share = f'turning explains {max(fit.configured, 0.0):.0%} of it'
    if rpy and level:
        yield error(what, f'{share}; with other axes {fit.best:.0%}', wanted, 'check camera_rpy; '
                    f'if that is right, set odom_child_rpy:={rpy}')
    elif fit.configured >= EXPLAINED:
        yield ok(what, share, wanted)
    elif not rpy:
        yield unmeasured(what, f'{share}; turn it by hand', wanted)
    if fit.best >= EXPLAINED and period <= SLOW:
        yield _offset(fit, float(seen.value('relative_pose', 'time_offset', 0.0)))
    else:
        yield unmeasured('camera time offset', share if period <= SLOW else
                         f'odometry comes only every {period:.2f} s', IN_TIME)
    # Of a fisheye the parts that are looked at move less than its middle does.
    if (fit.zoomed >= ZOOMED and abs(fit.zoom - 1.0) > ZOOM
            and seen.calibration['model'] != 'equidistant'):
        yield warning('focal length', f'images move {fit.zoom:.2f} times as far as it says',
                      'once', 'is the calibration of this lens, and for this size of images?')


def _offset(fit: AxesFit, known: float) -> Finding:
    """Return how far camera stamps are off; ``known``, s, relative_pose is told already."""
    what, wanted = 'camera time offset', IN_TIME
    told = f'about {1e3 * abs(fit.offset):.0f} ms'
    side = 'later' if fit.offset > 0.0 else 'earlier'
    if abs(fit.offset) <= OFFSET or 1.0 - fit.best >= SHIFTED * (1.0 - fit.together):
        return ok(what, told, wanted)
    if abs(fit.offset + known) <= OFFSET:
        return ok(what, f'{told} {side}, as time_offset says', wanted)
    say = error if abs(fit.offset + known) > BAD_OFFSET else warning
    return say(what, f'images are stamped {told} {side} than odometry', wanted,
               'have the driver stamp the middle of the exposure, by one clock; '
               f'else set time_offset:={-fit.offset:.3f} of relative_pose')


def _fit(seen: Observations, states: list[OdometryState], up: Array | None) -> AxesFit | None:
    try:
        camera = camera_model(seen)
    except (KeyError, ValueError):
        return None
    mounted = seen.value('relative_pose', 'camera_rpy', [0.0, 0.0, 0.0])
    stamps = np.array([state.stamp * 1e-9 for state in states])
    attitude = interpolated(stamps, np.array([state.quaternion for state in states]))
    return fit_axes(seen.shifts, attitude, float(camera.matrix[0, 0]),
                    optical(quaternion_to_matrix(quaternion_from_rpy(*mounted))), up)


def _axis(up: Array) -> str:
    """Return the name of the axis of base_link that is up."""
    largest = int(np.argmax(np.abs(up)))
    return f'{"-" if up[largest] < 0.0 else "+"}{"xyz"[largest]}'


def _mounting(axis: str) -> str:
    if axis == '-y':
        return ('its child frame is a camera or its IMU (x right, y down): '
                'odom_child_rpy:=[-1.5708,0.0,-1.5708]')
    return ('its child frame is not base_link: set odom_child_rpy to how it sits on the body '
            '(child_frame_id tells which it is), see docs/sensors.md')


def _rpy(turn: Array, params: SourceParams) -> str:
    """Return the ``odom_child_rpy`` that lays the axes as ``turn`` wants them."""
    R = turn @ quaternion_to_matrix(quaternion_from_rpy(*params.child_rpy))
    return f'[{",".join(str(round(angle, 4) + 0.0) for angle in rpy_from_matrix(R).tolist())}]'

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

"""Checks of the odometry (velocity, jumps, axes), and of images and mounting against it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
import math
from typing import Final

import numpy as np

from flock_follower.checks.findings import (
    ERROR,
    Finding,
    first,
    grade,
    OK,
    SIGNIFICANT_SIGMAS,
    UNMEASURED,
    WARNING,
)
from flock_follower.checks.image_motion import AxesFit, fit_axes, OwnPath
from flock_follower.checks.marker_size import check_marker_size
from flock_follower.checks.observations import Observations, OwnMotion
from flock_follower.checks.pictures import camera_model
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    rpy_from_matrix,
)
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.odometry.derivation import CHILD, NONE, ODOM, TwistFrame
from flock_follower.parameters.cameras import ALONE
from flock_follower.parameters.files import COMMON

#: Largest share of unusable messages that permits a flight.
LOST: Final = 0.02
#: Mean lean of base_link, deg, from which on there is a warning.
LEAN_WARNING = 20.0
#: Mean lean of base_link, deg, from which on there is an error.
LEAN_ERROR = 40.0
#: The image motion is conclusive if rotation explains this share of it.
MIN_EXPLAINED: Final = 0.6
#: Other axes are reported if they reduce the unexplained image motion to this share.
AXES_REDUCTION = 0.4
#: An offset of stamps is reported if it reduces the unexplained image motion to this share.
OFFSET_REDUCTION = 0.8
#: Offset of the camera's stamps, s, from which on there is a warning. At 20, 30 and 50 ms the
#: squared errors of a neighbor's position are 10, 30 and 350 times its covariance.
OFFSET_WARNING = 0.010
#: Offset of the camera's stamps, s, from which on there is an error.
OFFSET_ERROR = 0.030
#: s: between attitudes farther apart the rotation is not known well enough to find an offset.
SLOW: Final = 0.06
#: Relative error of a focal length that is an error: 0.965 was measured with the right one.
ZOOM: Final = 0.1
#: Least number of windows for a judgment of the axes of the positions.
MIN_WINDOWS = 6
#: Least error of the velocity, m/s, that is assumed.
MIN_VELOCITY_ERROR = 0.02
#: Variances by which other axes must reduce the squared errors to be reported.
MIN_VARIANCES = 60.0
#: Sine of the least turn of the axes that is reported; an estimator turns them by less.
MIN_SIN_TURN = 0.4
#: Height, m, below which the vehicle started higher up, or z points down.
LOWEST_HEIGHT = -0.5
#: Events of the reader: the property, the level and the action.
EVENTS: Final = (
    ('odom jumped', 'odom jumps', WARNING,
     'turn off loop closure and relocalization, or take the frame without them'),
    ('odom changed its frames', 'odom frames', ERROR,
     'is it published by two sources? Every change starts perception anew'),
    ('odom out of order', 'odom order', WARNING,
     'if two sources publish on this topic, keep one; a message with an older stamp is not used'),
    ('odom gap', 'odom gaps', WARNING,
     'see in the log of its source why it pauses: without odometry the follower brakes'))
#: Error of the mounting, rad, from which on there is a warning.
MOUNTING_WARNING = math.radians(4.0)
#: Error of the mounting, rad, from which on there is an error.
MOUNTING_ERROR = math.radians(8.0)
MOUNTED: Final = f'within {math.degrees(MOUNTING_WARNING):.0f} deg of camera_rpy'
_AXES: Final = ('roll', 'pitch', 'yaw')
_WAYS: Final = (('rolled left', 'rolled right'), ('looks higher', 'looks lower'),
                ('looks further right', 'looks further left'))
TURN_MOVES: Final = 'images move as odometry turns'
IN_TIME: Final = f'within {1e3 * OFFSET_WARNING:.0f} ms of the odometry'
DERIVED: Final = 'works: derived from the positions, which is noisier'


def check_own_motion(seen: Observations) -> Iterator[Finding]:
    """Check the odometry, then the images and the marker against the odometry."""
    motion = seen.own
    if motion is None:
        return
    count = motion.lost + len(motion.states) + sum(
        motion.events[each] for each in ('odom out of order', 'odom stamp repeated'))
    if motion.lost:
        yield grade(motion.lost > LOST * count, True, 'odom',
                    f'{motion.lost} of {count} are invalid: {motion.last_error}',
                    'position and attitude', 'wait until its source is initialized; more '
                    'texture, light; rtabmap: publish_null_when_lost:=false')
    if len(motion.states) < 3:
        return
    yield from _parameters_alike(seen)
    for event, what, level, advice in EVENTS:
        of_recording = event == 'odom gap' and (seen.gaps or seen.busy)  # reported by itself
        if (times := motion.events[event]) and not of_recording:
            yield Finding(level, what, f'{times} in {count} messages', 'none', advice)
    yield from _positions(motion.source.twist, float(np.median(
        [state.position[2] for state in motion.states])))
    yield _twist(motion)
    if missing := [name for name in motion.source.missing if name != 'velocity']:
        yield Finding(WARNING, 'odom lacks', ', '.join(missing), 'nothing', 'works: derived, or '
                      'odom_std is used instead; let the source send it if possible')
    up = np.mean([state.twist_rotation[2] for state in motion.states], axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    lean = math.degrees(math.acos(min(1.0, max(-1.0, float(up[2])))))
    path = OwnPath(motion.states)
    fit = None
    with suppress(ValueError):  # reported with the calibration
        fit = fit_axes(seen.shifts, path, camera_model(seen), seen.camera_rotation,
                       up if lean >= LEAN_ERROR else None)
    yield from _check_axes(seen, motion, up, lean, fit)
    sure = fit if fit is not None and fit.best >= MIN_EXPLAINED else None
    yield _focal(sure, sure is not None and seen.calibration.distortion_model == 'equidistant')
    if seen.sightings:
        yield check_marker_size(seen, path)
    if sure is None:
        yield Finding(UNMEASURED, 'camera mounting', 'turned too little, or too little texture: '
                      'roll, pitch and yaw it by hand', MOUNTED)
    else:
        yield check_mounting(sure.mounting, sure.mounting_deviations, seen.camera_rpy)


def _parameters_alike(seen: Observations) -> Iterator[Finding]:
    """Report parameters of odometry and cameras that differ between our nodes."""
    shared = (*COMMON, *ALONE)
    for name in sorted({name for own in seen.parameters.values() for name in own
                        if name in shared or name.startswith('camera.')}):
        values = {node: own[name] for node, own in seen.parameters.items() if name in own}
        if len(set(map(str, values.values()))) > 1:
            listed = ', '.join(f'{value} in {node}' for node, value in values.items())
            yield Finding(ERROR, name, listed, 'the same in every node',
                          'set it under /** in one file')


def _positions(twist: TwistFrame, height: float) -> Iterator[Finding]:
    """
    Check that the positions have the axes of attitude and velocity; ``height`` is their z, m.

    The axes differ if only a rotated or reflected velocity explains the positions, in the child
    frame and in the header's frame (Kabsch's method).
    """
    if twist.wanted == NONE or len(twist.windows) < MIN_WINDOWS or not np.any(
            np.array(twist.windows)[:, 1]):
        return  # without a velocity there is nothing to compare
    moved, *readings = np.swapaxes(twist.windows, 0, 1)
    same = min(readings, key=lambda velocity: float(np.sum((moved - velocity)**2)))
    turned = []
    for velocity in readings:
        u, _, vt = np.linalg.svd(
            moved.T @ velocity + MIN_VELOCITY_ERROR**2 * len(moved) * np.eye(3))
        turned.append((np.sum((moved - velocity @ (u @ vt).T)**2, axis=0), u @ vt))
    least, A = min(turned, key=lambda each: float(each[0].sum()))
    variance = float(least.sum()) / moved.size + MIN_VELOCITY_ERROR**2
    other = np.abs(A - np.eye(3)).max(axis=1) > MIN_SIN_TURN
    before = float(np.sum((moved - same)**2, axis=0)[other].sum())
    after = float(least[other].sum())
    # An axis whose reversal would show is known.
    still = ', '.join(axis for axis, gain in zip('xyz', 4.0 * np.sum(moved * same, axis=0))
                      if gain < MIN_VARIANCES * variance)
    axes = ', '.join(f'{"-" if row[k] < 0.0 else ""}{"xyz"[k]}'
                     for row in A for k in [int(np.abs(row).argmax())])
    turn = math.degrees(math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(A)) - 1.0)))))
    yield first(
        'odom positions', 'along the axes of the velocity',
        (before - after > max(MIN_VARIANCES * variance, 3.0 * after), ERROR,
         f'x, y, z move as {axes} of the velocity, turned by {turn:.0f} deg',
         'set up its source to send position, attitude and velocity in the axes of REP-103 '
         '(ENU, FLU)'),
        ('z' in still and height <= LOWEST_HEIGHT, WARNING,
         f'z moved too little, and is {height:.1f} m',
         'if it was not started higher up, z points down: set up its source to send ENU '
         '(REP-103)'),
        (still, UNMEASURED, f'{still} moved too little: carry it, and lift it', ''),
        (True, OK, 'agree with the velocity', ''))


def _twist(motion: OwnMotion) -> Finding:
    twist, invalid = motion.source.twist, motion.events['odom velocity invalid']
    return first(
        'odom velocity', 'as its positions move',
        ('velocity' in motion.source.missing, WARNING, 'none (not finite)', DERIVED),
        (invalid, WARNING, f'invalid {invalid} times', f'{DERIVED}, and steps each time'),
        (twist.wanted in (CHILD, ODOM) and twist.found not in ('', twist.wanted), ERROR,
         f'read in {twist.wanted}, the positions fit {twist.found}',
         'set odom_twist_frame:=auto'),
        (twist.found == NONE, WARNING, f'off by {twist.contradiction:.2f} m/s in either frame',
         f'{DERIVED}; check the velocity of the odometry source'),
        (twist.wanted == NONE, OK, 'odom_twist_frame is none: derived from the positions', ''),
        (not twist.found, UNMEASURED, 'moved too little', ''),
        (True, OK, f'in the {twist.found} frame', ''))


def _check_axes(seen: Observations, motion: OwnMotion, up: Array, lean: float,
                fit: AxesFit | None) -> Iterator[Finding]:
    """
    Check the vertical and forward axes, and the time offset.

    :param up: (3,), the mean upward direction in base_link; :param lean: that of its z, deg.
    """
    turned = fit is not None and fit.best >= MIN_EXPLAINED and (
        1.0 - fit.best < AXES_REDUCTION * (1.0 - fit.configured))
    down = fit is not None and turned and lean < LEAN_ERROR and fit.turn[2, 2] < -0.5
    R = (np.eye(3) if fit is None else fit.turn) @ quaternion_to_matrix(quaternion_from_rpy(
        *seen.value('relative_pose', 'odom_child_rpy', [0.0, 0.0, 0.0])))
    rpy = f'[{",".join(str(round(angle, 4) + 0.0) for angle in rpy_from_matrix(R).tolist())}]'
    largest = int(np.argmax(np.abs(up)))
    axis = f'{"-" if up[largest] < 0.0 else "+"}{"xyz"[largest]}'
    yield first(
        'odom up', "base_link's z up",
        (lean >= LEAN_ERROR, ERROR, f'{axis} of base_link is up (leans {lean:.0f} deg)',
         f'odom_child_rpy:=[-1.5708,0.0,-1.5708] for the axes of a camera (x right, y down), else '
         f'its attitude on the body{f": {rpy} fits the images" if turned else ""}; see '
         'docs/sensors.md'),
        (down, ERROR, 'images turn the other way round: z of base_link is down',
         'let the odometry source send ENU and FLU (REP-103) instead of NED and FRD; or is the '
         'camera upside down (camera_rpy)?'),
        (lean >= LEAN_WARNING, WARNING, f'leans {lean:.0f} deg on average',
         'hold the vehicle level; else set the pose of the IMU on the body (odom_child_rpy)'),
        (True, OK, f'leans {lean:.0f} deg on average', ''))
    if down:
        return
    if fit is None:
        yield Finding(UNMEASURED, 'odom ahead', 'turned too little: turn the vehicle by 30 deg',
                      TURN_MOVES)
        yield Finding(UNMEASURED, 'camera time offset', 'turned too little', IN_TIME)
        return
    share = f'turning explains {max(fit.configured, 0.0):.0%} of it'
    if not turned or lean < LEAN_ERROR:
        yield first(
            'odom ahead', TURN_MOVES,
            (turned, ERROR, f'{share}; with other axes {fit.best:.0%}',
             f'check camera_rpy; if that is right, set odom_child_rpy:={rpy}'),
            (fit.configured >= MIN_EXPLAINED, OK, share, ''),
            (True, UNMEASURED, f'{share}; turn the vehicle by hand', ''))
    yield _offset(fit, share, motion.source.period,
                  float(seen.value('relative_pose', 'time_offset', 0.0)))


def _offset(fit: AxesFit, share: str, period: float, known: float) -> Finding:
    """Check the time offset; ``known``, s, is the parameter ``time_offset``."""
    off = f'about {1e3 * abs(fit.offset):.0f} ms'
    side = 'later' if fit.offset > 0.0 else 'earlier'
    rest = abs(fit.offset + known)
    return first(
        'camera time offset', IN_TIME,
        (period > SLOW, UNMEASURED, f'odometry comes only every {period:.2f} s', ''),
        (fit.best < MIN_EXPLAINED, UNMEASURED, share, ''),
        (abs(fit.offset) <= OFFSET_WARNING
         or 1.0 - fit.explained >= OFFSET_REDUCTION * (1.0 - fit.together), OK,
         off, ''),
        (rest > OFFSET_WARNING, ERROR if rest > OFFSET_ERROR else WARNING,
         f'images are stamped {off} {side} than odometry', 'have the driver stamp the middle of '
         f'the exposure, by one clock; else set time_offset:={-fit.offset:.3f} of relative_pose'),
        (True, OK, f'{off} {side}, corrected by time_offset', ''))


def _focal(fit: AxesFit | None, fisheye: bool) -> Finding:
    """Check the focal length; in a fisheye image the flow changes too much within a part."""
    what, wanted = 'focal length', 'images move as far as it predicts'
    if fit is None or fisheye or SIGNIFICANT_SIGMAS * fit.zoom_deviation > 2.0 * ZOOM:
        return Finding(UNMEASURED, what, 'a fisheye lens' if fisheye else
                       'turned too little: pitch and yaw it by hand', wanted)
    wrong = abs(math.log(max(fit.zoom, 1e-3))) > max(ZOOM, SIGNIFICANT_SIGMAS * fit.zoom_deviation)
    return grade(
        wrong, False, what, f'images move {fit.zoom:.2f} ± {fit.zoom_deviation:.2f} times as far',
        wanted, 'is the calibration of this lens, and for this size of images?')


def check_mounting(turn: Array, deviations: Array, rpy: Sequence[float]) -> Finding:
    """
    Return the finding about roll, pitch and yaw of the camera.

    :param turn: the rotation vector (3,), rad, along base_link's axes, from the configured to the
        measured attitude of the camera; :param deviations: (3,), its standard deviations.
    :param rpy: the configured ``camera_rpy``, rad.
    """
    margin = SIGNIFICANT_SIGMAS * deviations
    wrong = np.abs(turn) > np.maximum(MOUNTING_WARNING, margin)
    unknown = ', '.join(axis for axis, bad, by in zip(_AXES, wrong, margin)
                        if not bad and by > MOUNTING_WARNING)
    looks = ', '.join(f'{way[angle > 0.0]} by {abs(math.degrees(angle)):.0f} deg'
                      for way, angle, bad in zip(_WAYS, turn.tolist(), wrong) if bad)
    fitting = ','.join(str(round(angle, 3) + 0.0) for angle in rpy_from_matrix(
        rotation_vector_to_matrix(np.where(wrong, turn, 0.0))
        @ quaternion_to_matrix(quaternion_from_rpy(*rpy))).tolist())
    measured = f'camera {looks} than configured{f"; {unknown} unknown" if unknown else ""}'
    advice = (f'camera_rpy:=[{fitting}] would fit, in relative_pose and planner; or is the pose '
              'of the odometry on the body (odom_child_rpy) wrong?')
    return first(
        'camera mounting', MOUNTED,
        (np.any(wrong & (np.abs(turn) > MOUNTING_ERROR)), ERROR, measured, advice),
        (wrong.any(), WARNING, measured, advice),
        (unknown, UNMEASURED, f'{unknown} unknown: roll, pitch and yaw it by hand, 30 deg', ''),
        (True, OK, f'off by {math.degrees(np.abs(turn).max()):.0f} deg', ''))

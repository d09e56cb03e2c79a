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

"""The odometry: velocity, jumps and gaps in it, its axes, and whether the autopilot agrees."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Final

import numpy as np

from flock_follower.checks.findings import (
    ERROR,
    error,
    Finding,
    first,
    judged,
    OK,
    UNMEASURED,
    unmeasured,
    WARNING,
    warning,
)
from flock_follower.checks.image_motion import AxesFit, fit_axes, interpolated
from flock_follower.checks.mounting import SURE
from flock_follower.checks.observations import Observations, OwnMotion
from flock_follower.checks.pictures import camera_model
from flock_follower.checks.resting_marker import check_resting_marker
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
    rpy_from_matrix,
    wrap_angle,
    yaw_from_quaternion,
)
from flock_follower.messages import OdometryState
from flock_follower.odometry.derivation import CHILD, NONE, ODOM, TwistFrame
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters.files import COMMON
from flock_follower.parameters.spec import filled

#: rad: difference between the yaws of odometry and autopilot, from which on there is a warning;
#: the bridge refuses above the second.
YAWS: Final = (0.12, 0.35)
#: Largest share of unusable messages that permits a flight.
LOST: Final = 0.02
#: deg: mean lean of base_link from which on there is a warning, and an error.
LEAN, LYING = 20.0, 40.0
#: The image motion is conclusive if rotation explains this share of it. Other axes, or an offset
#: of stamps, are reported if they reduce the rest by these factors.
EXPLAINED: Final = 0.6
TURNED, SHIFTED = 0.4, 0.8
#: s: offset of the camera's stamps from which on there is a warning, and an error. At 20, 30 and
#: 50 ms the squared errors of a neighbour's position are 10, 30 and 350 times its covariance.
OFFSET, BAD_OFFSET = 0.010, 0.030
#: s: between attitudes farther apart the rotation is not known well enough to find an offset.
SLOW: Final = 0.06
#: Relative error of a focal length that is an error: 0.965 was measured with the right one.
ZOOM: Final = 0.1
#: Axes of the positions: least number of windows; least error of the velocity, m/s; the squared
#: errors must fall by so many variances; smaller turns are those of an estimator. A vehicle that
#: is lower than this, m, was started higher up, or z points down.
FEW, STILL, EVIDENT, SIN_TURNED, BELOW = 6, 0.02, 60.0, 0.4, -0.5
TURN_MOVES: Final = 'images move as odometry turns'
IN_TIME: Final = f'within {1e3 * OFFSET:.0f} ms of the odometry'
DERIVED: Final = 'works: derived from the positions, which is noisier'


def check_own_motion(seen: Observations) -> Iterator[Finding]:
    """Check the odometry."""
    if not seen.frames or not (seen.odometry or seen.own):
        return
    try:
        params = filled(SourceParams(), seen.parameters['relative_pose'], 'odom_')
    except (KeyError, ValueError):
        params = SourceParams()
    motion = seen.own or _read(seen, params)
    count = motion.lost + len(motion.states)
    if motion.lost:
        yield judged(motion.lost > LOST * count, True, 'odom',
                     f'{motion.lost} of {count} say nothing: {motion.last_error}',
                     'position and attitude', 'wait until its source is initialised; more '
                     'texture, light; rtabmap: publish_null_when_lost:=false')
    if len(motion.states) < 3:
        return
    yield from _parameters_alike(seen)
    yield _frames(seen)
    if jumps := motion.events['odom jumped']:
        yield warning('odom jumps', f'{jumps} in {len(motion.states)} messages', 'none',
                      'turn off loop closure and relocalisation, or take the frame without them')
    yield from _positions(motion.source.twist, motion.states)
    yield _twist(motion)
    yield from _lacking(motion)
    up = np.mean([state.twist_rotation[2] for state in motion.states], axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    lean = math.degrees(math.acos(min(1.0, max(-1.0, float(up[2])))))
    fit = _fit(seen, motion.states, up if lean >= LYING else None)
    yield from _axes(seen, motion, params, up, lean, fit)
    known = fit if fit is not None and fit.best >= EXPLAINED else None
    yield _focal(known, known is not None and seen.calibration.distortion_model == 'equidistant')
    yield from check_resting_marker(seen, motion.states, known)
    yield from _against_autopilot(seen, motion)


def _read(seen: Observations, params: SourceParams) -> OwnMotion:
    """Read the odometry as our nodes read it."""
    motion = OwnMotion(OdometrySource(params))
    if seen.static_child is not None and not any((*params.child_position, *params.child_rpy)):
        motion.source.place_child(seen.static_child)
    for arrival, message in seen.odometry:
        motion.take(message, arrival)
    return motion


def _parameters_alike(seen: Observations) -> Iterator[Finding]:
    """Report parameters of odometry and cameras that our nodes do not have alike."""
    shared = (*COMMON, 'camera_rpy')
    for name in sorted({name for own in seen.parameters.values() for name in own
                        if name in shared or name.startswith('camera.')}):
        values = {node: own[name] for node, own in seen.parameters.items() if name in own}
        if len(set(map(str, values.values()))) > 1:
            yield error(name, ', '.join(f'{value} in {node}' for node, value in values.items()),
                        'the same in every node', 'set it under /** in one file')


def _frames(seen: Observations) -> Finding:
    header, child = seen.frames[-1]
    changes, measured = len(seen.frames) - 1, f'{header or "(none)"} to {child or "(none)"}'
    return first(
        'odom frames', 'one pair, both named',
        (changes, ERROR, f'changed {changes} times, now {measured}',
         'is it published by two sources? Every change starts perception anew'),
        (not header, WARNING, measured, 'let the odometry source fill header.frame_id'),
        (True, OK, measured, ''))


def _positions(twist: TwistFrame, states: list[OdometryState]) -> Iterator[Finding]:
    """
    Check that the positions have the axes of attitude and velocity.

    They have others if a rotation, or a reflection, of the velocity explains them, and neither
    reading of the velocity does without it (Kabsch's method).
    """
    if twist.wanted == NONE or len(twist.windows) < FEW or not np.any(
            np.array(twist.windows)[:, 1]):
        return  # without a velocity there is nothing to compare
    moved, *readings = np.swapaxes(twist.windows, 0, 1)
    same = min(readings, key=lambda velocity: float(np.sum((moved - velocity)**2)))
    turned = []
    for velocity in readings:
        u, _, vt = np.linalg.svd(moved.T @ velocity + STILL**2 * len(moved) * np.eye(3))
        turned.append((np.sum((moved - velocity @ (u @ vt).T)**2, axis=0), u @ vt))
    least, A = min(turned, key=lambda each: float(each[0].sum()))
    variance = float(least.sum()) / moved.size + STILL**2
    other = np.abs(A - np.eye(3)).max(axis=1) > SIN_TURNED
    before, after = (float(left[other].sum()) for left in (
        np.sum((moved - same)**2, axis=0), least))
    # An axis whose reversal would show is known.
    still = ', '.join(axis for axis, gain in zip('xyz', 4.0 * np.sum(moved * same, axis=0))
                      if gain < EVIDENT * variance)
    axes = ', '.join(f'{"-" if row[k] < 0.0 else ""}{"xyz"[k]}'
                     for row in A for k in [int(np.abs(row).argmax())])
    turn = math.degrees(math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(A)) - 1.0)))))
    low = float(np.median([state.position[2] for state in states]))
    moved_little = f'{still} moved too little: carry it, and lift it'
    yield first(
        'odom positions', 'along the axes of the velocity',
        (before - after > max(EVIDENT * variance, 3.0 * after), ERROR,
         f'turned by {turn:.0f} deg against the velocity' if axes == 'x, y, z' else
         f'x, y, z move as {axes} of the velocity', 'set up its source to send position, attitude '
         'and velocity in the axes of REP-103 (ENU, FLU)'),
        ('z' in still and low <= BELOW, WARNING, f'{moved_little}; z is {low:.1f} m',
         'if it was not started higher up, z points down: set up its source to send ENU '
         '(REP-103)'),
        (still, UNMEASURED, moved_little, ''),
        (True, OK, 'as the velocity says', ''))


def _twist(motion: OwnMotion) -> Finding:
    twist = motion.source.twist
    return first(
        'odom velocity', 'as its positions move',
        ('velocity' in motion.source.missing, WARNING, 'none (not finite)', DERIVED),
        (twist.wanted in (CHILD, ODOM) and twist.found not in ('', twist.wanted), ERROR,
         f'read in {twist.wanted}, the positions say {twist.found}',
         'set odom_twist_frame:=auto'),
        (twist.found == NONE, WARNING, f'off by {twist.contradiction:.2f} m/s in either frame',
         f'{DERIVED}; check the velocity of the odometry source'),
        (twist.wanted == NONE, OK, 'odom_twist_frame is none: derived from the positions', ''),
        (not twist.found, UNMEASURED, 'moved too little', ''),
        (True, OK, f'in the {twist.found} frame', ''))


def _lacking(motion: OwnMotion) -> Iterator[Finding]:
    missing = motion.source.missing
    fastest = float(np.abs([state.angular_velocity for state in motion.states]).max())
    zero = 'angular velocity' in missing
    yield judged(False, zero, 'odom angular rate', 'always zero' if zero else
                 f'up to {math.degrees(fastest):.0f} deg/s', 'that of the gyroscope',
                 'works: derived from the attitudes, which is noisier; let the source send it if '
                 'possible')
    parts = sorted({name.rsplit(' ', 1)[-1] for name in missing if 'covariance' in name})
    yield judged(False, bool(parts), 'odom covariances',
                 f'incomplete for {" and ".join(parts)}' if parts else 'there',
                 'those of its filter',
                 'works: odom_std is used instead; set it to the errors of your odometry')


def _axes(seen: Observations, motion: OwnMotion, params: SourceParams, up: Array, lean: float,
          fit: AxesFit | None) -> Iterator[Finding]:
    """
    Check the vertical and forward axes, and the time offset.

    :param up: (3,), the mean upward direction in base_link; :param lean: that of its z, deg.
    """
    turned = fit is not None and fit.best >= EXPLAINED and (
        1.0 - fit.best < TURNED * (1.0 - fit.configured))
    down = fit is not None and turned and lean < LYING and fit.turn[2, 2] < -0.5
    R = (np.eye(3) if fit is None else fit.turn) @ quaternion_to_matrix(
        quaternion_from_rpy(*params.child_rpy))
    rpy = f'[{",".join(str(round(angle, 4) + 0.0) for angle in rpy_from_matrix(R).tolist())}]'
    largest = int(np.argmax(np.abs(up)))
    axis = f'{"-" if up[largest] < 0.0 else "+"}{"xyz"[largest]}'
    yield first(
        'odom up', "base_link's z up",
        (lean >= LYING, ERROR, f'{axis} of base_link is up (leans {lean:.0f} deg)',
         f'odom_child_rpy:={rpy} fits the images' if turned else
         'its child frame is a camera or its IMU (x right, y down): '
         'odom_child_rpy:=[-1.5708,0.0,-1.5708]' if axis == '-y' else
         'its child frame (child_frame_id) is not base_link: set odom_child_rpy to its attitude '
         'on the body, see docs/sensors.md'),
        (down, ERROR, 'images turn the other way round: z of base_link is down',
         'let the odometry source send ENU and FLU (REP-103) instead of NED and FRD; or is the '
         'camera upside down (camera_rpy)?'),
        (lean >= LEAN, WARNING, f'leans {lean:.0f} deg on average',
         'hold the vehicle level; else set the pose of the IMU on the body (odom_child_rpy)'),
        (True, OK, f'leans {lean:.0f} deg on average', ''))
    if down:
        return
    if fit is None:
        yield unmeasured('odom ahead', 'turned too little: turn the vehicle by 30 deg', TURN_MOVES)
        yield unmeasured('camera time offset', 'turned too little', IN_TIME)
        return
    share = f'turning explains {max(fit.configured, 0.0):.0%} of it'
    if not turned or lean < LYING or fit.configured >= EXPLAINED:
        yield first(
            'odom ahead', TURN_MOVES,
            (turned and lean < LYING, ERROR, f'{share}; with other axes {fit.best:.0%}',
             f'check camera_rpy; if that is right, set odom_child_rpy:={rpy}'),
            (fit.configured >= EXPLAINED, OK, share, ''),
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
        (fit.best < EXPLAINED, UNMEASURED, share, ''),
        (abs(fit.offset) <= OFFSET or 1.0 - fit.explained >= SHIFTED * (1.0 - fit.together), OK,
         off, ''),
        (rest > OFFSET, ERROR if rest > BAD_OFFSET else WARNING,
         f'images are stamped {off} {side} than odometry', 'have the driver stamp the middle of '
         f'the exposure, by one clock; else set time_offset:={-fit.offset:.3f} of relative_pose'),
        (True, OK, f'{off} {side}, as time_offset says', ''))


def _focal(fit: AxesFit | None, fisheye: bool) -> Finding:
    """Check the focal length; in a fisheye image the flow changes too much within a part."""
    what, wanted = 'focal length', 'images move as far as it says'
    if fit is None or fisheye or SURE * fit.zoom_deviation > 2.0 * ZOOM:
        return unmeasured(what, 'a fisheye lens' if fisheye else
                          'turned too little: pitch and yaw it by hand', wanted)
    wrong = abs(math.log(max(fit.zoom, 1e-3))) > max(ZOOM, SURE * fit.zoom_deviation)
    return judged(
        wrong, False, what, f'images move {fit.zoom:.2f} ± {fit.zoom_deviation:.2f} times as far',
        wanted, 'is the calibration of this lens, and for this size of images?')


def _fit(seen: Observations, states: list[OdometryState], up: Array | None) -> AxesFit | None:
    try:
        camera = camera_model(seen)
    except ValueError:
        return None
    mounted = seen.value('relative_pose', 'camera_rpy', [0.0, 0.0, 0.0])
    stamps = np.array([state.stamp * 1e-9 for state in states])
    quaternions = np.array([state.quaternion for state in states])
    velocities = np.array([state.velocity.dot(quaternion_to_matrix(state.quaternion))
                           for state in states])

    def velocity(times: Array) -> Array:
        return np.column_stack([np.interp(times, stamps, column) for column in velocities.T])
    return fit_axes(seen.shifts, interpolated(stamps, quaternions), velocity, camera,
                    quaternion_to_matrix(quaternion_from_rpy(*mounted)) @ R_FLU_OPTICAL, up)


def _against_autopilot(seen: Observations, motion: OwnMotion) -> Iterator[Finding]:
    """Check that odometry and autopilot agree about east and up."""
    if len(seen.autopilot) < 3:
        return
    stamps, quaternions = zip(*seen.autopilot)
    others, known = interpolated(np.array(stamps), np.array(quaternions))(
        np.array([state.stamp * 1e-9 for state in motion.states]))
    pairs = [(state.quaternion, other)
             for state, other, there in zip(motion.states, others, known) if there]
    if not pairs:
        return
    yaws = [wrap_angle(yaw_from_quaternion(own) - yaw_from_quaternion(other))
            for own, other in pairs]
    yaw = math.atan2(float(np.mean(np.sin(yaws))), float(np.mean(np.cos(yaws))))
    yield judged(abs(yaw) > YAWS[1], abs(yaw) > YAWS[0], 'odom and autopilot',
                 f'yaws differ by {math.degrees(yaw):+.0f} deg',
                 f'within {math.degrees(YAWS[0]):.0f} deg',
                 'have the autopilot fuse this odometry (forward_odometry:=true), or start it '
                 'facing as it does' if abs(yaw) > YAWS[1] else
                 'a compass near iron? Above 20 deg the bridge refuses to fly')
    ups = [float(quaternion_to_matrix(own)[2].dot(quaternion_to_matrix(other)[2]))
           for own, other in pairs]
    lean = math.degrees(math.acos(min(1.0, max(-1.0, float(np.median(ups))))))
    if lean > LEAN:
        yield error('odom and autopilot', f'lean differently by {lean:.0f} deg', 'the same',
                    'the pose of the IMU on the body (odom_child_rpy), or that of the autopilot, '
                    'is wrong')

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

"""The odometry: twist, axes, what it lacks, jumps; and whether the autopilot says the same."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Final

import numpy as np

from flock_follower.checks.axes import check_axes, LEAN
from flock_follower.checks.findings import error, Finding, ok, unmeasured, warning
from flock_follower.checks.image_motion import interpolated
from flock_follower.checks.marker_size import check_marker_size
from flock_follower.checks.observations import Observations, odometry_message, OwnMotion
from flock_follower.geometry import (
    quaternion_to_matrix,
    Transform,
    wrap_angle,
    yaw_from_quaternion,
)
from flock_follower.messages import to_nanoseconds
from flock_follower.odometry.derivation import CHILD, NONE, ODOM
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters.spec import filled, NAMES

#: Difference between the yaws of odometry and autopilot, rad: told from; the bridge refuses above.
YAWS: Final = (0.12, 0.35)
#: Share of the messages that say nothing, above which nobody can fly by the rest.
LOST: Final = 0.02


def read(seen: Observations, params: SourceParams) -> OwnMotion:
    """Read the odometry of a running system: how is known once its nodes have answered."""
    motion = OwnMotion(OdometrySource(params))
    if seen.static_child and not any(params.child_position) and not any(params.child_rpy):
        motion.source.place_child(
            Transform.from_quaternion(seen.static_child[:3], seen.static_child[3:]))
    frame, child = seen.frames[-1]
    for row in seen.odometry:
        motion.take(odometry_message(row, frame, child), to_nanoseconds(row[0]))
    return motion


def check_own_motion(seen: Observations) -> Iterator[Finding]:
    """Yield what is to be said of the odometry."""
    if not seen.frames or not (seen.odometry or seen.own):
        return
    try:
        params = filled(SourceParams(), seen.parameters['relative_pose'], 'odom_')
    except (KeyError, ValueError):
        params = SourceParams()
    motion = seen.own or read(seen, params)
    if motion.lost:
        count = motion.lost + len(motion.states)
        say = error if motion.lost > LOST * count else warning
        yield say('odom', f'{motion.lost} of {count} say nothing: {motion.why}',
                  'position and attitude', 'wait until its source is initialised; more texture, '
                  'light; rtabmap: publish_null_when_lost:=false')
    if len(motion.states) < 3:
        return
    yield from _parameters_alike(seen)
    yield _frames(seen)
    yield from _survived(motion)
    yield _twist(motion)
    yield from _lacking(motion)
    yield from check_axes(seen, motion.states, motion.source.period, params)
    yield from check_marker_size(seen, motion.states)
    yield from _against_autopilot(seen, motion)


def _parameters_alike(seen: Observations) -> Iterator[Finding]:
    """Yield parameters of the odometry that our nodes do not have alike."""
    of_cameras = sorted({name for own in seen.parameters.values() for name in own
                         if name == NAMES or name.startswith('camera.')})
    for name in ('odom_child_position', 'odom_child_rpy', 'odom_twist_frame', 'odom_std',
                 *of_cameras):
        told = {node: own[name] for node, own in seen.parameters.items() if name in own}
        if len({str(value) for value in told.values()}) > 1:
            shown = ', '.join(f'{value} in {node}' for node, value in told.items())
            yield error(name, shown, 'the same in every node', 'set it under /** in one file')
    rpy = {node: seen.parameters[node]['camera_rpy'] for node in ('relative_pose', 'planner')
           if 'camera_rpy' in seen.parameters.get(node, {})}
    if len({str(value) for value in rpy.values()}) > 1:
        yield error('camera_rpy', ', '.join(f'{v} in {node}' for node, v in rpy.items()),
                    'the same in relative_pose and planner', 'set both')


def _frames(seen: Observations) -> Finding:
    what, wanted = 'odom frames', 'one pair, both named'
    header, child = seen.frames[-1]
    told = f'{header or "(none)"} to {child or "(none)"}'
    if len(seen.frames) > 1:
        return error(what, f'changed {len(seen.frames) - 1} times, now {told}', wanted,
                     'is it published by two sources? Every change starts perception anew')
    if not header:
        return warning(what, told, wanted, 'have its source fill header.frame_id')
    return ok(what, told, wanted)


def _survived(motion: OwnMotion) -> Iterator[Finding]:
    jumps = motion.events['odom jumped']
    if jumps:
        yield warning('odom jumps', f'{jumps} in {len(motion.states)} messages', 'none',
                      'turn off loop closure and relocalisation, or take the frame without them')
    if back := motion.events['odom stamp jumped back']:
        yield warning('odom stamps', f'jumped back {back} times', 'each later than before',
                      'is an old bag played into it, or is its clock set?')


def _twist(motion: OwnMotion) -> Finding:
    twist = motion.source.twist
    what, wanted = 'odom velocity', 'as its positions move'
    if 'velocity' in motion.source.missing:
        return warning(what, 'none (not finite)', wanted,
                       'works: derived from the positions, which is noisier')
    if twist.wanted in (CHILD, ODOM) and twist.found not in ('', twist.wanted):
        return error(what, f'read in {twist.wanted}, the positions say {twist.found}', wanted,
                     'set odom_twist_frame:=auto')
    if twist.found == NONE:
        return warning(what, f'off by {twist.contradiction:.2f} m/s, however it is read', wanted,
                       'works: derived from the positions, which is noisier; look at the source')
    if twist.wanted == NONE:
        return ok(what, 'odom_twist_frame is none: derived from the positions', wanted)
    if not twist.found:
        return unmeasured(what, 'moved too little', wanted)
    return ok(what, f'in the {twist.found} frame', wanted)


def _lacking(motion: OwnMotion) -> Iterator[Finding]:
    missing = motion.source.missing
    what = 'odom angular rate'
    rates = np.array([state.angular_velocity for state in motion.states])
    if 'angular velocity' in missing:
        yield warning(what, 'always zero', 'that of the gyroscope',
                      'works: derived from the attitudes, which is noisier; have it sent if its '
                      'source can')
    else:
        yield ok(what, f'up to {math.degrees(float(np.abs(rates).max())):.0f} deg/s',
                 'that of the gyroscope')
    lacking = sorted(name for name in missing if 'covariance' in name)
    if lacking:
        parts = sorted({name.rsplit(' ', 1)[-1] for name in lacking})
        yield warning('odom covariances', f'none, or not all, of {" and ".join(parts)}',
                      'those of its filter',
                      'works: odom_std stands in; set that to what your odometry errs by')
    else:
        yield ok('odom covariances', 'there', 'those of its filter')


def _against_autopilot(seen: Observations, motion: OwnMotion) -> Iterator[Finding]:
    """Yield whether odometry and autopilot agree which way is east, and up."""
    if len(seen.autopilot) < 3:
        return
    theirs = interpolated(np.array([row[1] for row in seen.autopilot]),
                          np.array([row[5:9] for row in seen.autopilot]))
    yaws, leans = [], []
    others, known = theirs(np.array([state.stamp * 1e-9 for state in motion.states]))
    for state, other, there in zip(motion.states, others, known):
        if there:
            yaws.append(wrap_angle(yaw_from_quaternion(state.quaternion)
                                   - yaw_from_quaternion(other)))
            ups = quaternion_to_matrix(state.quaternion)[2], quaternion_to_matrix(other)[2]
            leans.append(math.acos(min(1.0, max(-1.0, float(ups[0].dot(ups[1]))))))
    if not yaws:
        return
    yaw = math.atan2(float(np.mean(np.sin(yaws))), float(np.mean(np.cos(yaws))))
    told, wanted = f'{math.degrees(yaw):+.0f} deg', f'within {math.degrees(YAWS[0]):.0f} deg'
    if abs(yaw) > YAWS[1]:
        yield error('odom and autopilot', f'yaws differ by {told}', wanted, 'have the autopilot '
                    'fuse this odometry (forward_odometry:=true), or start it facing as it does')
    elif abs(yaw) > YAWS[0]:
        yield warning('odom and autopilot', f'yaws differ by {told}', wanted,
                      'a compass near iron? Above 20 deg the bridge refuses to fly')
    else:
        yield ok('odom and autopilot', f'yaws differ by {told}', wanted)
    if (lean := math.degrees(float(np.median(leans)))) > LEAN:
        yield error('odom and autopilot', f'lean differently by {lean:.0f} deg', 'the same',
                    'the pose of the IMU on the body (odom_child_rpy), or that of the autopilot, '
                    'is wrong')

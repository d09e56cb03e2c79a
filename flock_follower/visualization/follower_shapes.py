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
What is drawn of a follower: itself, its neighbours, the band, the command, what its camera sees.

Everything is in the frame of the odometry (ENU). A neighbour out of sight is drawn where a
constant velocity would have brought it, with an ellipsoid that grows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, Transform
from flock_follower.messages import Command, NANOSECONDS, OdometryState
from flock_follower.planner.limits import COHESION, REASONS, SEPARATION
from flock_follower.visualization.shapes import (
    ARROW,
    arrow,
    circle,
    Color,
    CUBE,
    DEGENERATE,
    ellipsoid,
    frustum,
    lines,
    Shape,
    text,
)

DEVIATIONS = 2.0  # of the ellipsoids
VELOCITY_TIME = 1.0  # s: an arrow of velocity ends where it leads in this time
ACCELERATION_SCALE = 0.5  # m of arrow per m/s^2
SIGHT_DEPTH = 1.5  # m to which the field of view is drawn
UNSEEN = 0.25  # s without an image of it after which a neighbour is drawn as out of sight
PREDICTED = 2.0  # s for which it is carried on: as long as the planner coasts by default
FORGOTTEN = 10.0  # s after which it is drawn no more
SILENT = 0.5  # s after which a command is drawn no more
WIDEST = 1.4  # rad off the axis: beyond it a fisheye lens is drawn as if it ended

ABOVE: Array = np.array([0.0, 0.0, 0.3])  # m: where words stand
BODY_SIZE = (0.35, 0.35, 0.1)
NEIGHBOR: Color = (0.2, 0.5, 1.0, 0.9)
GHOST: Color = (0.6, 0.6, 0.6, 0.4)
ELLIPSOID: Color = (0.2, 0.5, 1.0, 0.25)
EDGE: Color = (1.0, 1.0, 1.0, 0.6)
SEEN: Color = (0.9, 0.9, 0.3, 0.6)
INNER: Color = (0.95, 0.3, 0.2, 0.7)
OUTER: Color = (0.2, 0.8, 0.9, 0.7)
COMMAND: Color = (0.3, 0.9, 0.3, 1.0)
GUARDED: Color = (1.0, 0.55, 0.0, 1.0)
STATES: Mapping[str, Color] = {
    'TRACK': (0.3, 0.9, 0.3, 0.9), 'COAST': (0.95, 0.85, 0.2, 0.9),
    'SEARCH': (1.0, 0.55, 0.0, 0.9), 'HOLD': (1.0, 0.3, 0.2, 0.9)}
IDLE: Color = (0.7, 0.7, 0.7, 0.9)


class CameraSight(NamedTuple):
    """A camera: where it is on the body, optical, and the corners of what it sees."""

    T_body_optical: Transform
    corners: Array
    """(4, 3), m, in the optical frame, in order round the image."""


class Band(NamedTuple):
    """Between which distances the follower is kept: squared, m^2; its own radius, m."""

    d0: float
    d1: float
    radius: float = 0.0


class PlannerReport(NamedTuple):
    """What the planner tells of a tick."""

    state: str = ''
    reason: str = ''
    limits: str = ''
    """The limits and the guard's reasons that bound its command."""
    edges: tuple[str, ...] = ()
    """Whom it attends to."""

    @property
    def guarded(self) -> tuple[str, ...]:
        """Return the guard's reasons among the limits."""
        return tuple(reason for reason in REASONS if reason in self.limits)


class Snapshot(NamedTuple):
    """All that is known at a moment, ns; poses and velocities in the frame of the odometry."""

    now: int
    own: tuple[int, Transform] | None = None
    """Stamp, ns, and ``T_odom_base``."""
    neighbors: Sequence[OdometryState] = ()
    """The newest state of each."""
    command: Command | None = None
    planner: PlannerReport = PlannerReport()
    band: Band | None = None
    cameras: Mapping[str, CameraSight] = {}


def image_corners(width: int, height: int, k: ArrayLike, fisheye: bool = False) -> Array:
    """
    Return where the corners of an image look, (4, 3) in the optical frame, ``SIGHT_DEPTH`` away.

    Without the distortion of a lens that is no fisheye: it moves corners by a few percent.

    :param k: the matrix K of its CameraInfo, (9,).
    :raises ValueError: where it is no calibration.
    """
    fx, _, cx, _, fy, cy, *_ = np.asarray(k, dtype=float).ravel().tolist()
    if not (fx > 0.0 and fy > 0.0 and width > 0 and height > 0):
        raise ValueError(f'camera_info: fx = {fx:g}, fy = {fy:g}, {width} x {height} pixels: '
                         'must all be above 0')
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
    away = (pixels - (cx, cy)) / (fx, fy)
    if not fisheye:
        return SIGHT_DEPTH * np.column_stack([away, np.ones(4)])
    angle = np.hypot(*away.T)
    seen = np.minimum(angle, WIDEST)[:, None]
    return SIGHT_DEPTH * np.column_stack([
        np.sin(seen) * away / np.maximum(angle, 1e-9)[:, None], np.cos(seen)])


def shapes(known: Snapshot) -> list[Shape]:
    """Return what to draw at a moment."""
    drawn: list[Shape] = []
    for state in known.neighbors:
        drawn += _neighbor(state, known)
    if known.own is not None:
        drawn += _own(known.own[1], known)
    return [shape for shape in drawn if shape.kind != ARROW
            or math.dist(*shape.points.tolist()) > DEGENERATE]


def place(state: OdometryState, now: int) -> Array:
    """Return where a neighbour is at a time, ns, if it flies on: (3,), m."""
    return state.position + _ahead(state, now) * state.velocity


def _age(state: OdometryState, now: int) -> float:
    return (now - state.stamp) / NANOSECONDS


def _ahead(state: OdometryState, now: int) -> float:
    """Return for how long, s, a neighbour is carried on."""
    return min(max(_age(state, now), 0.0), PREDICTED)


def _neighbor(state: OdometryState, known: Snapshot) -> list[Shape]:
    """Return a neighbour, its velocity and how well it is known, and the band about it."""
    age, name = _age(state, known.now), state.child
    if age > FORGOTTEN:
        return []
    at = place(state, known.now)
    covariance = state.pose_covariance[:3, :3] + (
        _ahead(state, known.now)**2 * state.velocity_covariance)
    drawn = [Shape(name, CUBE, NEIGHBOR, BODY_SIZE, at, state.quaternion),
             arrow(f'{name} velocity', at, VELOCITY_TIME * state.velocity, NEIGHBOR)]
    if np.all(np.isfinite(covariance)):
        drawn.append(ellipsoid(f'{name} covariance', at, covariance, DEVIATIONS, ELLIPSOID))
    label = name
    if age > UNSEEN:
        label = f'{name}, not seen for {age:.1f} s'
        drawn += [Shape(f'{name} last seen', CUBE, GHOST, BODY_SIZE, state.position,
                        state.quaternion),
                  lines(f'{name} predicted', [state.position, at], GHOST)]
    drawn.append(text(f'{name} name', at + ABOVE, label, NEIGHBOR))
    if known.band is not None and (name in known.planner.edges or len(known.neighbors) == 1):
        drawn += _band(name, at, known.band, known.planner.guarded)
    return drawn


def _band(name: str, centre: Array, band: Band, guarded: Sequence[str]) -> list[Shape]:
    """Return the circles that the follower is kept between, the one that the guard holds thick."""
    return [circle(f'{name} {edge}', centre, math.sqrt(squared) + band.radius, color,
                   0.05 if reason in guarded else 0.015)
            for edge, squared, color, reason in (
                ('d0', band.d0, INNER, SEPARATION), ('d1', band.d1, OUTER, COHESION))]


def _own(T_odom_base: Transform, known: Snapshot) -> list[Shape]:
    """Return the follower, its command, the edges of its graph and what its cameras see."""
    report, at = known.planner, T_odom_base.translation
    color = STATES.get(report.state, IDLE)
    drawn = [Shape('base_link', CUBE, color, BODY_SIZE, at, T_odom_base.quaternion)]
    if known.command is not None and known.command.ages(known.now)[0] <= SILENT:
        drawn.append(arrow(
            'command', at, ACCELERATION_SCALE * np.asarray(known.command.acceleration, float),
            GUARDED if report.guarded else COMMAND))
    told = [report.state or 'no planner', *(f'guard: {reason}' for reason in report.guarded)]
    if report.state not in ('', 'TRACK'):
        told.append(report.reason)
    drawn.append(text('state', at + ABOVE, '\n'.join(filter(None, told)), color))
    edges = [end for state in known.neighbors if state.child in report.edges
             for end in (at, place(state, known.now))]
    if edges:
        drawn.append(lines('edges', edges, EDGE))
    for name, camera in known.cameras.items():
        T_odom_optical = T_odom_base @ camera.T_body_optical
        drawn.append(frustum(' '.join(filter(None, ['sight', name])), T_odom_optical.translation,
                             T_odom_optical.apply(camera.corners), SEEN))
    return drawn

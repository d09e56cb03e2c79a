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
The flight in space as plain values: shapes for RViz, Foxglove and others.

Everything is in the frame of the odometry (ENU), lengths in m. A neighbour out of sight is drawn
where a constant velocity would have brought it, with an ellipsoid that grows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, IDENTITY_QUATERNION, matrix_to_quaternion, Transform
from flock_follower.messages import Command, NANOSECONDS, OdometryState
from flock_follower.planner.limits import COHESION, REASONS, SEPARATION

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each in [0, 1]."""

ARROW, CUBE, SPHERE, LINE_STRIP, LINE_LIST, TEXT = (
    'ARROW', 'CUBE', 'SPHERE', 'LINE_STRIP', 'LINE_LIST', 'TEXT_VIEW_FACING')
DEGENERATE = 1e-3  # m: nothing is drawn shorter than this, viewers refuse sizes of zero

DEVIATIONS = 2.0  # of the ellipsoids
VELOCITY_TIME = 1.0  # s: an arrow of velocity ends where it leads in this time
ACCELERATION_SCALE = 0.5  # m of arrow per m/s^2
SIGHT_DEPTH = 1.5  # m to which the field of view is drawn
UNSEEN = 0.25  # s without an image of it after which a neighbour is drawn as out of sight
PREDICTED = 2.0  # s of prediction at most: the time for which the planner coasts by default
FORGOTTEN = 10.0  # s after which it is drawn no more
SILENT = 0.5  # s after which a command is drawn no more
WIDEST = 1.4  # rad off the axis: beyond it a fisheye lens is drawn as if it ended

ABOVE: Array = np.array([0.0, 0.0, 0.3])  # m: the place of a label
BODY_SIZE = (0.35, 0.35, 0.1)
NEIGHBOR, GHOST, ELLIPSOID = (0.2, 0.5, 1.0, 0.9), (0.6, 0.6, 0.6, 0.4), (0.2, 0.5, 1.0, 0.25)
EDGE, SIGHT = (1.0, 1.0, 1.0, 0.6), (0.9, 0.9, 0.3, 0.6)
INNER, OUTER = (0.95, 0.3, 0.2, 0.7), (0.2, 0.8, 0.9, 0.7)
COMMAND, GUARDED = (0.3, 0.9, 0.3, 1.0), (1.0, 0.55, 0.0, 1.0)
IDLE = (0.7, 0.7, 0.7, 0.9)
STATES: Mapping[str, Color] = {
    'TRACK': (0.3, 0.9, 0.3, 0.9), 'COAST': (0.95, 0.85, 0.2, 0.9),
    'SEARCH': (1.0, 0.55, 0.0, 0.9), 'HOLD': (1.0, 0.3, 0.2, 0.9),
    'RELATIVE': (0.8, 0.3, 0.9, 0.9)}


class Shape(NamedTuple):
    """One shape; it replaces the shape of the same ``name`` that was drawn before."""

    name: str
    kind: str
    """The name of a constant of ``visualization_msgs/Marker``."""
    color: Color
    size: tuple[float, float, float]
    """Lengths along the axes; the first is the width of lines, the last the height of text."""
    position: Array = np.zeros(3)
    quaternion: Array = IDENTITY_QUATERNION
    points: Array = np.zeros((0, 3))
    """Points of lines and arrows (n, 3); then position and quaternion are not used."""
    text: str = ''


def arrow(name: str, start: Array, along: Array, color: Color, width: float = 0.04) -> Shape:
    """Return an arrow from a place (3,) along a vector (3,)."""
    return Shape(name, ARROW, color, (width, 2.0 * width, 2.5 * width),
                 points=np.stack([start, start + along]))


def lines(name: str, points: ArrayLike, color: Color, width: float = 0.02) -> Shape:
    """Return lines between points (n, 3): first and second, third and fourth, and so on."""
    return Shape(name, LINE_LIST, color, (width, 0.0, 0.0),
                 points=np.asarray(points, dtype=float).reshape(-1, 3))


def circle(name: str, centre: Array, radius: float, color: Color, width: float) -> Shape:
    """Return a level circle about a place (3,)."""
    angle = np.linspace(0.0, math.tau, 49)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return Shape(name, LINE_STRIP, color, (width, 0.0, 0.0), points=centre + radius * ring)


def ellipsoid(name: str, centre: Array, covariance: Array, deviations: float,
              color: Color) -> Shape:
    """Return the ellipsoid of a finite covariance (3, 3), m^2, at ``deviations`` sigma."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:  # a mirror is no rotation
        axes[:, 0] = -axes[:, 0]
    x, y, z = np.maximum(
        2.0 * deviations * np.sqrt(np.maximum(variances, 0.0)), DEGENERATE).tolist()
    return Shape(name, SPHERE, color, (x, y, z), centre, matrix_to_quaternion(axes))


def text(name: str, position: Array, label: str, color: Color) -> Shape:
    """Return text that faces the viewer."""
    return Shape(name, TEXT, color, (0.0, 0.0, 0.15), position, text=label)


def frustum(name: str, apex: Array, corners: Sequence[Array] | Array, color: Color) -> Shape:
    """Return the edges of a pyramid whose base has four corners (4, 3) in order."""
    return lines(name, [point for k in range(4) for point in (
        apex, corners[k], corners[k], corners[(k + 1) % 4])], color, 0.01)


class CameraSight(NamedTuple):
    """The pose of a camera on the body, and the corners of its field of view."""

    T_body_optical: Transform
    corners: Array
    """(4, 3), m, in the optical frame, in order round the image."""


class Band(NamedTuple):
    """The bounds of the distance, squared, m^2; the radius of the follower, m."""

    d0: float
    d1: float
    radius: float = 0.0


class PlannerReport(NamedTuple):
    """The diagnostics of one tick of the planner."""

    state: str = ''
    reason: str = ''
    limits: str = ''
    """The limits and the guard's reasons that bound its command."""
    edges: tuple[str, ...] = ()
    """Names of the neighbours in its graph."""

    @property
    def guarded(self) -> tuple[str, ...]:
        """Return the guard's reasons among the limits."""
        return tuple(reason for reason in REASONS if reason in self.limits)


class Snapshot(NamedTuple):
    """The flight at a time, ns; poses and velocities in the frame of the odometry."""

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
    Return the corners of the field of view, (4, 3) in the optical frame, at ``SIGHT_DEPTH``.

    The distortion of a lens that is no fisheye is left out: it moves corners by a few percent.

    :param k: the matrix K of its CameraInfo, (9,).
    :raises ValueError: if the calibration is invalid.
    """
    fx, _, cx, _, fy, cy, *_ = np.asarray(k, dtype=float).ravel().tolist()
    if not (fx > 0.0 and fy > 0.0 and width > 0 and height > 0):
        raise ValueError(f'camera_info: fx = {fx:g}, fy = {fy:g}, {width} x {height} pixels: '
                         'must all be above 0')
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
    rays = (pixels - (cx, cy)) / (fx, fy)
    if not fisheye:
        return SIGHT_DEPTH * np.column_stack([rays, np.ones(4)])
    angle = np.hypot(*rays.T)
    seen = np.minimum(angle, WIDEST)[:, None]
    return SIGHT_DEPTH * np.column_stack([
        np.sin(seen) * rays / np.maximum(angle, 1e-9)[:, None], np.cos(seen)])


def shapes(known: Snapshot) -> list[Shape]:
    """Return the shapes to draw."""
    drawn: list[Shape] = []
    for state in known.neighbors:
        drawn += _neighbor(state, known)
    if known.own is not None:
        drawn += _own(known.own[1], known)
    return [shape for shape in drawn if shape.kind != ARROW
            or math.dist(*shape.points.tolist()) > DEGENERATE]


def _predicted(state: OdometryState, now: int) -> tuple[Array, float, float]:
    """Return the position (3,), m, at constant velocity; the time predicted and the age, s."""
    age = (now - state.stamp) / NANOSECONDS
    ahead = min(max(age, 0.0), PREDICTED)
    return state.position + ahead * state.velocity, ahead, age


def _neighbor(state: OdometryState, known: Snapshot) -> list[Shape]:
    """Return a neighbour, its velocity, the ellipsoid of its position, and the band about it."""
    (at, ahead, age), name = _predicted(state, known.now), state.child
    if age > FORGOTTEN:
        return []
    covariance = state.pose_covariance[:3, :3] + ahead**2 * state.velocity_covariance
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
    band, report = known.band, known.planner
    if band is not None and (name in report.edges or len(known.neighbors) == 1):
        # A thick circle: the guard acts there.
        drawn += [circle(f'{name} {edge}', at, math.sqrt(squared) + band.radius, color,
                         0.05 if reason in report.guarded else 0.015)
                  for edge, squared, color, reason in (
                      ('d0', band.d0, INNER, SEPARATION), ('d1', band.d1, OUTER, COHESION))]
    return drawn


def _own(T_odom_base: Transform, known: Snapshot) -> list[Shape]:
    """Return the follower, its command, the edges of its graph and the fields of view."""
    report, at = known.planner, T_odom_base.translation
    color = STATES.get(report.state, IDLE)
    drawn = [Shape('base_link', CUBE, color, BODY_SIZE, at, T_odom_base.quaternion)]
    if known.command is not None and known.command.ages(known.now)[0] <= SILENT:
        drawn.append(arrow(
            'command', at, ACCELERATION_SCALE * np.asarray(known.command.acceleration, float),
            GUARDED if report.guarded else COMMAND))
    label = [report.state or 'no planner', *(f'guard: {reason}' for reason in report.guarded)]
    if report.state not in ('', 'TRACK'):
        label.append(report.reason)
    drawn.append(text('state', at + ABOVE, '\n'.join(filter(None, label)), color))
    edges = [end for state in known.neighbors if state.child in report.edges
             for end in (at, _predicted(state, known.now)[0])]
    if edges:
        drawn.append(lines('edges', edges, EDGE))
    for name, camera in known.cameras.items():
        T_odom_optical = T_odom_base @ camera.T_body_optical
        drawn.append(frustum(' '.join(filter(None, ['sight', name])), T_odom_optical.translation,
                             T_odom_optical.apply(camera.corners), SIGHT))
    return drawn

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
A flight as shapes in the frame of the odometry: for RViz, Foxglove, and the live page.

The shapes are the follower with its state and command, and each neighbor with its velocity, the
ellipsoid of its position, and the planner's band about it. ``visualizer`` publishes the shapes;
the page draws the same shapes from above and into the image.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, IDENTITY_QUATERNION, matrix_to_quaternion
from flock_follower.messages import OdometryState, SANE
from flock_follower.messages.commands import Command
from flock_follower.planner.bound_keeping import COHESION, REASONS, SEPARATION

#: Kinds of shapes.
BOX, ARROW, LINE, ELLIPSOID, TEXT = 'box', 'arrow', 'line', 'ellipsoid', 'text'
MIN_LENGTH = 1e-3  # m: the shortest length drawn, viewers refuse sizes of zero
DEVIATIONS = 2.0  # of the ellipsoids
VELOCITY_TIME = 1.0  # s: an arrow of velocity ends where it leads in this time
ACCELERATION_SCALE = 0.5  # m of arrow per m/s^2
UNSEEN_AFTER = 0.25  # s without an image of it after which a neighbor is drawn in gray
FORGOTTEN_AFTER = 10.0  # s after which it is drawn no more
SILENT = 0.5  # s after which a command is drawn no more
LABEL_OFFSET: Final = np.array([0.0, 0.0, 0.3])  # m: the place of a label
BODY_SIZE = (0.35, 0.35, 0.1)  # m
TEXT_SIZE = (0.0, 0.0, 0.15)  # m: the height
ARROW_SIZE = (0.04, 0.08, 0.1)  # m: width of the shaft, width and length of the head
LINE_WIDTH = 0.02  # m
EDGE_WIDTH = 0.015  # m: of an edge of the band
ACTIVE_WIDTH = 0.05  # m: of the one that the guard holds
#: A level circle of radius 1 m, (49, 3).
RING: Final = np.array([[math.cos(a), math.sin(a), 0.0] for a in np.linspace(0.0, math.tau, 49)])

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each in [0, 1]."""

#: The colors by the paint of a shape; states of the planner are paints, too.
COLORS: Final[Mapping[str, Color]] = {
    'seen': (0.2, 0.5, 1.0, 0.9), 'gray': (0.7, 0.7, 0.7, 0.9),
    'ellipsoid': (0.2, 0.5, 1.0, 0.25), 'edge': (1.0, 1.0, 1.0, 0.6),
    'inner': (0.95, 0.3, 0.2, 0.7), 'outer': (0.2, 0.8, 0.9, 0.7),
    'command': (0.3, 0.9, 0.3, 1.0), 'guarded': (1.0, 0.55, 0.0, 1.0),
    'TRACK': (0.3, 0.9, 0.3, 0.9), 'COAST': (0.95, 0.85, 0.2, 0.9),
    'SEARCH': (1.0, 0.55, 0.0, 0.9), 'HOLD': (1.0, 0.3, 0.2, 0.9),
    'RELATIVE': (0.8, 0.3, 0.9, 0.9)}


class Shape(NamedTuple):
    """One shape; its name is unique within a scene."""

    name: str
    kind: str
    paint: str
    """A key of ``COLORS``."""
    size: tuple[float, ...]
    """(3,), m: lengths along the axes; of lines the first is the width, of text the last the
    height; of arrows as ``ARROW_SIZE``."""
    position: ArrayLike = (0.0, 0.0, 0.0)
    """(3,), m; of lines and arrows zeros."""
    quaternion: Array = IDENTITY_QUATERNION
    points: ArrayLike = ()
    """Of lines and arrows (n, 3), m."""
    text: str = ''


def draw(own: OdometryState | None, neighbors: Iterable[tuple[OdometryState, float]],
         command: tuple[Command, float] | None, report: Mapping[str, str]) -> list[Shape]:
    """
    Return the shapes of a flight.

    :param neighbors: each with the time since it was seen, s.
    :param command: the newest command with its age, s.
    :param report: the planner's newest values on ``/diagnostics``; empty if there are none.
    """
    shapes: list[Shape] = []
    for state, age in neighbors:
        shapes += _neighbor(own, state, age, report)
    if own is not None:
        shapes += _follower(own, command, report)
    return shapes


def guard_reasons(report: Mapping[str, str]) -> list[str]:
    """Return the guard's reasons among the limits of the planner's command."""
    return [reason for reason in REASONS if reason in report.get('limits', '')]


def band(report: Mapping[str, str]) -> tuple[float, float] | None:
    """Return the planner's band about the hull of a neighbor, m; None if it is unknown."""
    try:
        near, far = float(report['nearest_m']), float(report['farthest_m'])
    except (KeyError, ValueError):
        return None
    return (near, far) if 0.0 < near < far < math.inf else None


def _neighbor(own: OdometryState | None, state: OdometryState, age: float,
              report: Mapping[str, str]) -> list[Shape]:
    """Return a neighbor, its velocity, ellipsoid, edge of the graph, and band."""
    name, at, velocity = state.child, state.position, VELOCITY_TIME * state.velocity
    if age > FORGOTTEN_AFTER:
        return []
    paint, label = ('seen', name) if age <= UNSEEN_AFTER else (
        'gray', f'{name}, not seen for {age:.1f} s')
    shapes = [Shape(name, BOX, paint, BODY_SIZE, at, state.quaternion),
              Shape(f'{name} name', TEXT, paint, TEXT_SIZE, at + LABEL_OFFSET, text=label)]
    if np.linalg.norm(velocity) > MIN_LENGTH:
        shapes.append(Shape(f'{name} velocity', ARROW, paint, ARROW_SIZE,
                            points=[at, at + velocity]))
    if np.all(np.abs(state.pose_covariance[:3, :3]) <= SANE):  # NaN fails
        shapes.append(ellipsoid(f'{name} covariance', at, state.pose_covariance[:3, :3]))
    if name not in report.get('edges', '').split(', '):
        return shapes
    if own is not None:
        shapes.append(Shape(f'{name} edge', LINE, 'edge', (LINE_WIDTH, 0.0, 0.0),
                            points=[own.position, at]))
    active = guard_reasons(report)
    return shapes + [
        Shape(f'{name} {key}', LINE, paint,
              (ACTIVE_WIDTH if reason in active else EDGE_WIDTH, 0.0, 0.0),
              points=at + radius * RING)
        for key, paint, reason, radius in zip(
            ('nearest_m', 'farthest_m'), ('inner', 'outer'), (SEPARATION, COHESION),
            band(report) or ())]


def _follower(own: OdometryState, command: tuple[Command, float] | None,
              report: Mapping[str, str]) -> list[Shape]:
    """Return the follower with its state and its command."""
    active, state = guard_reasons(report), report.get('state', 'no planner')
    paint, at = state if state in COLORS else 'gray', own.position
    label = [state, *(f'guard: {reason}' for reason in active)]
    if state != 'TRACK':
        label.append(report.get('reason', ''))
    shapes = [Shape('follower', BOX, paint, BODY_SIZE, at, own.quaternion),
              Shape('state', TEXT, paint, TEXT_SIZE, at + LABEL_OFFSET,
                    text='\n'.join(filter(None, label)))]
    if command is not None and command[1] <= SILENT:
        tip = at + ACCELERATION_SCALE * np.asarray(command[0].acceleration, float)
        shapes.append(Shape('command', ARROW, 'guarded' if active else 'command', ARROW_SIZE,
                            points=[at, tip]))
    return shapes


def ellipsoid(name: str, center: Array, covariance: Array) -> Shape:
    """Return the ellipsoid of a plausible covariance (3, 3), m^2, at ``DEVIATIONS`` sigma."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:  # a mirror is no rotation
        axes[:, 0] = -axes[:, 0]
    size = np.maximum(2.0 * DEVIATIONS * np.sqrt(np.maximum(variances, 0.0)), MIN_LENGTH)
    return Shape(name, ELLIPSOID, 'ellipsoid', tuple(size.tolist()), center,
                 matrix_to_quaternion(axes))

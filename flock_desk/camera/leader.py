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

"""The leader that the camera sees: boxes, rotor discs and its marker, as config/neighbors.yaml."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, R_FLU_OPTICAL, rotation_vector_to_matrix, Transform
from flock_follower.perception.markers import draw_marker

#: The camera optical frame on the follower's body (FLU).
T_BODY_OPTICAL = Transform(R_FLU_OPTICAL, np.array([0.10, 0.0, 0.0]))
#: The marker on the leader's body (FLU): on the tail, facing backwards.
T_BODY_MARKER = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                          np.array([-0.20, 0.0, 0.0]))
SIDE_LENGTH = 0.16  # m, of the marker
INK, PAPER = 0.03, 0.72
_SQUARE = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


class Face(NamedTuple):
    """A flat convex part of a body, in the frame of that body; all values are reflectances."""

    outline: Array
    """(k, 3), m; of a print from its top left corner clockwise."""
    normal: Array
    """(3,), outwards."""
    middle: Array
    """(3,), m, of the box that it is part of: farther boxes are painted first."""
    value: float = 0.0
    opacity: float = 1.0
    """Below 1 it is seen from both sides."""
    cells: Array | None = None
    """(rows, columns), of a print."""


def box(pose: Transform, size: ArrayLike, value: float) -> list[Face]:
    """Return the faces of a box about its pose's origin, of a size (3,), m."""
    half, faces = np.asarray(size, dtype=float) / 2.0, []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = sign * np.eye(3)[axis]
            outline = np.roll(np.pad(_SQUARE, ((0, 0), (1, 0))), axis, axis=1) + normal
            faces.append(Face(pose.apply(half * outline), pose.rotation @ normal,
                              pose.translation, value))
    return faces


def marker_print(cells: Array, cell: float, middle: Transform = T_BODY_MARKER) -> Face:
    """
    Return a print seen from the z side of its pose.

    :param cells: (rows, columns), 0 black, 1 white; :param cell: size of each, m.
    """
    half = np.array([cells.shape[1], cells.shape[0], 0.0]) * cell / 2.0
    return Face(middle.apply(half * np.pad(_SQUARE, ((0, 0), (0, 1)))), middle.rotation[:, 2],
                middle.translation, cells=INK + (PAPER - INK) * cells)


def board(face: Face, thickness: float = 0.01) -> list[Face]:
    """Return the board, half a cell wider than a print of 8 x 8, that it is stuck on."""
    sides = face.outline[1] - face.outline[0], face.outline[0] - face.outline[3]
    lengths = [float(np.linalg.norm(side)) for side in sides]
    axes = np.stack([*(side / n for side, n in zip(sides, lengths)), face.normal], axis=1)
    return box(Transform(axes, face.middle - 0.6 * thickness * face.normal),
               [*(9 / 8 * n for n in lengths), thickness], 0.60)


def second_print() -> Face:
    """Return marker 0 of DICT_4X4_50 alone, in the body frame of a leader that would carry it."""
    code = draw_marker('DICT_4X4_50', 0, 6) > 127
    return marker_print(np.pad(code, 1, constant_values=True).astype(float), SIDE_LENGTH / 6)


def leader(marker: Face | None = None) -> list[Face]:
    """Return a quadrotor with a marker on its tail, by default marker 0 of DICT_4X4_50."""
    marker = marker or second_print()
    faces = [*box(Transform(), [0.30, 0.11, 0.07], 0.025), *board(marker), marker]
    angle = np.arange(24) * 2 * np.pi / 24
    disc = 0.11 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    for x in (-0.16, 0.16):
        for y in (-0.25, 0.25):
            arm = Transform(rotation_vector_to_matrix([0.0, 0.0, np.arctan2(y, x)]),
                            np.array([0.6 * x, 0.6 * y, 0.0]))
            motor, leg, rotor = (np.array([s * x, s * y, z]) for s, z in (
                (1.0, 0.018), (0.8, -0.05), (1.0, 0.045)))
            faces += [*box(arm, [0.24, 0.018, 0.014], 0.025),
                      *box(Transform(translation=motor), [0.026, 0.026, 0.034], 0.07),
                      *box(Transform(translation=leg), [0.01, 0.01, 0.1], 0.025),
                      Face(disc + rotor, np.array([0.0, 0.0, 1.0]), rotor, 0.06, 0.21)]
    return faces

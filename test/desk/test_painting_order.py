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

"""Painted in order, the last polygon on every line of sight is the nearest one."""

from itertools import pairwise

import numpy as np
import pytest

from flock_desk.camera.painting_order import PaintingOrder


def triangles(count, rng):
    """Return triangles that cross each other, (3, 3) each."""
    return [rng.uniform(-1.0, 1.0, (3, 3)) for _ in range(count)]


def hit(triangle, eye, direction):
    """Return how far along a ray it meets a triangle, or None."""
    a, b, c = triangle
    try:
        distance, u, v = np.linalg.solve(np.stack([direction, a - b, a - c], axis=1), a - eye)
    except np.linalg.LinAlgError:
        return None
    return distance if distance > 0.0 and min(u, v, 1.0 - u - v) > 1e-6 else None


@pytest.mark.parametrize('seed', range(4))
def test_the_nearest_of_crossing_triangles_is_painted_last(seed):
    rng = np.random.default_rng(seed)
    polygons = triangles(12, rng)
    order, compared = PaintingOrder(polygons), 0
    for eye in rng.uniform(-3.0, 3.0, (8, 3)):
        painted = order.order(eye)
        assert sorted(painted) == list(range(len(order.pieces)))
        for aim in rng.uniform(-0.8, 0.8, (40, 3)):
            far = {k: hit(triangle, eye, aim - eye) for k, triangle in enumerate(polygons)}
            seen = {k: distance for k, distance in far.items() if distance is not None}
            fans = [(polygon, [corners[[0, i, i + 1]] for i in range(1, len(corners) - 1)])
                    for polygon, corners in (order.pieces[k] for k in painted)]
            last = [polygon for polygon, fan in fans
                    if any(hit(part, eye, aim - eye) is not None for part in fan)]
            if len(seen) > 1 and last:
                assert last[-1] == min(seen, key=seen.get)
                compared += 1
    assert compared > 50


def test_a_polygon_that_must_stay_whole_does():
    polygons = triangles(12, np.random.default_rng(5))
    for uncut in range(12):
        pieces = [corners for k, corners in PaintingOrder(polygons, uncut).pieces if k == uncut]
        assert len(pieces) == 1
        np.testing.assert_array_equal(pieces[0], polygons[uncut])


def test_pieces_have_the_area_of_what_was_cut():
    polygons = triangles(10, np.random.default_rng(6))

    def area(corners):
        return sum(np.linalg.norm(np.cross(b - corners[0], c - corners[0])) / 2
                   for b, c in pairwise(corners[1:]))

    pieces = PaintingOrder(polygons).pieces
    assert len(pieces) > 15
    for k, polygon in enumerate(polygons):
        whole = sum(area(corners) for of, corners in pieces if of == k)
        assert whole == pytest.approx(area(polygon), rel=1e-6)


def test_nothing_to_paint_is_no_error():
    assert PaintingOrder([]).order(np.zeros(3)) == []

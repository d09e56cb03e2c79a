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

"""Edges that are found, against analytic profiles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.perception import edges
from flock_follower.perception.edges import Found, Lines, SPACING
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import EdgeModel

# Profiles known exactly: stripes whose brightness changes in one direction only.


def smooth_step(x: Array) -> Array:
    return np.array([0.5 * (1.0 + math.erf(value / math.sqrt(2.0))) for value in x.ravel()]
                    ).reshape(x.shape)


def stripes(direction: float, places: list[float], sigma: float, dark: float = 40.0,
            light: float = 200.0) -> GrayImage:
    """Return an image that rises and falls in turn at ``places``, px from its middle, blurred."""
    v, u = np.mgrid[-60.0:61.0, -60.0:61.0]
    x = u * math.cos(direction) + v * math.sin(direction)
    share = sum((-1.0)**k * smooth_step((x - place) / sigma) for k, place in enumerate(places))
    return np.rint(dark + (light - dark) * np.asarray(share)).astype(np.uint8)


def line_across(direction: float, offsets: Array, room: tuple[float, float]) -> Lines:
    """Return lines across stripes, each ``offsets`` px before the middle; one m is one px."""
    n = len(offsets)
    normal = np.array([math.cos(direction), math.sin(direction)])
    tangent = np.array([normal[1], -normal[0]])
    pixels = 60.0 - offsets[:, None] * normal + np.linspace(-30.0, 30.0, n)[:, None] * tangent
    model = EdgeModel(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, dtype=int),
                      np.tile(room, (n, 1)), np.zeros(n, dtype=int), np.zeros(0, dtype=int),
                      np.zeros((1, 3)), np.zeros((1, 3)), ())
    return Lines(model, pixels, np.tile(normal, (n, 1)), np.zeros((n, 8)), np.zeros(3),
                 (1.0, 1.0), np.zeros((0, 2)))


def found_in(image: GrayImage, lines: Lines, spacing: float) -> Found:
    found = edges.find(image, lines, (spacing, spacing))
    assert found is not None
    return found


DIRECTIONS = np.radians([0.0, 90.0, 180.0, 17.0, 45.0, 118.0, 251.0])


@pytest.mark.parametrize(('sigma', 'rms'), [  # below 0.7 px, pixels are too few to tell more
    (0.6, 0.045), (0.7, 0.03), (1.0, 0.02), (1.5, 0.02), (2.0, 0.02)])
def test_an_edge_is_found_to_hundredths_of_a_pixel(sigma: float, rms: float) -> None:
    offsets = np.linspace(-0.9, 0.9, 37)
    spacing = min(max(sigma / 2.0, SPACING[0]), SPACING[1])
    for direction in DIRECTIONS:
        found = found_in(stripes(direction, [0.0], sigma),
                         line_across(direction, offsets, (99.0, 99.0)), spacing)
        assert found.found.all()
        errors = found.offsets - offsets
        assert np.sqrt(np.mean(errors**2)) < rms
        assert abs(np.mean(errors)) < 0.002
        total = math.hypot(sigma, 2.0 * spacing)  # of the kernel, 2 samples
        assert np.sqrt(np.median(found.variance)) == pytest.approx(total, rel=0.2)


@pytest.mark.parametrize('sigma', [0.8, 1.2])
@pytest.mark.parametrize('ratio', [2.6, 3.0, 3.6, 4.5])
@pytest.mark.parametrize('side', ['white', 'black'])
def test_the_push_of_a_neighbouring_edge_is_undone(sigma: float, ratio: float, side: str) -> None:
    spacing = 0.5 * sigma
    total = math.hypot(sigma, 2.0 * spacing)
    cell = ratio * total
    # Rising at 0: then white for a cell and falling, or fallen a cell before.
    if side == 'white':
        image, room = stripes(0.3, [0.0, cell], sigma), (99.0, cell)
    else:
        image, room = 255 - stripes(0.3, [-cell, 0.0], sigma), (cell, 99.0)
    lines = line_across(0.3, np.linspace(-0.5, 0.5, 21), room)
    found = found_in(image, lines, spacing)
    pushed = np.mean(found.offsets - np.linspace(-0.5, 0.5, 21))
    e = math.exp(-0.5 * ratio**2)
    expected = cell * e / (1.0 + (ratio**2 - 1.0) * e)  # away from the neighbour
    assert pushed == pytest.approx(-expected if side == 'white' else expected, abs=0.04)
    corrected, widths = edges.apart(lines, found)
    left = np.mean(corrected.offsets - np.linspace(-0.5, 0.5, 21))
    assert abs(left) < max(0.25 * expected, 0.02)
    assert widths[0] == pytest.approx(total, rel=0.12)
    assert widths[1] == 0.0  # no edges of that axis

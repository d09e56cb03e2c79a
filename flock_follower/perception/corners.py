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
Sub-pixel marker corners: where straight lines along the four outer edges meet.

A detector's own corners follow the thresholded outline and sit 0.5 px inside; corner refinement
by gradients (``cv2.cornerSubPix``) stays 0.2 to 0.4 px inside once the image is blurred, because
blur rounds the corner off. A blurred straight edge keeps its half-brightness point in place, so
edges are located at many points, away from the corners, and intersected: 0.02 to 0.05 px per
axis and no bias, for markers of 30 px and more.

Gamma and over-exposure do move edges: white swells, by 0.1 to 0.5 px where the image is blurred,
and the marker seems farther away. The black border becomes thinner by as much as the
marker becomes smaller, which is more of its width: compared, they tell by how much, see
:func:`bloom`. It takes a distance error of 2 cm at 2 m down to 2 mm.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.perception.images import GrayImage

#: Maps pixels (N, 2) to coordinates (N, 2) in which straight edges are straight, or back.
Mapping = Callable[[Array], Array]

_POINTS = 24  # profiles per edge
_SAMPLES = 21  # per profile, an odd number
_MARGIN = 0.12  # of an edge, left out at either end
_MIN_CONTRAST = 12.0  # grey levels between border and quiet zone
_MIN_SHARE = 0.6  # of an edge's profiles must show the edge
_SIGMA_BLOOM = 0.3  # px, what edges may have moved in common where it was not measured
_SIGMA_BLOOM_MEASURED = 0.05  # px


def refine_corners(image: GrayImage, corners: Array, cells: int,
                   straighten: Mapping | None = None, bend: Mapping | None = None) -> Array | None:
    """
    Return the corners (4, 2) of one marker, or None where its edges cannot be made out.

    :param image: (H, W) uint8.
    :param corners: the detector's (4, 2), px, in order round the marker, good to 2 px.
    :param cells: cells along a side, the black border included (6 for a 4x4 dictionary).
    :param straighten: pixels to undistorted coordinates, where the lens bends straight edges.
    :param bend: the inverse of ``straighten``.
    """
    refined = corners
    for first in (True, False):
        located = _locate_edges(image, refined, cells, first)
        if located is None:
            return None
        points, found = located
        if straighten is not None and bend is not None and not first:
            straight = straighten(points.reshape(-1, 2)).reshape(points.shape)
            found &= np.isfinite(straight[..., 0])
            refined = bend(_intersections(np.nan_to_num(straight), found))
        else:
            refined = _intersections(points, found)
        if not np.all(np.isfinite(refined)):
            return None
    limit = max(3.0, 0.5 * shortest_side(corners) / cells)
    moved = np.linalg.norm(refined - corners, axis=1)
    return refined if np.max(moved) < limit else None


class Bloom(NamedTuple):
    """By how much white has swollen over a marker's top, right, bottom, left edge, (4,), px."""

    shifts: Array
    #: Standard deviation of what the edges still have in common, px.
    sigma: float


def bloom(image: GrayImage, corners: Array, code: Any) -> Bloom:
    """
    Return by how much white has swollen over a marker's edges.

    Opposite edges share a value, because motion blurs upright and level edges differently. With
    c px per cell, n cells a side and white swollen by b, the border is c - 2 b wide and the
    marker n c - 2 b: their ratio gives b. Below 4 px per cell that is measured too coarsely, and
    fades out; what is not measured is 0, with a larger deviation.

    :param corners: refined corners (4, 2), px, on the swollen edges.
    :param code: the marker's cells (n, n), True where white, the black border included.
    """
    cells = len(code)
    unknown = Bloom(np.zeros(4), _SIGMA_BLOOM)
    weight = float(np.clip((shortest_side(corners) / cells - 2.5) / 1.5, 0.0, 1.0))
    # From the quiet zone over the border into the first cell, in steps of 0.4 px or so.
    half = int(np.clip(1.25 * shortest_side(corners) / cells, 5, 24))
    inward = np.arange(-1.5 * half, 3 * half + 1) / (2 * half)
    x = np.arange(1, cells - 1)[:, None] + np.array([0.35, 0.5, 0.65])
    profiles = np.stack([
        _sample(image, _cells_to_pixels(np.roll(corners, -side, axis=0), cells, x.ravel(), inward))
        for side in range(4)])
    white = np.stack([np.repeat(np.rot90(code, side)[1, 1:-1], 3) for side in range(4)])
    if weight == 0.0 or not white.any() or white.all():
        return unknown
    # Black is truly black only where the first cell is, too: blur brightens a single border.
    border = np.flatnonzero((inward > 0.6) & (inward < 1.0))
    dark = np.median(profiles[~white][:, border])
    light = np.median(profiles[:, :, inward < -0.5], axis=(1, 2))[:, None]
    # Blur dims a single white cell: its own brightness decides where its edge is.
    cell_light = profiles[:, :, inward > 1.35].mean(axis=2)
    middle = int(np.flatnonzero(inward >= 0.5)[0])
    outer, outer_found = _rise(profiles[:, :, middle::-1],
                               np.broadcast_to((dark + light) / 2, white.shape))
    inner, inner_found = _rise(profiles[:, :, middle:], (dark + cell_light) / 2)
    found = white & outer_found & inner_found & (cell_light - dark > _MIN_CONTRAST)
    width = (outer + inner) / (2 * half)
    widths = [width[side::2][found[side::2]] for side in (0, 1)]
    swollen = [_swelling(w, cells) for w in widths]
    known = [s for s in swollen if s is not None]
    if not known:
        return unknown
    lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    share = np.array([known[0] if s is None else s for s in swollen * 2])
    # Lengths across the edges: of the neighbouring sides.
    across = 0.5 * (np.roll(lengths, 1) + np.roll(lengths, -1))
    return Bloom(weight * share / (cells - 2.0 * share) * across,
                 weight * _SIGMA_BLOOM_MEASURED + (1.0 - weight) * _SIGMA_BLOOM)


def _swelling(widths: Array, cells: int) -> float | None:
    """Return b / c of border widths, in n-ths of the marker's swollen side."""
    if len(widths) < 6:
        return None
    width = float(np.median(widths))
    swelling = cells * (1.0 - width) / (2.0 * (cells - width))
    return swelling if abs(swelling) < 0.25 else None


def _cells_to_pixels(corners: Array, cells: int, x: Array, y: Array) -> Array:
    """Return pixels (len(x), len(y), 2) of places in a marker, in cells from its first corner."""
    a, b, d, c = corners[0], corners[1], corners[2], corners[3]
    # The projective map of the unit square (Heckbert, 1989).
    g, h = np.linalg.solve(np.stack([b - d, c - d], axis=1), a - b + d - c)
    u, v = np.meshgrid(x / cells, y / cells, indexing='ij')
    pixels: Array = ((b * (1.0 + g) - a) * u[..., None] + (c * (1.0 + h) - a) * v[..., None]
                     + a) / (1.0 + g * u + h * v)[..., None]
    return pixels


def moved_outward(corners: Array, shifts: Array) -> Array:
    """Return corners (4, 2) after every edge moved outwards by its shift, (4,), px."""
    along = np.roll(corners, -1, axis=0) - corners
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normal *= np.sign(np.sum(normal * (corners - corners.mean(axis=0)), axis=1))[:, None]
    # A corner stays on both its edges: normal . move is the shift of each.
    edges = np.stack([np.roll(normal, 1, axis=0), normal], axis=1)
    both = np.stack([np.roll(shifts, 1), shifts], axis=1)
    moved: Array = corners + np.linalg.solve(edges, both[:, :, None])[:, :, 0]
    return moved


def shortest_side(corners: Array) -> float:
    """Return the shortest side of a quadrilateral (4, 2)."""
    return float(np.min(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)))


def _locate_edges(image: GrayImage, corners: Array, cells: int,
                  first: bool) -> tuple[Array, Any] | None:
    """Return edge points (4, n, 2), px, and which of them (4, n) were found."""
    start, end = corners, np.roll(corners, -1, axis=0)
    length = np.linalg.norm(end - start, axis=1)
    if np.min(length) < 6.0:
        return None
    along = (end - start) / length[:, None]
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    outward *= np.sign(np.sum((start + end - 2 * corners.mean(axis=0)) * outward, axis=1))[:, None]
    # Reach half a cell either side: black border within, quiet zone without. Less than 2 px
    # would not span the blur; the first pass allows for the detector's error.
    reach = float(np.clip(0.5 * np.min(length) / cells, 3.0 if first else 2.0, 6.0))
    across = np.linspace(-reach, reach, _SAMPLES)
    fractions = np.linspace(_MARGIN, 1.0 - _MARGIN, _POINTS)
    base = start[:, None] + (fractions * length[:, None])[..., None] * along[:, None]
    profiles = _sample(image, base[:, :, None] + across[:, None] * outward[:, None, None])

    # Brightness either side: medians along the whole edge, so that a spot does not matter.
    fifth = _SAMPLES // 5
    dark = np.median(profiles[:, :, :fifth], axis=(1, 2))
    light = np.median(profiles[:, :, -fifth:], axis=(1, 2))
    if not np.all(light - dark > _MIN_CONTRAST):
        return None
    where, found = _rise(profiles, 0.5 * (dark + light)[:, None])
    offset = across[0] + where * (across[1] - across[0])
    if not np.all(found.mean(axis=1) >= _MIN_SHARE):
        return None
    return base + offset[..., None] * outward[:, None], found


def _rise(profiles: Array, level: Array) -> tuple[Array, Any]:
    """Return where (..., n) samples rise through a level, in samples, and whether they do."""
    count = profiles.shape[-1]
    above = profiles > level[..., None]
    rising = above[..., 1:] & ~above[..., :-1]
    # Where noise crosses more than once, the crossing nearest to the middle counts.
    nearness = count - np.abs(np.arange(count - 1) - (count - 2) / 2.0)
    before = np.argmax(rising * nearness, axis=-1)[..., None]
    low = np.take_along_axis(profiles, before, axis=-1)[..., 0]
    high = np.take_along_axis(profiles, before + 1, axis=-1)[..., 0]
    part = (level - low) / np.where(high > low, high - low, 1.0)
    return before[..., 0] + part, rising.any(axis=-1)


def _sample(image: GrayImage, points: Array) -> Array:
    """Return the brightness at points (..., 2) by bilinear interpolation, edges repeated."""
    height, width = image.shape
    # cv2.remap would round the coordinates to 1/32 px.
    x = np.clip(points[..., 0], 0.0, width - 1.001)
    y = np.clip(points[..., 1], 0.0, height - 1.001)
    x0, y0 = x.astype(int), y.astype(int)
    fx, fy = x - x0, y - y0
    top = image[y0, x0] * (1.0 - fx) + image[y0, x0 + 1] * fx
    bottom = image[y0 + 1, x0] * (1.0 - fx) + image[y0 + 1, x0 + 1] * fx
    brightness: Array = top * (1.0 - fy) + bottom * fy
    return brightness


def _intersections(points: Array, found: Any) -> Array:
    """Return the corners (4, 2) where robust lines through (4, n, 2) points meet."""
    weights = found.astype(float)
    for _ in range(3):
        total = weights.sum(axis=1)
        centre = np.einsum('en,enk->ek', weights, points) / total[:, None]
        x, y = np.moveaxis(points - centre[:, None], 2, 0)
        xx, xy, yy = ((weights * product).sum(axis=1) for product in (x * x, x * y, y * y))
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)  # of the line, by total least squares
        normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        residual = np.abs(x * normal[:, :1] + y * normal[:, 1:])
        scale = 3.0 * np.median(residual, axis=1) + 1e-12
        weights = found / (1.0 + (residual / scale[:, None])**2)
    before = np.roll(normal, 1, axis=0)
    matrix = np.stack([before, normal], axis=1)
    right = np.stack([np.sum(before * np.roll(centre, 1, axis=0), axis=1),
                      np.sum(normal * centre, axis=1)], axis=1)
    if not np.all(np.abs(np.linalg.det(matrix)) > 0.05):  # edges nearly parallel
        return np.full((4, 2), np.nan)
    return np.linalg.solve(matrix, right[:, :, None])[:, :, 0]

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

"""Tracking where it is hard: covered markers, bad light, defocus, and what is not the marker."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
from marker_images import (
    Cover,
    facing,
    Hovering,
    make_camera,
    marker_code,
    render,
    SIDE,
    TAIL,
)
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.tracker import camera_mounting, Sighting

pytestmark = pytest.mark.slow
CAMERA = make_camera(width=240, height=180)  # the middle of the usual one: as sharp, but quicker
SIZE, SHAPE = (240, 180), (180, 240)
MOUNTING = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
HERE = facing((0.02, -0.03, 1.6), (0.1, 0.3, 0.05))  # T_camera_marker


def course(k: int) -> Transform:
    """Return T_camera_marker in image k of a flight away from the camera, weaving."""
    return facing((0.08 * np.sin(k / 12.0), -0.05 * np.cos(k / 9.0), 1.2 + 0.02 * k),
                  (0.1, 0.1 + 0.4 * np.sin(k / 18.0), 0.05))


def error(sighting: Sighting, T_camera_marker: Transform) -> float:
    """Return by which share of its range the leader's estimated place is wrong."""
    truth = (MOUNTING @ T_camera_marker @ TAIL.inverse()).translation
    off = sighting.estimates['leader'].position - truth
    return float(np.linalg.norm(off) / T_camera_marker.translation[2])


@pytest.fixture(scope='module')
def default_finds() -> Callable[[GrayImage], bool]:
    """Return whether OpenCV's detector with its default parameters finds marker 0."""
    if not hasattr(cv2.aruco, 'ArucoDetector'):
        pytest.skip('this OpenCV has no cv2.aruco.ArucoDetector to compare with')
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), cv2.aruco.DetectorParameters())

    def finds(image: GrayImage) -> bool:
        return 0 in np.ravel(detector.detectMarkers(image)[1])

    return finds


def shares(images: list[GrayImage], default_finds: Callable[[GrayImage], bool],
           largest: float) -> tuple[float, float]:
    """
    Return in which share of images of ``course`` the leader is found, and marker 0 by OpenCV.

    :param largest: error of the place, as a share of the range.
    """
    follower, found = Hovering(CAMERA, MOUNTING), []
    for k, image in enumerate(images):
        sighting = follower.see(image)
        found.append('leader' in sighting.estimates)
        if found[-1]:
            assert error(sighting, course(k)) < largest
    return float(np.mean(found)), float(np.mean([default_finds(image) for image in images]))


@pytest.mark.parametrize('side', ['left', 'right', 'top', 'bottom'])
def test_a_marker_covered_by_5_percent_on_one_side_stays_tracked(
        side: str, default_finds: Callable[[GrayImage], bool]) -> None:
    # What is dark merges with the marker's border: no quadrilateral is left.
    found, by_default = shares([render(
        CAMERA, {0: course(k)}, rays=3, seed=k, cover=Cover(side, 0.05, 20.0) if k >= 4 else None)
        for k in range(18)], default_finds, 0.03)
    assert found >= 0.85 and by_default <= 0.4


@pytest.mark.parametrize('conditions', [
    {'black': 2.0, 'white': 20.0}, {'black': 200.0, 'white': 1000.0},
    {'black': 60.0, 'white': 400.0, 'gamma': 2.2, 'blur': 1.5}, {'blur': 3.0}], ids=str)
def test_bad_light_and_defocus_find_no_fewer_than_default(
        conditions: dict[str, float], default_finds: Callable[[GrayImage], bool]) -> None:
    found, by_default = shares([render(CAMERA, {0: course(k)}, rays=3, seed=k, **conditions)
                                for k in range(26)], default_finds, 0.15)
    assert found >= by_default > 0.0


def homography(margin: float = 0.0) -> Array:
    """Return what takes the unit square to where the marker is expected, grown by a margin."""
    corners = CAMERA.project(HERE.apply(marker_corners((1.0 + 2.0 * margin) * SIDE)))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    return np.asarray(cv2.getPerspectiveTransform(square, corners.astype(np.float32)))


def texture(rng: np.random.Generator) -> Array:
    """Return noise of all scales."""
    total = np.full(SHAPE, rng.uniform(60, 180))
    for cells in (5, 11, 25, 60):
        total += cv2.resize(rng.normal(0.0, rng.uniform(2, 35), (cells, cells)), SIZE,
                            interpolation=cv2.INTER_CUBIC)
    return total


def at_the_marker(rng: np.random.Generator, cells: Array, margin: float) -> Array:
    """Return a pattern (n, n) of 0 and 1 where the marker is expected, before a texture."""
    image, (black, white) = texture(rng), (rng.uniform(5, 60), rng.uniform(150, 240))
    n, finer = len(cells), 3
    shift = np.eye(3)
    shift[:2, 2] = rng.normal(0.0, 1.0, 2)
    warp = np.diag([finer, finer, 1.0]) @ shift @ homography(margin) @ np.diag(
        [1 / (8 * n), 1 / (8 * n), 1.0])
    size = (SIZE[0] * finer, SIZE[1] * finer)
    pattern = np.kron(black + (white - black) * cells, np.ones((8, 8)))
    mask = cv2.warpPerspective(np.ones_like(pattern), warp, size, flags=cv2.INTER_NEAREST)
    shown = cv2.warpPerspective(pattern, warp, size, flags=cv2.INTER_NEAREST)
    cover, value = (cv2.resize(m, SIZE, interpolation=cv2.INTER_AREA)
                    for m in (mask, shown))
    return image * (1.0 - cover) + value


def checkerboard(rng: np.random.Generator) -> Array:
    """Return a checkerboard, turned, of any size."""
    angle, size = rng.uniform(0.0, np.pi), rng.uniform(4.0, 45.0)
    v, u = np.mgrid[:SHAPE[0], :SHAPE[1]] + rng.uniform(0.0, 90.0)
    across, along = (u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle))
    black, white = rng.uniform(5, 80), rng.uniform(120, 240)
    even = (np.floor(across / size) + np.floor(along / size)) % 2 == 0
    return np.asarray(np.where(even, white, black))


def rectangles(rng: np.random.Generator) -> Array:
    """Return dark and bright boxes, frames and squares in squares on a texture."""
    image = texture(rng)
    for _ in range(25):
        center, size = rng.uniform([0, 0], SIZE), rng.uniform(8.0, 110.0, 2)
        if rng.random() < 0.5:
            size[1] = size[0]
        angle = rng.uniform(-30.0, 30.0)
        for share in (1.0, 0.66, 0.33)[:rng.integers(1, 4)]:
            box = cv2.boxPoints((tuple(map(float, center)), tuple(map(float, share * size)),
                                 float(angle)))
            cv2.fillPoly(image, [box.astype(np.int32)], float(rng.uniform(0, 255)))
    return image


def squares_at_the_marker(rng: np.random.Generator) -> Array:
    """Return a black square, or one in another, where the marker is expected."""
    distance = np.minimum(np.arange(8), 7 - np.arange(8))
    ring = np.minimum(distance, distance[:, None])  # from the rim
    inner = int(rng.integers(1, 5))
    return at_the_marker(rng, (ring == 0) | (inner < 4) & (ring > inner), 1 / 6)


def board_at_the_marker(rng: np.random.Generator) -> Array:
    """Return a checkerboard whose lines are those of the marker's cells."""
    cells = np.indices((10, 10)).sum(axis=0) % 2 == int(rng.integers(0, 2))
    return at_the_marker(rng, cells, 2 / 6)


def cells_at_the_marker(rng: np.random.Generator) -> Array:
    """Return a marker of no neighbor where the marker is expected: random cells."""
    code = np.pad(rng.random((4, 4)) < 0.5, 1)
    assert not any(np.array_equal(code, np.rot90(marker_code(0), k)) for k in range(4))
    return at_the_marker(rng, np.pad(code, 1, constant_values=True), 1 / 6)


KINDS = [texture, checkerboard, rectangles, squares_at_the_marker, board_at_the_marker,
         cells_at_the_marker]


def shaded_or_dazzled(rng: np.random.Generator, image: Array) -> Array:
    """Return an image with a shadow's edge, or a saturated reflex, at the marker's place."""
    x, y = CAMERA.project(HERE.translation[None])[0] + rng.uniform(-25.0, 25.0, 2)
    v, u = np.mgrid[:SHAPE[0], :SHAPE[1]]
    if rng.random() < 0.5:
        angle = rng.uniform(0.0, 2.0 * np.pi)
        lit = (u - x) * np.cos(angle) + (v - y) * np.sin(angle) > 0.0
        return np.where(lit, image, rng.uniform(0.15, 0.4) * image)
    far = np.hypot(u - x, v - y) / rng.uniform(4.0, 14.0)
    dazzled: Array = image + 400.0 * np.exp(-far**4)
    return dazzled


def clutter(count: int, uneven: bool) -> Iterator[tuple[str, GrayImage]]:
    """Yield images without the marker, in even or uneven light: their kind, and pixels."""
    for k in range(count):
        rng = np.random.default_rng([7, k])
        kind = KINDS[k % len(KINDS)]
        image = shaded_or_dazzled(rng, kind(rng)) if uneven else kind(rng)
        image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.4, 1.2)))
        image = image + rng.normal(0.0, rng.uniform(0.5, 4.0), image.shape)
        yield kind.__name__, np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(('count', 'uneven'), [
    (36, False), *(pytest.param(*each, marks=pytest.mark.sweep) for each in (
        (120, False), (1000, True)))])
def test_clutter_at_last_place_of_marker_is_never_taken_for_it(
        count: int, uneven: bool) -> None:
    follower, marker_image = Hovering(CAMERA, MOUNTING), render(CAMERA, {0: HERE})
    for k, (kind, image) in enumerate(clutter(count, uneven)):
        assert 'leader' in follower.see(marker_image).estimates  # so it is expected there
        assert not follower.see(image).estimates, f'{kind} {k}'

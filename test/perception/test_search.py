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

"""Where markers are looked for: corners in pixels of the whole image, at any scale."""

from __future__ import annotations

from functools import cache

import cv2
from marker_images import Cover, DICTIONARY, facing, make_camera, render, SIDE
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception import search
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.measurement import Measurement, PosePrior
from flock_follower.perception.pose import locate, target

LEADER = MarkedNeighbor('leader', (Marker(3, SIDE, Transform()),))
CAMERA = make_camera()
HERE = facing((0.2, -0.1, 1.6), (0.1, 0.3, 0.05))  # T_camera_marker


def corners_of(camera: CameraModel, pose: Transform) -> Array:
    return camera.project(pose.apply(marker_corners(SIDE)))


@pytest.fixture(scope='module')
def image() -> GrayImage:
    return render(CAMERA, {3: HERE, 4: facing((-0.5, 0.3, 2.2), (0.1, 0.3, 0.05))})


@pytest.mark.parametrize('thorough', [False, True])
@pytest.mark.parametrize('width', [640, 1278, 1280, 1920])
def test_everywhere_gives_pixels_of_the_whole_image(width: int, thorough: bool) -> None:
    camera = make_camera(width=width, height=480)
    pose = facing((0.14 * width / 640 * 1.6, -0.1, 1.2), (0.1, 0.3, 0.2))
    found = search.everywhere(render(camera, {3: pose}, rays=3), DICTIONARY,
                              LEADER.markers if thorough else None)
    assert found.ids.tolist() == [3]
    errors = found.corners[0] - corners_of(camera, pose)
    assert np.abs(errors).max() < (1.0 if width < search.LARGE_WIDTH else 2.5)
    assert np.abs(errors.mean(axis=0)).max() < (0.35 if width < search.LARGE_WIDTH else 0.7)


@pytest.mark.parametrize('hidden', [(20, 20, 18), (110, 110, 20), (65, 20, 15)])
def test_outline_is_whole_though_reflex_hides_corner_or_side(
        hidden: tuple[int, int, int]) -> None:
    image = np.full((140, 150), 190, dtype=np.uint8)
    image[20:111, 20:111] = 30
    cv2.circle(image, hidden[:2], hidden[2], 255, -1)
    corners = np.array([[20.0, 20.0], [110.0, 20.0], [110.0, 110.0], [20.0, 110.0]])
    assert min(np.abs(np.roll(outline, k, axis=0) - corners).max()
               for outline in search.quadrilaterals(image) for k in range(4)) < 2.0


@pytest.mark.parametrize('place', [
    (0.0, 0.0, -2.0), (9.0, 0.0, 2.0), (-9.0, 5.0, 2.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.005),
    (np.nan, 0.0, 1.0), (0.0, 0.0, np.inf), (0.0, 0.0, 1e5), (1e9, -1e9, 1e-3)])
def test_what_is_expected_outside_the_image_is_not_searched_for(
        image: GrayImage, place: tuple[float, float, float]) -> None:
    expected = Transform(HERE.rotation, np.array(place))
    with np.errstate(all='ignore'):
        found = search.near(image, CAMERA, DICTIONARY, LEADER, expected, True)
    assert found.corners.shape == (len(found.ids), 4, 2)
    if place != (0.0, 0.0, 0.005):  # so near that it would fill the image
        assert len(found.ids) == 0


@pytest.mark.parametrize(('place', 'outwards'), [
    ((-1.03, 0.0), (-1.0, 0.0)), ((0.0, -0.72), (0.0, -1.0)), ((0.93, 0.7), (1.0, 1.0))])
def test_remaining_region_at_image_rim_is_searched(
        place: tuple[float, float], outwards: tuple[float, float]) -> None:
    # The marker is just inside, its expected place 25 px further out.
    inside = facing((*place, 2.1), (0.0, 0.1, 0.0))
    outside = facing((place[0] + 0.086 * outwards[0], place[1] + 0.086 * outwards[1], 2.1),
                     (0.0, 0.1, 0.0))
    found = search.near(render(CAMERA, {3: inside}), CAMERA, DICTIONARY, LEADER, outside, True)
    assert found.ids.tolist() == [3]
    assert np.abs(found.corners[0] - corners_of(CAMERA, inside)).max() < 2.0


#: Where the middle of the light is: as far from the marker's, in side lengths.
REACH = {'shadow': (-0.3, 0.3), 'reflex': (-0.3, 0.3), 'spot': (-0.5, 0.5)}


def in_uneven_light(image: GrayImage, pose: Transform, seed: int, kind: str) -> GrayImage:
    """Return an image in which a marker is half in the shade, or the sun is reflected on it."""
    random, outline = np.random.default_rng(seed), corners_of(CAMERA, pose)
    side = np.linalg.norm(outline[0] - outline[1])
    x, y = outline.mean(axis=0) + random.uniform(*REACH[kind], 2) * side
    rows, columns = np.mgrid[:image.shape[0], :image.shape[1]]
    if kind == 'spot':
        far = ((columns - x)**2 + (rows - y)**2) / (random.uniform(0.1, 0.2) * side)**2
        light = image + 400.0 * np.exp(-far**4)
    elif kind == 'reflex':
        far = ((columns - x)**2 + (rows - y)**2) / (random.uniform(0.25, 0.5) * side)**2
        light = image + random.uniform(80.0, 200.0) * np.exp(-0.5 * far)
    else:
        angle, shade = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.2, 0.5)
        lit = (columns - x) * np.cos(angle) + (rows - y) * np.sin(angle) > 0.0
        light = np.where(lit, image, shade * image)
    return np.clip(light, 0.0, 255.0).astype(np.uint8)


@cache
def in_even_light(seed: int) -> tuple[Transform, GrayImage]:
    """Return the pose of a marker, and its image."""
    pose = facing((0.2, -0.1, 1.6), (0.1, 0.3, 0.2 * seed))
    return pose, render(CAMERA, {3: pose}, rays=3)


@pytest.mark.parametrize('kind, least', [('shadow', 7), ('reflex', 9), ('spot', 9)])
def test_a_thorough_search_reads_a_marker_in_uneven_light(kind: str, least: int) -> None:
    found = []
    for seed in range(10):
        pose, even = in_even_light(seed)
        image = in_uneven_light(even, pose, seed, kind)
        detections = search.everywhere(image, DICTIONARY, LEADER.markers)
        found.append(detections.ids.tolist() == [3] and np.abs(
            detections.corners[0] - corners_of(CAMERA, pose)).max() < 3.0)
    assert sum(found) >= least


def located(image: GrayImage, markers: tuple[Marker, ...]) -> list[Measurement]:
    """Return what an image shows of smeared or covered markers, each of its own neighbor."""
    found = search.everywhere(image, DICTIONARY, markers, windows=())
    sought = {m.marker_id: target(MarkedNeighbor('leader', (m,)), DICTIONARY) for m in markers}
    poses = [locate(image, CAMERA, sought[marker_id], 0, corners, PosePrior(), found.most_rms)
             for marker_id, corners in zip(found.ids.tolist(), found.corners)]
    return [pose for pose in poses if pose is not None]


#: Covers, and the motion of the image, px; a cell has 10 px.
DISTURBED = [
    *((Cover(side, 0.2, 20.0), (0.0, 0.0)) for side in ('left', 'right', 'top', 'bottom')),
    (None, (18.0, 0.0)), (None, (12.0, 13.0)), (None, (0.0, -18.0))]


@pytest.mark.parametrize(('cover', 'motion'), DISTURBED)
def test_marker_with_covered_side_or_smeared_code_is_located(
        cover: Cover | None, motion: tuple[float, float]) -> None:
    image = render(CAMERA, {3: HERE}, cover=cover, motion=motion)
    assert not len(search.everywhere(image, DICTIONARY).ids)
    first, *_ = located(image, LEADER.markers)
    error = first.T_camera_body.translation - HERE.translation
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(HERE.translation)


@pytest.mark.parametrize(('cover', 'motion'), DISTURBED)
@pytest.mark.parametrize('shown', [3, 17])
def test_covered_or_smeared_marker_is_located_as_no_other(
        shown: int, cover: Cover | None, motion: tuple[float, float]) -> None:
    others = tuple(Marker(k, SIDE, Transform()) for k in range(50) if k != shown)
    assert not located(render(CAMERA, {shown: HERE}, cover=cover, motion=motion), others)


def test_code_that_resembles_clutter_is_not_sought_if_smeared() -> None:
    """One white square: random textures and other smeared prints were taken for it."""
    image = render(CAMERA, {17: HERE}, motion=(18.0, 0.0))
    plain = (Marker(17, SIDE, Transform()),)
    assert not len(search.everywhere(image, DICTIONARY, plain, windows=()).ids)
    assert located(image, LEADER.markers) == []

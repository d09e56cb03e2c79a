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

"""Checks of the images: calibration, brightness, and markers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from flock_follower.checks.findings import ERROR, Finding, first, OK, WARNING
from flock_follower.checks.observations import Observations, Picture
from flock_follower.parameters.settings import MARKER_LOST_WIDTH
from flock_follower.perception.camera import CameraModel, marked_rectified

#: Side of a marker, px, below which its range is noisy.
NOISY_MARKER_WIDTH = 18.0
#: Mean gray level, 0 to 255, below which an image is too dark.
MEAN_TOO_DARK = 12.0
#: Mean gray level, 0 to 255, above which an image is too bright.
MEAN_TOO_BRIGHT = 243.0
#: Standard deviation of the gray levels below which an image shows nothing.
DEVIATION_TOO_FLAT = 3.0
#: Difference of fx and fy, as a share, above which pixels are not square: 1 % is usual.
NOT_SQUARE: Final = 0.03
#: Share of the images below which a marker is hardly in sight.
SELDOM: Final = 0.5


def camera_model(seen: Observations) -> CameraModel:
    """
    Return the camera of the newest CameraInfo, as relative_pose reads it.

    :raises ValueError: if the calibration is missing or wrong.
    """
    info = seen.calibration
    if info is None:
        raise ValueError('no calibration')
    return CameraModel.from_info(info, bool(seen.value('relative_pose', 'rectified', False)))


def check_pictures(seen: Observations) -> Iterator[Finding]:
    """Check calibration, images and markers."""
    if not seen.has_markers:
        return
    good = [picture for picture in seen.pictures if not picture.fault]
    if faults := [picture.fault for picture in seen.pictures if picture.fault]:
        yield Finding(ERROR, 'images', faults[0], 'an encoding that can be read',
                      'set the format of the camera driver to mono8, rgb8 or bgr8; compressed '
                      'images must be whole JPEG or PNG files')
    if seen.calibration is not None:  # else it is reported as a missing topic
        yield _calibration(seen, good)
    if good:
        yield _exposure(good)
        yield _marker(seen, good)


def _calibration(seen: Observations, pictures: list[Picture]) -> Finding:
    what, wanted = 'calibration', 'a calibration of these images'
    calibrate = 'calibrate the camera at this size (camera_calibration), give its driver the file'
    sizes = sorted({f'{picture.width}x{picture.height}' for picture in pictures})
    try:
        camera = camera_model(seen)
    except ValueError as problem:
        return Finding(ERROR, what, '; '.join([str(problem), *(
            f'images are {each}' for each in sizes[:1])]), wanted, calibrate)
    size = f'{camera.width}x{camera.height}'
    others = [each for each in sizes if each != size]
    measured = f'{size} {camera.model}, f {camera.matrix[0, 0]:.0f} px'
    straight = marked_rectified(seen.names[seen.image_name])
    return first(
        what, wanted,
        (others, ERROR, f'for {size}, images are {"".join(others[:1])}', calibrate),
        (straight and np.any(camera.distortion), ERROR,
         f'{measured}, distorted, but the topic is marked as rectified',
         'start relative_pose and planner with rectified:=true'),
        (abs(camera.matrix[0, 0] / camera.matrix[1, 1] - 1.0) > NOT_SQUARE, WARNING,
         f'{measured}, but {camera.matrix[1, 1]:.0f} px vertically: pixels not square',
         'are the images stretched? If not, calibrate again'),
        (True, OK, measured, ''))


def _exposure(pictures: list[Picture]) -> Finding:
    newest = pictures[-1]
    brightness = float(np.median([picture.brightness for picture in pictures]))
    contrast = float(np.median([picture.contrast for picture in pictures]))
    measured = (f'{newest.width}x{newest.height} {newest.encoding}, gray level {brightness:.0f} '
                f'± {contrast:.0f}')
    return first(
        'images', f'gray level {MEAN_TOO_DARK:.0f} to {MEAN_TOO_BRIGHT:.0f}',
        (brightness < MEAN_TOO_DARK, ERROR, f'{measured}: black',
         'take off the cap; more light, or a longer exposure'),
        (brightness > MEAN_TOO_BRIGHT, ERROR, f'{measured}: white',
         'expose less (automatic exposure on)'),
        (contrast < DEVIATION_TOO_FLAT, WARNING, f'{measured}: one gray',
         'is something before the lens?'),
        (True, OK, measured, ''))


def _marker(seen: Observations, pictures: list[Picture]) -> Finding:
    ours = f'marker {", ".join(map(str, sorted(seen.marker_sides)))} of {seen.dictionary}'
    found = [[side for number, side in picture.markers.items() if number in seen.marker_sides]
             for picture in pictures]
    share = sum(map(bool, found)) / len(pictures)
    side = float(np.median([side for each in found for side in each] or [0.0]))
    measured = f'{side:.0f} px wide, in {share:.0%} of {len(pictures)} images'
    others = sorted({number for picture in pictures for number in picture.markers})
    unseen = f'not in sight in {len(pictures)} images'
    misprints = [fault for picture in pictures for fault in picture.misprints]
    refused = [picture for picture in pictures if picture.misprints]
    outlines = sum(bool(picture.outlines) for picture in pictures)
    misprint, remedy = misprints[-1][1:] if misprints else ('', '')
    return first(
        'marker', f'{ours}, {NOISY_MARKER_WIDTH:.0f} px, most of the time',
        (len(refused) > share * len(pictures), ERROR,
         f'{misprint}, in {len(refused)} of {len(pictures)} images', remedy),
        (share == 0.0 and outlines, ERROR,
         f'found in {outlines} of {len(pictures)} images, and no pose suits it', 'glue the print '
         'on a white margin of one cell; is it flat, the lens calibrated?'),
        (share == 0.0 and bool(others), WARNING,
         f'{unseen}, but {", ".join(map(str, others))}',
         'set marker_id in neighbors_file, or show the right print'),
        (share == 0.0, WARNING, unseen,
         'hold the leader before the camera; is it the dictionary and id of the print, flat, its '
         'margin white?'),
        (side < MARKER_LOST_WIDTH, ERROR, measured,
         'come nearer, print it larger, or use a longer lens or a finer image'),
        (side < NOISY_MARKER_WIDTH, WARNING, measured,
         'come nearer, or print the marker larger: a small marker is lost easily'),
        (share < SELDOM, WARNING, measured,
         'keep the marker in sight; check light, blur and the white margin'),
        (True, OK, measured, ''))

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

"""Images: their calibration, what can be seen on them, the marker in sight and how large it is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from flock_follower.checks.findings import error, Finding, ok, warning
from flock_follower.checks.observations import Observations, Picture
from flock_follower.perception.camera import CameraModel

#: Sides of a marker, px: smaller its range gets noisy; smaller still it is lost.
SMALL, TINY = 18.0, 12.0
#: Mean grey levels: darker, brighter shows nothing; a deviation below this is a wall, or a cap.
DARK, BRIGHT, FLAT = 12.0, 243.0, 3.0
#: A marker in fewer of the images than this share is hardly in sight.
SELDOM: Final = 0.5
#: Images that show a marker twice: one may err.
TWICE: Final = 2


def camera_model(seen: Observations) -> CameraModel:
    """
    Return the camera of the newest CameraInfo, as relative_pose has it.

    :raises ValueError: naming what is wrong with the calibration.
    """
    told: dict[str, Any] = seen.calibration
    return CameraModel.from_calibration(
        told['k'], told['d'], told['model'], told['width'], told['height'], told['p'],
        rectified=bool(seen.value('relative_pose', 'rectified', False))).scaled(*told['window'])


def check_pictures(seen: Observations) -> Iterator[Finding]:
    """Yield what is to be said of calibration, images and markers."""
    good = [picture for picture in seen.pictures if not picture.fault]
    if faults := [picture.fault for picture in seen.pictures if picture.fault]:
        yield error('images', faults[0], 'an encoding that can be read',
                    'set the format of the camera driver to mono8, rgb8 or bgr8')
    yield from _calibration(seen, good)
    if good:
        yield _exposure(good)
        yield _marker(seen, good)
        yield from _duplicates(seen, good)


def _calibration(seen: Observations, pictures: list[Picture]) -> Iterator[Finding]:
    if not seen.calibration:
        return  # told as a topic that is missing
    wanted = 'a calibration of these images'
    calibrate = 'calibrate the camera at this size (camera_calibration), give its driver the file'
    try:
        camera = camera_model(seen)
    except ValueError as problem:
        yield error('calibration', str(problem), wanted, calibrate)
        return
    sizes = sorted({(picture.width, picture.height) for picture in pictures})
    for width, height in sizes:
        if (width, height) != (camera.width, camera.height):
            yield error('calibration', f'for {camera.width}x{camera.height}, images are '
                        f'{width}x{height}', wanted, calibrate)
            return
    told = f'{camera.width}x{camera.height} {camera.model}, f {camera.matrix[0, 0]:.0f} px'
    rectified = bool(seen.value('relative_pose', 'rectified', False))
    straight = 'rect' in seen.names[seen.image_name].rsplit('/', 1)[-1]
    if straight and not rectified and np.any(camera.distortion):
        yield error('calibration', f'{told}, distorted, but the topic says rectified', wanted,
                    'start relative_pose with rectified:=true')
    elif rectified and not straight and any(seen.calibration['d']):
        yield warning('calibration', f'{told}; rectified is true, the topic does not say so',
                      wanted, 'rectified:=true only for images whose distortion was removed')
    else:
        yield ok('calibration', told, wanted)


def _exposure(pictures: list[Picture]) -> Finding:
    first = pictures[-1]
    brightness = float(np.median([picture.brightness for picture in pictures]))
    contrast = float(np.median([picture.contrast for picture in pictures]))
    told = (f'{first.width}x{first.height} {first.encoding}, grey level {brightness:.0f} '
            f'± {contrast:.0f}')
    wanted = f'grey level {DARK:.0f} to {BRIGHT:.0f}'
    if brightness < DARK:
        return error('images', f'{told}: black', wanted,
                     'take off the cap; more light, or a longer exposure')
    if brightness > BRIGHT:
        return error('images', f'{told}: white', wanted, 'expose less (automatic exposure on)')
    if contrast < FLAT:
        return warning('images', f'{told}: one grey', wanted, 'is something before the lens?')
    return ok('images', told, wanted)


def _marker(seen: Observations, pictures: list[Picture]) -> Finding:
    ids = ', '.join(map(str, sorted(seen.wanted_markers)))
    what, ours = 'marker', f'marker {ids} of {seen.dictionary}'
    wanted = f'{ours}, {SMALL:.0f} px'
    sides = [side for picture in pictures for number, side in picture.markers.items()
             if number in seen.wanted_markers]
    if not sides:
        if seen.strangers:
            name, numbers = next(iter(seen.strangers.items()))
            told = f'marker {", ".join(map(str, numbers[:4]))} of {name}'
            return error(what, f'{told} in sight, not {ours}', wanted, 'write dictionary and '
                         'marker_id of the print into config/neighbors.yaml, or print that one')
        return warning(what, f'not in sight in {len(pictures)} images', wanted,
                       'hold the leader before the camera; is the print flat, its margin white?')
    share = sum(bool(set(p.markers) & set(seen.wanted_markers)) for p in pictures) / len(pictures)
    side = float(np.median(sides))
    told = f'{side:.0f} px wide, in {share:.0%} of {len(pictures)} images'
    if side < TINY:
        return error(what, told, wanted,
                     'come nearer, print it larger, or use a longer lens or a finer image')
    if side < SMALL:
        return warning(what, told, wanted,
                       'come nearer, or print it larger: a small one is lost easily')
    if share < SELDOM:
        return warning(what, told, f'{wanted}, most of the time',
                       'keep it in sight: light, blur, a cut-off margin')
    return ok(what, told, wanted)


def _duplicates(seen: Observations, pictures: list[Picture]) -> Iterator[Finding]:
    """Yield which neighbours' markers were seen more than once in an image."""
    for number, name in sorted(seen.wanted_markers.items()):
        count = sum(number in picture.repeated for picture in pictures)
        if count >= TWICE:
            yield (error if seen.live else warning)(
                'marker id', f'marker {number} twice in {count} of {len(pictures)} images',
                'each id once',
                f'cover the print that is not on {name}, or give {name} another id')

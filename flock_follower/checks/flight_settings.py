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

"""Check of the parameters of planner and bridge, together with the camera and the marker."""

from __future__ import annotations

from collections.abc import Iterator
import math

from flock_follower.checks.findings import ERROR, Finding, OK, UNMEASURED, WARNING
from flock_follower.checks.observations import Observations
from flock_follower.checks.pictures import camera_model
from flock_follower.parameters.settings import Camera, find_unsafe_settings

#: Messages after which a rate counts as measured.
MEASURED_MESSAGES = 10
#: The nodes whose parameters are judged.
JUDGED_NODES = ('planner', 'mavlink_bridge')


def check_settings(seen: Observations) -> Iterator[Finding]:
    """Check the parameters of a live system; a bag is checked with the given parameters."""
    wanted = 'parameters that can fly'
    missing = ', '.join(node for node in JUDGED_NODES if not seen.parameters.get(node))
    if missing and seen.live:
        yield Finding(UNMEASURED, 'settings', f'no parameters received of {missing}', wanted)
    values = {name: value for node in JUDGED_NODES
              for name, value in seen.parameters.get(node, {}).items()}
    if not values:
        return
    found = find_unsafe_settings(values, _camera(seen))
    for each in found:
        yield Finding(ERROR if each.dangerous else WARNING, 'settings',
                      f'{each.parameter} = {each.value:g}: {each.why}', each.valid,
                      f'set {each.parameter}')
    if not found and not missing:
        yield Finding(OK, 'settings', 'judged together', wanted)


def _camera(seen: Observations) -> Camera:
    """Return the camera and the smallest marker, as far as both are known."""
    images = seen.topic(seen.image_name)
    few = len(images.arrivals) < MEASURED_MESSAGES
    rate = None if few or seen.busy else seen.rate(images)  # on a busy computer no rate is judged
    if seen.calibration is None:
        return Camera(rate)
    try:
        camera = camera_model(seen)
    except ValueError:
        return Camera(rate)
    focal = float(camera.matrix[1, 1])
    marker = focal * min(seen.marker_sides.values()) if seen.marker_sides else None
    return Camera(rate, marker, math.atan(0.5 * camera.height / focal))

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

"""One camera of several, for checks that judge a system of a single camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flock_follower.parameters.cameras import ALONE, cameras, CameraValues


def select_camera(values: Mapping[str, Any],
                  name: str = '') -> tuple[CameraValues, dict[str, Any]]:
    """
    Return a camera by name, or the first, and the values for a system with only this camera.

    :raises ValueError: if no camera has that name.
    """
    configured = cameras(values)
    found = next((camera for camera in configured if name in ('', camera.name)), None)
    if found is None:
        names = ', '.join(camera.name for camera in configured if camera.name)
        raise ValueError(f'camera {name}: must be {f"one of {names}" if names else "left out"}')
    return found, {**values, **{single: getattr(found, key) for single, (key, _) in ALONE.items()
                                if single in values}}

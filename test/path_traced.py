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

"""Path-traced flights (../shared/data/rendered), for tests: they skip where these are missing."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import cv2
from marker_images import TAIL
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.tracker import camera_mounting, Tracker

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'rendered'
#: Place of the camera on the follower's body.
MOUNTING: Transform = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])


def load_module(path: Path) -> Any:
    """Return the module of a file, such as DATA / 'traj.py' with the motion; or skip (scipy)."""
    pytest.importorskip('scipy')
    spec = spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def camera_of(flight: dict[str, Any]) -> CameraModel:
    """Return the camera of a flight of traj.py."""
    camera = flight['cam']
    fx, fy, cx, cy = camera['K']
    return CameraModel(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
                       np.array(camera['D']), 'plumb_bob', camera['W'], camera['H'])


def tracker_of(flight: dict[str, Any]) -> Tracker:
    """Return a tracker of the leader of a flight."""
    leader = flight['L'][0]
    return Tracker(NeighborConfig(flight['tag'], (MarkedNeighbor('leader', (
        Marker(leader['mid'], leader['size'], TAIL),)),)), MOUNTING)


def light_of(packed: Array, ends: Array, k: int) -> Array:
    """Return the light (H, W), 0 to 1, of image ``k``; ``ends`` are those of the packed ones."""
    image = cv2.imdecode(packed[(ends[k - 1] if k else 0):ends[k]], cv2.IMREAD_GRAYSCALE)
    return np.asarray((image / 255.0)**2.2)

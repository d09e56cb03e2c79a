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

"""The parameters of black_box, and the folder of its recordings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flock_follower.parameters.cameras import CAMERA_SPECS
from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range

BLACK_BOX = [
    Spec('record_folder', '',
         'folder of the recordings, each in its own subfolder; empty: flock_follower/black_box in '
         '$ROS_HOME (~/.ros), with a subfolder for the namespace'),
    Spec('record_images', 'compressed',
         'compressed: gray JPEG images, or those of the camera if it compresses itself; none: no '
         'images, so evaluate cannot use the recording', ('compressed', 'none')),
    Spec('image_transport', 'raw', 'the same as for relative_pose', ('raw', 'compressed')),
    Spec('disk_used', 8000.0,
         'largest size of all recordings in the folder; beyond it the oldest files are deleted',
         Range(10.0, 1e8, 'MB')),
    Spec('disk_free', 1000.0,
         'space kept free on the disk: with less, the oldest files are deleted; if that is not '
         'enough, recording stops', Range(10.0, 1e8, 'MB')),
    *CAMERA_SPECS,
]


def recordings_folder(values: Mapping[str, Any], ros_home: str, namespace: str) -> Path:
    """
    Return the folder of the recordings; ``ros_home`` is $ROS_HOME, or ''.

    For a user without a home folder (in a container), and with an empty $HOME, the home folder is
    /.
    """
    folder = Path(values['record_folder']) if values['record_folder'] else (
        Path(ros_home or '~/.ros') / 'flock_follower' / 'black_box' / namespace.strip('/'))
    try:
        return folder.expanduser()
    except RuntimeError:
        return Path('/', *folder.parts[1:])

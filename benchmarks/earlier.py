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
Perception of an earlier commit, in the same process as that of today.

The package of the commit is copied from git into ``build/earlier``, with the commit in its name,
so that both can be imported. It gets the messages, the configuration and the settings of threads
that perception of today gets.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
import io
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tarfile
from typing import Any

from flock_follower.geometry import Transform
from flock_follower.perception.images import GrayImage
from flock_follower.system.files import resource

ROOT = Path(__file__).resolve().parents[1]
COPIES = ROOT / 'build' / 'earlier'
NAME = 'flock_follower'


def copy_package(commit: str) -> str:
    """
    Copy the package of a commit, if it is not there yet, and return its name.

    :raises subprocess.CalledProcessError: if git does not know the commit.
    """
    git = ['git', '-C', str(ROOT)]
    known = subprocess.run([*git, 'rev-parse', '--short=8', f'{commit}^{{commit}}'],
                           check=True, capture_output=True, text=True).stdout.strip()
    name = f'{NAME}_{known}'
    if not (COPIES / name).exists():
        content = subprocess.run([*git, 'archive', known, NAME], check=True,
                                 capture_output=True).stdout
        unpacked = COPIES / f'{name}.part'
        shutil.rmtree(unpacked, ignore_errors=True)
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            archive.extractall(unpacked, filter='data')
        for path in unpacked.rglob('*.py'):
            text = path.read_text(encoding='utf-8')
            path.write_text(re.sub(rf'\b{NAME}\b', name, text), encoding='utf-8')
        (unpacked / NAME).rename(COPIES / name)
        unpacked.rmdir()
    if str(COPIES) not in sys.path:
        sys.path.append(str(COPIES))
    return name


def commit_of(package: str) -> str:
    """Return the commit of a package's name."""
    return package.removeprefix(f'{NAME}_')


class Earlier:
    """
    A tracker of an earlier commit, with one camera.

    :param package: see :func:`copy_package`.
    :param dictionary: of the markers.
    :param T_body_camera: see ``Tracker``.
    """

    def __init__(self, package: str, dictionary: str, T_body_camera: Transform) -> None:
        reader = 'messages.state_reader'
        if not (COPIES / package / 'messages' / 'state_reader.py').exists():
            reader = 'messages'  # until November 28, 2026
        markers, geometry, tracker, pending, self._messages = (
            import_module(f'{package}.{module}') for module in (
                'perception.markers', 'geometry', 'perception.tracker',
                'perception.pending_images', reader))
        config = replace(markers.load(resource('config/neighbors.yaml')), dictionary=dictionary)
        self._tracker = tracker.Tracker(config, geometry.Transform(
            T_body_camera.rotation, T_body_camera.translation))
        self._perceiver = pending.Perceiver(self._tracker, max_wait=0.0)
        self._epoch: int | None = None  # ns, the zero of the tracker's time

    def take_camera_info(self, message: Any) -> None:
        """Take a CameraInfo."""
        self._perceiver.take_camera_info(message)

    def take_odometry(self, message: Any) -> None:
        """Take the ego odometry."""
        state = self._messages.from_odometry(message)
        self._epoch = state.stamp if self._epoch is None else self._epoch
        self._perceiver.take_odometry(state)

    def process_image(self, stamp: int, image: GrayImage) -> Any:
        """Return the sighting of an image of a stamp, ns, for which odometry came."""
        assert self._epoch is not None
        return self._tracker.process_image(
            (stamp - self._epoch) * 1e-9, image, self._perceiver.model())

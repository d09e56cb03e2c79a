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
Compare two cameras with one: a second one that sees the leader, and one that sees nobody.

Run by ``python benchmarks/perception.py --flights cameras``.
"""

from __future__ import annotations

from pathlib import Path
import time
from typing import Any

from flight import perceiver
import numpy as np

from flock_desk.camera.renderer import T_BODY_OPTICAL
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.messages import stamp_to_nanoseconds
from flock_follower.messages.state_reader import from_odometry
from flock_follower.perception import markers as neighbors
from flock_follower.perception.images import GrayImage
from flock_follower.perception.pending_images import PendingImage
from flock_follower.perception.tracker import camera_mounting, Tracker
from flock_follower.system.files import resource

SHORT_TURN = 10  # images in a row, by the median over the turns
#: Of two cameras the second sees the leader, too, or nobody: CPU time over that of one, at most.
CAMERAS = {'two, both see': 2.2, 'two, one sees': 1.3}
BACK = camera_mounting([-0.10, 0.0, 0.0], [0.0, 0.0, np.pi])


class Cameras:
    """
    Plays a bag through one camera and through two, turn by turn.

    :param count: images to play, 0 for all.
    """

    def __init__(self, bag: Path, count: int) -> None:
        config = neighbors.load(resource('config/neighbors.yaml'))
        ahead = T_BODY_OPTICAL
        self.perceivers = {
            'one': perceiver(config), 'two, both see': perceiver(config, [ahead, ahead]),
            'two, one sees': perceiver(config, [ahead, BACK])}
        self.spent: dict[str, list[float]] = {setup: [] for setup in self.perceivers}  # ms a turn
        self.found = dict.fromkeys(self.perceivers, 0)
        self.waiting: dict[str, list[tuple[PendingImage, GrayImage]]] = {
            setup: [] for setup in self.perceivers}
        self.turns = self.images = 0
        with open_bag(bag) as opened:
            for topic, msgtype, now, data in opened.messages():
                self.images += 'image' in topic
                self.take(topic, deserialize(data, msgtype), now)
                if self.images and self.images == count:
                    break
        self.race()

    def take(self, topic: str, message: Any, now: int) -> None:
        """Take a message that came at a time, ns; images reach every camera of each."""
        for setup, one in self.perceivers.items():
            for camera in one.tracker.cameras:
                if topic == '/camera_info':
                    one.take_camera_info(message, camera)
                elif 'image' in topic:
                    stamp = stamp_to_nanoseconds(message.header.stamp)
                    one.take_image(message, stamp, now * 1e-9, camera)
            if topic == '/odom':
                one.take_odometry(from_odometry(message))
            while (ready := one.process(now * 1e-9)) is not None:
                pixels = ready.pixels
                assert pixels is not None
                if setup == 'two, one sees' and ready.image.camera == '1':
                    pixels = np.ascontiguousarray(pixels[:, ::-1])  # a marker of nobody
                self.waiting[setup].append((ready.image, pixels))
        if len(self.waiting['one']) >= SHORT_TURN:
            self.race()

    def race(self) -> None:
        """Give the images that wait to each, another one first each time."""
        setups = [*self.perceivers]
        for k in range(len(setups)):
            setup = setups[(self.turns + k) % len(setups)]
            one = self.perceivers[setup]
            start = time.process_time_ns()
            for image, pixels in self.waiting[setup]:
                assert image.model is not None
                if Tracker.wanted(one.tracker, image.stamp, image.model, image.camera):
                    sighting = Tracker.process_image(
                        one.tracker, image.stamp, pixels, image.model, image.camera)
                    self.found[setup] += len(sighting.estimates)
            self.spent[setup].append((time.process_time_ns() - start) * 1e-6)
            self.waiting[setup].clear()
        self.turns += 1

    def shares(self) -> dict[str, float]:
        """Print what each took, and return that of two cameras over that of one."""
        of_one = {setup: [spent / one for spent, one in zip(turns, self.spent['one'])]
                  for setup, turns in self.spent.items()}
        print('\ncameras      CPU, ms per image of the first   of one, median   neighbors found')
        for setup, turns in self.spent.items():
            print(f'  {setup:<15}{sum(turns) / self.images:8.2f}'
                  f'{np.median(of_one[setup]):28.2f}{self.found[setup]:17d}')
        return {setup: float(np.median(of_one[setup])) for setup in CAMERAS}

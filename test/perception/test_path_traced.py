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

"""The first images of path-traced flights: found though covered or smeared, and not mirrored."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from path_traced import camera_of, DATA, light_of, load_module, tracker_of
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception.measurement import angle

if not (DATA / 'room_hd.npz').exists():
    pytest.skip('the path-traced flights (../shared/data/rendered) are not here',
                allow_module_level=True)
IMAGES = 6


def smeared(image: Array, length: float, direction: float) -> Array:
    """Return light smeared by a length, px, in the image."""
    size = 2 * int(length / 2.0) + 5
    kernel = np.zeros((size, size))
    along = np.linspace(-0.5, 0.5, 201) * length
    for x, y in zip(size // 2 + along * math.cos(direction),
                    size // 2 + along * math.sin(direction)):
        column, row = int(x), int(y)
        right, down = x - column, y - row
        kernel[row:row + 2, column:column + 2] += np.outer([1.0 - down, down],
                                                           [1.0 - right, right])
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()))


@pytest.mark.parametrize(('cells', 'direction'), [(0.0, 0.0), (0.8, 0.7)])
def test_smeared_first_image_does_not_lock_mirrored_attitude(
        cells: float, direction: float) -> None:
    motion_of = load_module(DATA / 'traj.py')
    flight = motion_of.flight('room_hd')
    own, leader, time = flight['F'], flight['L'][0], flight['t']
    camera, tracker = camera_of(flight), tracker_of(flight)

    def state(body: dict[str, Any], stamp: float) -> tuple[Array, Any]:
        return (motion_of.at(time, body['p'], stamp)[0],
                motion_of.rot_at(time, body['R'], stamp))

    noise, off = np.random.default_rng(0), []
    with np.load(DATA / 'room_hd.npz') as file:
        ends = np.cumsum(file['sizes'])
        for k, stamp in enumerate(file['stamps'][:IMAGES].tolist()):
            for at in np.arange(stamp - 0.05, stamp + 0.011, 0.01):
                place, attitude = state(own, at)
                tracker.feed_odometry(OdometrySample(
                    at, place, attitude.as_quat()[0], motion_of.vel(time, own['p'], at)[0],
                    motion_of.rate(time, own['R'], at)[0]))
            light = light_of(file['jpg'], ends, k)
            if k == 0 and cells:
                side = math.dist(*motion_of.corners(flight, stamp)[0][:2])
                light = smeared(light, cells * side / 6.0, direction)
            level = 255.0 * np.clip(1.2 * light, 0.0, 1.0)**(1.0 / 2.2)
            level += noise.normal(0.0, 3.0, level.shape)
            image = np.clip(np.rint(level), 0, 255).astype(np.uint8)
            estimate = tracker.process_image(stamp, image, camera).estimates['leader']
            _, attitude = state(leader, stamp)
            off.append(angle(estimate.pose, Transform(attitude.as_matrix()[0])))
    assert max(off[1:]) < math.radians(20.0)
    assert max(off[4:]) < math.radians(5.0)


@pytest.mark.parametrize(('name', 'effect'), [
    *((name, 'finger') for name in ('room_hover', 'room_tag', 'room_hd')),
    ('room_hover', 'blur2'), ('room_hd', 'blur2'), ('room_tag', 'blur15')])
def test_covered_or_smeared_leader_is_measured_in_0_3_s(name: str, effect: str) -> None:
    motion_of, tool = load_module(DATA / 'traj.py'), load_module(DATA / 'bag.py')
    flight = motion_of.flight(name)
    own, time, random = flight['F'], flight['t'], np.random.default_rng(1)
    camera, tracker = camera_of(flight), tracker_of(flight)
    with np.load(DATA / f'{name}.npz') as file:
        ends, stamps = np.cumsum(file['sizes']), file['stamps'].tolist()
        for k, stamp in enumerate(stamps):
            assert stamp - stamps[0] < 0.3, 'not measured'
            for at in np.arange(stamp - 0.05, stamp + 0.011, 0.01):
                tracker.feed_odometry(OdometrySample(
                    at, motion_of.at(time, own['p'], at)[0],
                    motion_of.rot_at(time, own['R'], at).as_quat()[0],
                    motion_of.vel(time, own['p'], at)[0], motion_of.rate(time, own['R'], at)[0]))
            light = tool.effect(effect, light_of(file['jpg'], ends, k), k, stamp, flight, random)
            image = tool.sensor(light, 1.5, 10000.0, 8.0, random)
            if tracker.process_image(stamp, image, camera).estimates:
                break

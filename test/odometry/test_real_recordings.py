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
Recorded odometry is read as truth.yaml tells of it; tags on walls, seen meanwhile, are at rest.

The recordings are not in this repository (../shared/data/real/vio).
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from real_vio import FOLDER, Recording, scatter, seen_tags, velocity_rms

from flock_follower.odometry.derivation import AUTO, NONE, ODOM
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.perception.time_offset import TimeOffset

if not (FOLDER / 'truth.yaml').exists():
    pytest.skip('the recordings (../shared/data/real) are not here', allow_module_level=True)
pytestmark = pytest.mark.slow
FLIGHT, WALK = 'vio/flight_fla_vio.bag', 'vio/walk_t265.bag'
#: The walk's images are stamped so much later than its odometry, s: with this the tag on the wall
#: is within 3 cm RMS of one place, without it within 22 cm.
LATE = 0.48


@cache
def recorded(name: str) -> Recording:
    return Recording(name)


def source_of(name: str, frame: str = AUTO) -> OdometrySource:
    source = OdometrySource(SourceParams(twist_frame=frame))
    source.place_child(recorded(name).T_base_child)
    return source


@pytest.mark.parametrize(('name', 'most'), [(FLIGHT, 11.0), (WALK, 1.5)])
def test_the_frame_of_the_velocity_is_found_and_kept(
        name: str, most: float) -> None:
    # The quadrotor stands on the ground for 9 s.
    truth = recorded(name).truth['odom']
    source, start = source_of(name), recorded(name).odometry[0][0]
    for arrival, message in recorded(name).odometry:
        source.take(message, arrival)
        if arrival - start > most * 1e9:
            assert source.twist.frame == truth['twist_frame'], source.twist.describe
    assert ('angular velocity' in source.missing) == (truth['angular_rates'] == 'zeros')


def test_velocity_from_positions_is_near_that_of_messages() -> None:
    derived, sent, off = source_of(FLIGHT, NONE), source_of(FLIGHT, ODOM), []
    for arrival, message in recorded(FLIGHT).odometry:
        one, other = derived.take(message, arrival), sent.take(message, arrival)
        assert one is not None
        assert other is not None
        off.append(one.velocity - other.velocity)
    assert np.sqrt(np.mean(np.sum(np.array(off[20:])**2, axis=1))) < 0.11


def test_wall_tags_are_at_rest_though_images_are_stamped_late() -> None:
    offset = TimeOffset()
    found = seen_tags(recorded(FLIGHT), source_of(FLIGHT).take, time_offset=offset, shift=0.05)
    assert offset.estimate == pytest.approx(0.004 - 0.05, abs=0.003)
    assert offset.deviation < 0.001
    assert len(found) > 1100
    assert velocity_rms(found) < 0.1  # while the offset is learned
    assert scatter(found) < 0.08  # its odometry corrects itself by 29 cm meanwhile


def test_tag_of_walk_is_at_rest_with_odometry_stamps() -> None:
    recording = Recording(WALK)
    recording.tags = [tag._replace(stamp=tag.stamp - round(LATE * 1e9)) for tag in recording.tags]
    found = seen_tags(recording, source_of(WALK).take)
    assert len(found) > 25
    assert velocity_rms(found) < 0.25  # odometry comes four times per second
    assert scatter(found) < 0.08

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

"""Perception, planner and gate on the bag's clock: input that stops."""

from __future__ import annotations

from pathlib import Path

from bag_excerpts import Change, excerpt
import numpy as np
import pytest

from flock_desk.follower import Follower
from flock_desk.runs.evaluation import evaluate, Evaluation, STATES
from flock_follower.bags.bag import BagMessage
from flock_follower.messages import OdometryState
from flock_follower.parameters.files import parse_parameters
from flock_follower.parameters.flight_parameters import TABLE

IMAGE, ODOM = '/image_raw/compressed', '/odom'


def played(folder: Path, seconds: float, change: Change) -> Evaluation:
    # The bag is too short to find out the frame of the twist.
    values = parse_parameters({'/**': {'ros__parameters': {'odom_twist_frame': 'child'}}}, TABLE)
    return evaluate(excerpt(folder / 'bag', seconds, change), values, folder / 'result.mcap',
                    with_check=False)


def stops(topic: str, after: float) -> Change:
    """Return a change that leaves out a topic after so many seconds."""
    began: list[int] = []

    def change(message: BagMessage) -> BagMessage | None:
        began.append(message.stamp_ns)
        late = message.stamp_ns - began[0] > after * 1e9
        return None if late and message.topic == topic else message
    return change


def test_an_error_in_the_follower_is_no_fault_of_a_message(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Follower, time: int, state: OdometryState) -> None:
        raise np.linalg.LinAlgError('Singular matrix')  # a ValueError
    monkeypatch.setattr(Follower, 'odometry', fail)
    with pytest.raises(np.linalg.LinAlgError):
        played(tmp_path, 0.1, lambda message: message)


def test_images_wait_then_drop_when_odometry_stops(tmp_path: Path) -> None:
    flight = played(tmp_path, 4.0, stops(ODOM, 0.6))
    assert flight.rejections['odometry has not reached the image stamp'] + flight.rejections[
        'odometry lags behind the images'] > 90
    assert flight.states[-1][1] == 'HOLD' and flight.frames == 120
    assert min(flight.setpoint_kinds[kind] for kind in ('command', 'level')) > 5
    assert flight.setpoints[-1, 4] == 0.0 and flight.setpoint_kinds['none'] > 0


def test_when_images_cease_the_planner_brakes_at_once(tmp_path: Path) -> None:
    flight = played(tmp_path, 1.2, stops(IMAGE, 0.7))
    time, reason = flight.reasons[0]
    assert reason == 'no image processed for 0.20 s'
    # Odometry may have let the last image wait for a moment; but no tick is waited for.
    assert 0.86 < time < 0.93 and abs(time * 10 - round(time * 10)) > 0.01
    ticks = flight.ticks
    assert set(ticks[ticks[:, 0] >= time, 1]) == {STATES.index('HOLD')}

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

"""The bridge node as a real process: topics in, and what pymavlink decodes on the wire."""

from __future__ import annotations

from collections.abc import Iterator
import math
import time

from bridge_rig import COMMAND, make_command, Rig
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest
from rclpy.node import Node

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def one_rig(ros: None) -> Iterator[Rig]:
    rig = Rig()
    # The autopilot is in OFFBOARD as the bridge starts: nothing is sent until that is asked for.
    rig.wait(lambda: rig.states.count('INACTIVE: offboard was not requested') >= 4,
             (0.3, 0.0, 0.0))
    assert not rig.setpoints()
    yield rig
    rig.close()


@pytest.fixture
def rig(one_rig: Rig) -> Rig:
    """Return the rig, ACTIVE: between two tests it was handed over, for want of commands."""
    one_rig.yaw = 0.0
    one_rig.permit()
    return one_rig


def test_enu_commands_leave_in_ned(rig: Rig) -> None:
    # No climb: a vehicle that does not obey it looks like one with a wrong hover thrust.
    for acceleration, yaw, heading in (((0.3, 0.0, 0.0), 0.0, math.pi / 2),
                                       ((0.0, 0.3, 0.0), math.pi / 2, 0.0)):
        rig.yaw = yaw
        last = rig.wait_for_setpoint(*acceleration[:2], acceleration)
        assert (last.type_mask, last.coordinate_frame) == (0x83F, mavlink.MAV_FRAME_LOCAL_NED)
        assert (last.target_system, last.get_srcComponent()) == (1, 191)
        assert last.yaw == pytest.approx(heading, abs=1e-6)


def test_commands_at_ten_hertz_are_sent_at_once_in_a_stream_without_gaps(rig: Rig) -> None:
    rig.wait_for_setpoint(0.3, 0.0, (0.3, 0.0, 0.0))
    start = time.monotonic()
    rig.run(3.0, (0.3, 0.0, 0.0))
    times = [t for t, m in rig.received
             if t >= start and m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED']
    # Percentiles: where the whole machine stands still, cycles are left out, not made up for.
    # A new command is sent at once and begins a new period, but never within 20 ms.
    gaps = np.diff(times)
    assert np.percentile(gaps, 75) <= 0.056 and np.percentile(gaps, 5) >= 0.015
    assert sum(t >= start and m.get_type() == 'HEARTBEAT' for t, m in rig.received) in (2, 3, 4)
    rig.wait(lambda: 'tick_latency_p50_ms' in rig.values, (0.3, 0.0, 0.0))
    assert 0.0 < float(rig.values['tick_latency_p50_ms']) < 40.0
    assert rig.values['setpoint'] == 'command' and rig.values['mode'] == 'OFFBOARD'


@pytest.mark.parametrize(('acceleration', 'age', 'reason'), [
    ((math.nan, 0.0, 0.0), 0.0, 'command not finite'),
    ((0.3, 0.0, 0.0), 0.5, 'command too old'),
    (None, 0.0, 'invalid command/trajectory')])
def test_commands_that_must_not_fly_are_counted_and_the_vehicle_brakes(
        rig: Rig, acceleration: tuple[float, ...] | None, age: float, reason: str) -> None:
    rig.wait_for_setpoint(0.3, 0.0, (0.3, 0.0, 0.0), forward=0.3)
    counter = f'rejected: {reason}'

    def rejected() -> bool:
        if acceleration is None:
            rig.commands.publish(COMMAND())
        return counter in rig.values
    rig.wait(rejected, acceleration, forward=0.3, age=age)
    rig.wait_for_setpoint(-1.0, 0.0, acceleration, forward=0.3, age=age)
    braking = time.monotonic()
    rig.run(0.4, acceleration, forward=0.3, age=age)
    assert all(m.afx == 0.0 and -1.0 - 1e-6 <= m.afy <= 0.0 for m in rig.setpoints(braking))


def test_the_limits_can_be_lowered_in_flight(rig: Rig) -> None:
    rig.wait_for_setpoint(0.5 / 0.3, 0.0, (9.0, 0.0, 0.0))
    refused = rig.set_parameter('a_max', -1.0)
    assert not refused.successful and 'must be a number in [0.01, 20]' in refused.reason
    assert rig.set_parameter('a_max', 0.8).successful
    rig.wait_for_setpoint(0.8, 0.0, (9.0, 0.0, 0.0))
    raised = rig.set_parameter('a_max', 2.5)
    assert not raised.successful and 'in flight it can only be lowered' in raised.reason


def test_a_second_node_that_commands_makes_it_brake_and_is_named(rig: Rig) -> None:
    rig.wait_for_setpoint(0.3, 0.0, (0.3, 0.0, 0.0), forward=0.3)
    second = Node('second', namespace='rig')
    publisher = second.create_publisher(COMMAND, 'command/trajectory', 1)
    rig.wait(lambda: publisher.get_subscription_count() == 1, (0.3, 0.0, 0.0), forward=0.3)
    commanded = time.monotonic()

    def brakes() -> bool:
        if rig._is_due('second', 0.1):
            now = second.get_clock().now().nanoseconds
            publisher.publish(make_command(now, (0.8, 0.0, 0.0)))
        return rig.setpoints()[-1].afy < 0.0
    rig.wait(brakes, (0.3, 0.0, 0.0), forward=0.3)
    assert rig.received[-1][0] - commanded < 0.3
    assert max(m.afy for m in rig.setpoints(commanded)) < 0.31  # none of the second one's
    rig.wait(lambda: rig.states[-1] == ('READY: giving back: two nodes command: /rig/planner, '
                                        '/rig/second on /rig/command/trajectory'),
             (0.3, 0.0, 0.0), forward=0.3)
    second.destroy_node()
    rig.run(1.0, (0.3, 0.0, 0.0), forward=0.3)
    assert rig.states[-1] != 'ACTIVE'  # until it is asked

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

"""Malformed messages into every callback of the nodes; ``make fuzz`` sends more."""

from fuzz_nodes import fuzz_node, node_under_fire, NODES
from nav_msgs.msg import Odometry
import pytest

# Overflows and NaN in the middle of a calculation are no errors if its result is discarded.
pytestmark = [pytest.mark.filterwarnings('ignore::RuntimeWarning'), pytest.mark.usefixtures('ros')]
COUNT = {'mavlink_bridge': 2000}  # else 1000
#: What shows that the messages reached the depths of a node, by what it published.
REACHED = {'planner': {'MultiDOFJointTrajectory': 100}, 'mavlink_bridge': {},
           'relative_pose': {'Odometry': 5}, 'relative_pose compressed': {'Odometry': 5},
           'sharing': {'Odometry': 25}}


@pytest.mark.parametrize('kind', NODES)
def test_no_message_breaks_node_or_yields_bad_command(kind):
    count = COUNT.get(kind, 1000)
    under_fire = fuzz_node(kind, count, 1)
    for name, least in REACHED[kind].items():
        assert under_fire.published[name] >= least
    counters = under_fire.node.diagnostics.counters
    assert sum(counters.values()) > count // 10
    if kind == 'mavlink_bridge':
        assert min(under_fire.sent[kind] for kind in (
            'SET_POSITION_TARGET_LOCAL_NED', 'ODOMETRY')) > 10
        wrong = [f'command {why}' for why in ('not finite', 'too old', 'from the future')]
        for seed in range(2, 6):  # a vehicle that is starved of time leaves the mode early
            if min(counters[why] for why in wrong) > 0:
                break
            counters += fuzz_node(kind, count, seed).node.diagnostics.counters
        assert min(counters[why] for why in wrong) > 0  # they reached the gate


@pytest.mark.parametrize('kind', ['planner', 'relative_pose', 'sharing'])
def test_one_impossible_odometry_does_no_lasting_damage(kind):
    def spoil(message):
        if isinstance(message, Odometry):
            message.twist.twist.linear.z = 1.7e308
    with node_under_fire(kind, 1) as under_fire:
        for _ in range(20):
            under_fire.tick()
        before = under_fire.published['Odometry']
        assert before > 0 or kind == 'planner'
        under_fire.tick(spoil)
        assert under_fire.published['Odometry'] <= before + 1
        assert under_fire.recovers()

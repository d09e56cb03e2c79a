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
The states that the bridge reports to other nodes and programs.

``mavlink_bridge/state`` reports whether the vehicle flies the planner's commands. Its text is a
state and, after a colon, the reason::

    NO_AUTOPILOT: none received yet
    INACTIVE: offboard was not requested
    READY: waiting for offboard mode
    ACTIVE
    TAKEN_OVER: offboard was left for POSCTL

The bridge publishes its state at each change, and at 2 Hz, because the latched topic would show
``ACTIVE`` after the end of a bridge. Only ``bridge_reading`` reads these texts.
"""

from __future__ import annotations

from typing import Final

NO_AUTOPILOT, INACTIVE, READY, ACTIVE, TAKEN_OVER = BRIDGE_STATES = (
    'NO_AUTOPILOT', 'INACTIVE', 'READY', 'ACTIVE', 'TAKEN_OVER')
TOPIC = 'mavlink_bridge/state'
#: Where the vehicle was armed, in the frame of the odometry; latched.
ARMED_AT_TOPIC = 'mavlink_bridge/armed_at'
#: Begins the reason after an autopilot was received; the state before follows.
LOST: Final = 'lost, '

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
CURRENT_MODE: the flight mode alone, told as soon as it changes.

PX4 refuses HEARTBEAT faster than 1 Hz, but sends this one when the mode changes, and at 2 Hz
besides, however often it is asked for. ``common.xml`` has it; the ``common`` of released
pymavlink has not yet, its ``development`` has. Loading this module makes ``common`` decode it.
"""

from __future__ import annotations

from typing import Final

from pymavlink.dialects.v20 import common as mavlink
from pymavlink.dialects.v20 import development

MESSAGE_ID: Final[int] = development.MAVLINK_MSG_ID_CURRENT_MODE

mavlink.mavlink_map.setdefault(MESSAGE_ID, development.MAVLink_current_mode_message)

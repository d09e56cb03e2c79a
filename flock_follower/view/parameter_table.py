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

"""The parameters of view."""

from __future__ import annotations

from typing import Final

from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range

VIEW: Final = [
    Spec('host', '127.0.0.1',
         'address to serve the page on; beyond loopback (0.0.0.0: all interfaces) a token is '
         'needed for reading, too: an ssh tunnel to 127.0.0.1 is safer'),
    Spec('port', 8090, 'TCP port of the page; 0: any that is free', Range(0, 65535)),
    Spec('control', False,
         'true: the page has the buttons Brake (planner/engage false) and Land '
         '(mavlink_bridge/land), for the address with the token that the node prints'),
]

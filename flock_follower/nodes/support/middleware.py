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

"""The transport of Fast DDS for a process that must not wait: UDP, not shared memory."""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

from flock_follower.system.fast_dds import PROFILE_VARIABLES, profile_variables
from flock_follower.system.files import resource

_FAST_DDS = 'rmw_fastrtps_cpp'
_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_OWN_PROFILE = 'config/dds/fastdds.xml'
UDP_PROFILE = 'config/dds/fastdds_udp.xml'


def avoid_shared_memory(environment: MutableMapping[str, str]) -> None:
    """
    Restrict Fast DDS to UDP; call this before ``rclpy.init`` with ``os.environ``.

    When Fast DDS 2.14 first sends to another process, it tests the shared-memory port of that
    process, sometimes for 333 ms; if the process was killed, for 1 s. Meanwhile the publisher
    waits and holds the GIL, so the whole process stops (eProsima/Fast-DDS issue 6535). Other
    middleware, and the user's own settings, are not changed; ``opened_segment_names`` shows the
    result.

    :param environment: changed in place.
    """
    get = environment.get
    if not get('RMW_IMPLEMENTATION', _FAST_DDS).startswith('rmw_fastrtps') or (
            'FASTDDS_BUILTIN_TRANSPORTS' in environment):
        return
    profiles = [environment[name] for name in PROFILE_VARIABLES if name in environment]
    own = all(map(_is_own, profiles))
    if get('ROS_LOCALHOST_ONLY') == '1' or get(_RANGE, '').upper() == 'LOCALHOST':
        # Here rmw_fastrtps adds shared memory by itself: the profile keeps it local instead.
        if own and not get('ROS_STATIC_PEERS'):
            environment.update(profile_variables(UDP_PROFILE))
            environment[_RANGE] = 'SYSTEM_DEFAULT'
            environment.pop('ROS_LOCALHOST_ONLY', None)
    elif own and profiles:
        environment.update(profile_variables(UDP_PROFILE))
    else:
        environment['FASTDDS_BUILTIN_TRANSPORTS'] = 'UDPv4'


def _is_own(profile: str) -> bool:
    """Return whether a file is this package's profile, or a copy of it."""
    try:
        return Path(profile).read_bytes() == resource(_OWN_PROFILE).read_bytes()
    except OSError:
        return False

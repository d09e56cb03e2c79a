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

"""The transport of Fast DDS for a process that takes images and must not wait."""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

from flock_follower.nodes.support.middleware import avoid_shared_memory, UDP_PROFILE
from flock_follower.system.fast_dds import PROFILE_VARIABLES, profile_variables

#: With a receive buffer for images: for ROS on this computer alone, and otherwise.
_UDP_IMAGES_PROFILE = 'config/dds/fastdds_udp_images.xml'
_IMAGES_PROFILE = 'config/dds/fastdds_images.xml'
IMAGES_BUFFER: Final = 4 * 1024 * 1024


def avoid_shared_memory_for_images(environment: MutableMapping[str, str], most: int) -> bool:
    """
    As ``avoid_shared_memory``, with a buffer for images; return whether the kernel allows it.

    If not, nothing is changed: without the buffer an image of 300 kB rarely arrives completely.

    :param most: the largest receive buffer that the kernel allows, bytes.
    """
    if most < IMAGES_BUFFER:
        return False
    avoid_shared_memory(environment)
    if profile_variables(UDP_PROFILE).items() <= environment.items():
        environment.update(profile_variables(_UDP_IMAGES_PROFILE))
    elif environment.keys().isdisjoint(PROFILE_VARIABLES):
        environment.update(profile_variables(_IMAGES_PROFILE))
    return True


def receive_buffer_max() -> int:
    """Return the largest receive buffer that the kernel allows, bytes."""
    try:
        return int(Path('/proc/sys/net/core/rmem_max').read_text(encoding='ascii'))
    except OSError:
        return 0

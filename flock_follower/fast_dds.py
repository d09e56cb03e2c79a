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

"""Names of Fast DDS that differ between version 2 (ROS 2 Jazzy) and 3 (Kilted)."""

from __future__ import annotations

from typing import Final

from flock_follower.files import resource

#: Variables that name a profile. Fast DDS 3 prefers the first; Fast DDS 2 reads the second alone.
PROFILE_VARIABLES: Final = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
#: How its files in /dev/shm begin.
SEGMENT_PREFIXES: Final = ('fastdds_', 'fastrtps_')


def profile_variables(relative: str) -> dict[str, str]:
    """Return the variables for a profile that the package ships, such as 'config/fastdds.xml'."""
    return dict.fromkeys(PROFILE_VARIABLES, str(resource(relative)))

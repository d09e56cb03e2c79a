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
Bird-flocking control of a follower drone that sees its leader with one camera.

This package contains all code that flies; ``flock_desk`` holds the simulators.
``docs/architecture.md`` follows an image, and a lost leader, through the functions, and names the
file for each kind of change. ``test/test_rooms.py`` lists what each folder may import.
"""

from flock_follower import signals  # noqa: F401  # first: Ctrl-C during the other imports

__version__ = '0.1.0'

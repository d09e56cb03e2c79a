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
The desk: simulators and commands that test the follower before it flies.

It imports ``flock_follower``, which never imports the desk. Modules beside the folders are the
commands (``python -m flock_desk.NAME``), the embedded autopilot and two nodes.
"""

from flock_follower import signals  # noqa: F401  # first: Ctrl-C during the other imports

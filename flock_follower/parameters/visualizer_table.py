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

"""The parameters of the visualizer; the cameras and the band it asks of the other nodes."""

from __future__ import annotations

from flock_follower.parameters.spec import Spec

AUTO, ALWAYS, NEVER = ODOM_TF = 'auto', 'always', 'never'

SPECS = [
    Spec('rate', 10.0, 'of markers and transforms, while someone looks', 'Hz', 1.0, 50.0,
         read_only=True),
    Spec('odom_tf', AUTO, 'whether to broadcast odom -> base_link: auto, while no other node '
         'publishes on /tf (an odometry normally does); always; never', choices=ODOM_TF,
         read_only=True),
]

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

"""It does what ``dataclasses.replace`` does."""

from __future__ import annotations

import dataclasses

from flock_follower.planner.memory import Memory
from flock_follower.planner.params import replace
from flock_follower.planner.vertical_yaw import Altitude


def test_it_is_dataclasses_replace() -> None:
    altitude = Altitude(2.0, 1.0, 3.0, 0.1)
    changed = replace(altitude, held=2.5, lift=0.2)
    assert changed == dataclasses.replace(altitude, held=2.5, lift=0.2)
    assert altitude == Altitude(2.0, 1.0, 3.0, 0.1)


def test_those_that_it_is_used_for_have_nothing_to_check() -> None:
    for each in (Altitude, Memory):
        assert not hasattr(each, '__post_init__') and not hasattr(each, '__slots__')

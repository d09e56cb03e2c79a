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

"""What dies in flight without a word is noticed: a braking setpoint leaves within 300 ms."""

from __future__ import annotations

from pathlib import Path

from kills import braking_times, LIMIT, VICTIMS
import pytest

pytestmark = pytest.mark.slow


def test_kill_of_planner_perception_or_replay_brakes_in_300_ms(tmp_path: Path) -> None:
    for victim, seconds in braking_times(len(VICTIMS), 0, tmp_path):
        assert 0.0 < seconds <= LIMIT, victim

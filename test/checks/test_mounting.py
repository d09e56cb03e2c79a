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

"""Each axis of the mounting is judged by itself."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.checks.findings import ERROR, OK, UNMEASURED, WARNING
from flock_follower.checks.own_motion import check_mounting


@pytest.mark.parametrize(('turn', 'deviations', 'level', 'named', 'unknown'), [
    ((0.0, 10.0, 0.0), (0.5, 1.43, 0.5), ERROR, 'looks lower by 10 deg', ''),  # 7 deviations
    ((0.0, 0.0, -10.0), (0.5, 0.5, 1.43), ERROR, 'looks further right by 10 deg', ''),
    ((5.0, 0.0, 0.0), (1.0, 9.0, 1.0), WARNING, 'rolled right by 5 deg', 'pitch unknown'),
    ((5.0, 3.0, 20.0), (1.0, 1.0, 9.0), WARNING, 'rolled right by 5 deg', 'yaw unknown'),
    ((1.0, 3.0, 20.0), (1.0, 2.0, 9.0), UNMEASURED, '', 'pitch, yaw unknown'),
    ((1.0, 3.0, 2.0), (1.0, 1.0, 1.0), OK, '', '')])
def test_axis_beyond_margin_is_named_open_one_is_unknown(
        turn: tuple[float, ...], deviations: tuple[float, ...], level: str, named: str,
        unknown: str) -> None:
    found = check_mounting(np.radians(turn), np.radians(deviations), [0.0, 0.0, 0.0])
    assert found.level == level
    assert named in found.measured and unknown in found.measured
    assert found.measured.count(' deg than ') == bool(named)
    assert ('unknown' in found.measured) is bool(unknown)

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

"""What ``benchmarks/stack.py`` takes for late, and for missed."""

from pathlib import Path
import runpy

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / 'benchmarks'


@pytest.fixture(scope='module')
def lateness():
    return runpy.run_path(str(BENCHMARKS / 'stack.py'))['lateness']


@pytest.mark.parametrize('start', [0.0, 0.03, 1_700_000_000.07])
def test_who_is_late_is_late_by_that_much_and_misses_nothing(lateness, start):
    times = start + 0.1 * np.arange(300)
    times[150] += 0.03
    times[151] += 0.085
    told = lateness(times, 0.1)
    assert (told['count'], told['missed']) == (300, 0)
    assert told['late_max_ms'] == pytest.approx(85.0, abs=0.1)
    assert told['late_p50_ms'] == pytest.approx(0.0, abs=0.1)
    assert told['late_p99_ms'] < 1.0


def test_what_does_not_come_is_missed(lateness):
    times = np.delete(0.05 * np.arange(400), [20, 100, 101])
    told = lateness(times, 0.05)
    assert (told['count'], told['missed']) == (397, 3)
    assert told['late_max_ms'] == pytest.approx(0.0, abs=0.01)

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

"""The result of the sample bag stays what it is, with every version of OpenCV."""

from __future__ import annotations

from importlib.util import find_spec

import cv2
import golden_result
from golden_result import Row
import numpy as np
import pytest

pytestmark = pytest.mark.slow
MOVED = 'run `make bless` if it is meant to move'
MILLIMETER = 1e-3


def worst(rows: list[Row], golden: list[Row], numbers: slice = slice(None)) -> tuple[float, str]:
    """Return the largest difference, and what and when it is, in words."""
    assert [row[:2] for row in rows] == [row[:2] for row in golden], MOVED
    moved = [float(np.max(np.abs(np.subtract(row[2], want[2]))[numbers]))
             for row, want in zip(rows, golden)]
    k = int(np.argmax(moved))
    topic, time, _ = golden[k]
    return moved[k], f'{topic} at {time / 1e9:.3f} s moved by {moved[k]:.2g}: {MOVED}'


ALL_INSTALLED = find_spec('pymavlink') is not None


@pytest.fixture(scope='module')
def result() -> list[Row]:
    """Return all that is published, or the neighbors where only perception is installed."""
    return golden_result.result() if ALL_INSTALLED else golden_result.neighbors()


@pytest.mark.skipif(not ALL_INSTALLED, reason='only perception is installed')
def test_nothing_that_is_published_moves_by_more_than_1e_4(result: list[Row]) -> None:
    golden = golden_result.read()
    assert len(golden) > 3 * 100
    moved, where = worst(result, golden)
    assert moved < 1e-4, where


def test_positions_agree_within_a_millimeter_with_any_opencv(result: list[Row]) -> None:
    golden, rows = ([row for row in rows if row[0] == '/neighbors']
                    for rows in (golden_result.read(), result))
    moved, where = worst(rows, golden, slice(0, 3))
    assert moved < MILLIMETER, f'OpenCV {cv2.__version__}: {where}'

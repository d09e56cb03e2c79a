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

"""A bag with several cameras: its topics are told by parameters, and both are looked at."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bag_excerpts import edited, SAMPLE
import cv2
import numpy as np
import pytest
import yaml

from flock_desk.evaluate import main
from flock_follower.bags.bag import BagMessage, open_bag
from flock_follower.bags.writer import BagWriter
from flock_follower.check import main as check

pytestmark = pytest.mark.slow
GRAY = cv2.imencode('.jpg', np.full((480, 640), 128, dtype=np.uint8))[1].ravel()
CAMERAS = {'cameras': ['front', 'left'], 'camera': {
    'front': {'image': 'front/image_raw'},
    'left': {'image': '/port/mono', 'camera_info': '/port/info', 'rpy': [0.0, 0.0, 1.2]}}}


def both(message: BagMessage) -> list[BagMessage]:
    """Return a message of one camera as of two, of which the left one sees nothing."""
    if message.topic == '/camera_info':
        return [message._replace(topic=topic) for topic in ('/front/camera_info', '/port/info')]
    if message.topic == '/image_raw/compressed':
        def empty(fields: Any) -> None:
            fields.data = GRAY
        return [message._replace(topic='/front/image_raw/compressed'),
                edited(message, empty)._replace(topic='/port/mono/compressed')]
    return [message]


def evaluated(bag: Path, out: Path, *options: str) -> dict[str, Any]:
    assert main([str(bag), '--output', str(out), *options]) == 0
    loaded: dict[str, Any] = json.loads((out / 'summary.json').read_text())
    return loaded


def config(path: Path, **parameters: Any) -> str:
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': {**CAMERAS, **parameters}}}))
    return str(path)


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a bag of one camera, and the same of two."""
    one, two = (tmp_path_factory.mktemp('bags') / name for name in ('one', 'two'))
    with open_bag(SAMPLE) as bag, BagWriter(one) as alone, BagWriter(two) as together:
        for message in bag.messages(stop_ns=bag.start_ns + 1_200_000_000):
            alone.write(message.topic, message.msgtype, message.stamp_ns, message.data)
            for each in both(message):
                together.write(each.topic, each.msgtype, each.stamp_ns, each.data)
    return one, two


@pytest.mark.usefixtures('undrawn')
def test_a_second_camera_that_sees_nobody_changes_nothing(
        bags: tuple[Path, Path], tmp_path: Path) -> None:
    alone = evaluated(bags[0], tmp_path / 'one')
    together = evaluated(bags[1], tmp_path / 'two', '--config', config(tmp_path / 'two.yaml'))
    assert (alone['frames'], together['frames']) == (36, 72)
    assert together['frames_in_view'] == alone['frames_in_view'] == 36
    assert together['recall'] == alone['recall'] == 1.0
    for key in ('distance_rms_m', 'position_rms_m', 'velocity_rms_m_s', 'nees_position'):
        assert together[key] == pytest.approx(alone[key], rel=1e-9), key
    assert together['planner']['states'] == alone['planner']['states']
    assert together['rejections'] == alone['rejections']


def test_a_topic_that_is_missing_is_named_with_its_camera(
        bags: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = config(tmp_path / 'wrong.yaml', camera={
        **CAMERAS['camera'], 'left': {'rpy': [0.0, 0.0, 1.2]}})  # type: ignore[dict-item]
    assert main([str(bags[1]), '--output', str(tmp_path / 'out'), '--config', wrong]) == 2
    reported = capsys.readouterr().err
    assert 'no message on /left/image_raw or /left/image_raw/compressed of camera left' in reported
    assert '/port/mono/compressed' in reported


@pytest.mark.parametrize(('camera', 'code', 'reported'), [
    ('', 0, ['/front/image_raw/compressed, 36 ', 'in 100% of ']),
    ('left', 0, ['/port/mono/compressed, 36 ', '/port/info, 36 ', 'not in sight in ']),
    ('back', 2, ['error: camera back: must be one of front, left'])], ids=str)
def test_check_looks_at_one_of_them(bags: tuple[Path, Path], tmp_path: Path, camera: str,
                                    code: int, reported: list[str],
                                    capsys: pytest.CaptureFixture[str]) -> None:
    options = ['--camera', camera] if camera else []
    assert check([str(bags[1]), '--config', config(tmp_path / 'two.yaml'), *options]) == code
    out, err = capsys.readouterr()
    shown = ' '.join((out + err).split())
    for text in reported:
        assert text in shown, shown

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

"""The recorder as a process: what it heard is in the bag, however it ends."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import signal
import subprocess
import sys

import pytest
from rcl_interfaces.srv import ListParameters
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import String

from flock_desk.runs.processes import wait_until
from flock_follower.bags.bag import open_bag
from flock_follower.nodes import SHUTDOWN_TIMEOUT

WORDS = 'words:std_msgs/msg/String'
#: A recorder that runs as a program, after some lines of Python.
PROGRAM = """
import sys
sys.argv = ['flock_follower/recorder', *sys.argv[1:]]
from flock_desk import recorder_node as recorder
{}
sys.exit(recorder.main(sys.argv[1:]))
"""
SLOW = f"""
import time
from flock_follower.bags import writer as bags
describe = bags.describe

def slow(folder, files):  # as a recording of some gigabytes is
    time.sleep({SHUTDOWN_TIMEOUT} + 1.0)
    describe(folder, files)

bags.describe = slow
"""
FULL = """
import errno
import os
from flock_follower.bags import writer
write = writer.McapFile.write

def write_a_few(self, messages):
    if self.counts.total() == 5:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    write(self, messages)

writer.CHUNK = 1  # byte: each message is written at once
writer.McapFile.write = write_a_few
"""


class Speaker:
    """Publishes words to a recorder."""

    def __init__(self) -> None:
        self.node = Node('speaker')
        self.words = self.node.create_publisher(String, 'words', 100)
        self.processes: list[subprocess.Popen[str]] = []

    def record(self, patch: str, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, '-c', PROGRAM.format(patch), *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.processes.append(process)
        return process

    def say(self, count: int) -> None:
        wait_until(lambda: self.words.get_subscription_count() > 0, 20.0, 'the recorder')
        for i in range(count):
            self.words.publish(String(data=str(i)))
        assert self.words.wait_for_all_acked(Duration(seconds=10.0))

    def wait_for_answer(self) -> None:
        """Wait for any answer of the recorder: it serves after it has taken what it heard."""
        client = self.node.create_client(ListParameters, 'recorder/list_parameters')
        assert client.wait_for_service(timeout_sec=10.0)
        future = client.call_async(ListParameters.Request())
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=10.0)
        assert future.done()


@pytest.fixture
def speaker(ros: None) -> Iterator[Speaker]:
    made = Speaker()
    yield made
    for process in made.processes:
        process.kill()
        process.communicate()
    made.node.destroy_node()


def words(path: Path) -> list[str]:
    with open_bag(path) as bag:
        return [m.data[8:].rstrip(b'\0').decode() for m in bag.messages()]


def test_a_bag_that_takes_longer_to_close_than_a_shutdown_may_is_closed(
        speaker: Speaker, tmp_path: Path) -> None:
    process = speaker.record(SLOW, str(tmp_path / 'bag'), WORDS)
    speaker.say(20)
    speaker.wait_for_answer()
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=20.0)
    assert (process.returncode, 'Traceback' in error) == (0, False), error
    assert f'closing {tmp_path / "bag"}' in out
    with open_bag(tmp_path / 'bag') as bag:
        assert bag.incomplete == ''
    assert words(tmp_path / 'bag')[0] == '0'


def test_a_full_disk_ends_the_recording_and_keeps_what_it_holds(
        speaker: Speaker, tmp_path: Path) -> None:
    process = speaker.record(FULL, str(tmp_path / 'bag'), WORDS)
    speaker.say(20)
    _, error = process.communicate(timeout=20.0)
    assert process.returncode == 1
    assert error.splitlines()[-1] == (
        f'error: {tmp_path / "bag"}: No space left on device; the recording so far is kept, '
        'marked incomplete')
    assert 'Traceback' not in error
    assert words(tmp_path / 'bag') == ['0', '1', '2', '3', '4']
    text = (tmp_path / 'bag' / 'INCOMPLETE.txt').read_text()
    assert text.rstrip().endswith('bag: No space left on device')

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

"""The black box as a process: kills, a full disk, and what a recording of it holds."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from functools import partial
from pathlib import Path
import random
import signal
import subprocess
import sys
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import String

from flock_desk.runs.processes import wait_until
from flock_follower.bags.bag import BagError, deserialize, open_bag
from flock_follower.messages import NANOSECONDS
from flock_follower.parameters.files import parameters_flown, TABLE
from flock_follower.perception.images import decode_compressed

#: The black box as a program, after some lines of Python.
PROGRAM = """
import sys
sys.argv = ['black_box', *sys.argv[1:]]
from flock_follower.nodes import black_box
{}
sys.exit(black_box.main())
"""
#: A disk that is full until a file is there.
FULL = """
import errno, os
sync = os.fsync

def full(descriptor):
    if not os.path.exists({!r}):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    sync(descriptor)

os.fsync = full
black_box.RETRY_PERIOD = 0.3
"""
RATE = 100.0  # Hz
PIXELS = (np.add.outer(np.arange(480), np.arange(640)) // 5 % 256).astype(np.uint8)


class Vehicle:
    """Publishes odometry and images, and starts black boxes."""

    def __init__(self) -> None:
        self.node = Node('vehicle')
        self.odom = self.node.create_publisher(Odometry, '/vio/odom', 10)
        self.images = self.node.create_publisher(Image, '/drone1/image_raw', 1)
        self.sent = 0
        self.problems: list[str] = []
        self.processes: list[subprocess.Popen[str]] = []
        self._image = Image(height=480, width=640, step=640, encoding='mono8',
                            data=array('B', PIXELS.tobytes()))
        self._ended = threading.Event()
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._listen, 10)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self._threads = [threading.Thread(target=self.executor.spin),
                         threading.Thread(target=self._publish)]
        for thread in self._threads:
            thread.start()

    def start(self, folder: Path, patch: str = '') -> subprocess.Popen[str]:
        self.processes.append(subprocess.Popen(
            [sys.executable, '-c', PROGRAM.format(patch), '--ros-args', '-r', '__ns:=/drone1',
             '-r', 'odom:=/vio/odom', '-p', f'record_folder:={folder}', '-p', 'disk_free:=10.0'],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return self.processes[-1]

    def end(self) -> None:
        for process in self.processes:
            process.kill()
            process.communicate()
        self._ended.set()
        self.executor.shutdown()
        for thread in self._threads:
            thread.join()
        self.node.destroy_node()

    def _publish(self) -> None:
        while not self._ended.wait(1.0 / RATE):
            message = Odometry()
            message.header.stamp = self.node.get_clock().now().to_msg()
            message.pose.pose.position.x = float(self.sent)
            self.odom.publish(message)
            if self.sent % 4 == 0:
                self.images.publish(self._image)
            self.sent += 1

    def _listen(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'drone1/black_box' and status.level == DiagnosticStatus.ERROR:
                self.problems.append(status.message)


@pytest.fixture
def vehicle(ros: None) -> Iterator[Vehicle]:
    made = Vehicle()
    yield made
    made.end()


def numbers(path: Path) -> list[int]:
    """Return the numbers of the odometry messages in a recording; none where it cannot be read."""
    try:
        with open_bag(path) as bag:
            return [round(deserialize(m.data, m.msgtype).pose.pose.position.x)
                    for m in bag.messages(['odom'])]
    except BagError:
        return []


def recorded(folder: Path, number: int) -> bool:
    """Return whether a recording has begun; to read it would hold up who publishes here."""
    return any(file.stat().st_size > 100_000 for file in folder.glob(f'{number:04d}_*/*.mcap'))


def test_a_killed_black_box_has_all_but_the_last_second_and_the_next_finishes_it(
        vehicle: Vehicle, tmp_path: Path) -> None:
    chance = random.Random(3)
    for number in (1, 2):
        process = vehicle.start(tmp_path)
        wait_until(partial(recorded, tmp_path, number), 20.0, 'a recording')
        time.sleep(chance.uniform(0.0, 0.8))
        process.kill()
        killed = time.time()
        process.wait()
        path, = tmp_path.glob(f'{number:04d}_*')
        with open_bag(path) as bag:
            assert bag.incomplete.startswith('still being written')
            assert killed - bag.end_ns / NANOSECONDS < 1.0
        found = numbers(path)
        assert found == list(range(found[0], found[-1] + 1))
    first, _ = sorted(tmp_path.iterdir())
    with open_bag(first) as bag:
        assert bag.incomplete == ''


def test_a_full_disk_is_told_and_recording_goes_on_when_there_is_room(
        vehicle: Vehicle, tmp_path: Path) -> None:
    room = tmp_path / 'room'
    process = vehicle.start(tmp_path / 'box', FULL.format(str(room)))
    wait_until(lambda: len(vehicle.problems) > 2, 20.0, 'a problem')
    assert set(vehicle.problems) == {
        f'not recording to {tmp_path / "box"}: No space left on device'}
    assert not any(numbers(path) for path in (tmp_path / 'box').iterdir())
    room.touch()
    wait_until(lambda: any(numbers(path) for path in (tmp_path / 'box').iterdir()), 10.0,
               'a recording')
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=10.0)
    assert process.returncode == 0 and 'Traceback' not in error
    assert error.count('No space left on device') == 1  # at most one line per 5 s
    path, = (tmp_path / 'box').iterdir()
    with open_bag(path) as bag:
        assert bag.incomplete == ''


def test_a_recording_holds_images_latched_states_and_the_parameters_flown(
        vehicle: Vehicle, tmp_path: Path) -> None:
    planner = Node('planner', namespace='drone1')
    planner.declare_parameter('v_max', 0.75)
    planner.declare_parameter('epsilon', 1e-5)
    states = planner.create_publisher(
        String, 'planner/state', QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    states.publish(String(data='IDLE'))
    vehicle.executor.add_node(planner)
    process = vehicle.start(tmp_path / 'box')

    def kept() -> str:
        files = list((tmp_path / 'box').glob('*/parameters.yaml'))
        return files[0].read_text() if files else ''

    wait_until(lambda: 'v_max: 0.75\n' in kept(), 20.0, 'the parameters')
    assert '    epsilon: 1.0e-05\n' in kept()
    planner.undeclare_parameter('epsilon')
    planner.set_parameters([Parameter('v_max', value=0.5)])
    wait_until(lambda: 'v_max: 0.5\n' in kept(), 10.0, 'the parameters')
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=10.0)
    assert process.returncode == 0 and 'Traceback' not in error
    vehicle.executor.remove_node(planner)
    planner.destroy_node()
    path, = (tmp_path / 'box').iterdir()
    with open_bag(path) as bag:
        counts = {name: topic.count for name, topic in bag.topics.items()}
        assert bag.topics['/planner/state'].latched and counts['/planner/state'] == 1
        image = next(bag.messages(['/image_raw/compressed']))
        stamps = [m.stamp_ns for m in bag.messages(['/odom'])]
    decoded = decode_compressed(deserialize(image.data, image.msgtype).data)
    assert np.abs(decoded.astype(int) - PIXELS).mean() < 1.0
    assert counts['/image_raw/compressed'] > 5 and '/image_raw' not in counts
    assert np.all(np.diff(stamps) >= 0)
    values = parameters_flown(path, TABLE)
    assert values is not None and values['planner']['v_max'] == 0.5

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

"""Black box and recorder as processes: kills, a full disk, a slow end, contents."""

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
from full_disk import disk_of
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import String

from flock_desk import recorder_node
from flock_desk.runs.processes import wait_until
from flock_follower.bags.bag import BagError, deserialize, open_bag
from flock_follower.messages import NANOSECONDS
from flock_follower.nodes import SHUTDOWN_TIMEOUT
from flock_follower.parameters.files import parameters_flown, TABLE
from flock_follower.perception.images import decode_compressed

#: A node as a program, after some lines of Python.
PROGRAM = """
import sys
sys.argv = ['flock_follower/{name}', *sys.argv[1:]]
from {package} import {name}
{patch}
sys.exit({name}.main(sys.argv[1:]))
"""
#: A bag that takes long to close, as one of some gigabytes does.
SLOW = f"""
import time
from flock_follower.bags import writer
describe = writer.describe

def slow(folder, files):
    time.sleep({SHUTDOWN_TIMEOUT} + 0.5)
    describe(folder, files)

writer.describe = slow
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
        """Start a black box."""
        return self.run(
            'flock_follower.nodes', 'black_box', patch, '--ros-args', '-r', '__ns:=/drone1',
            '-r', 'odom:=/vio/odom', '-p', f'record_folder:={folder}', '-p', 'disk_free:=10.0')

    def run(self, package: str, name: str, patch: str,
            *arguments: str) -> subprocess.Popen[str]:
        program = PROGRAM.format(package=package, name=name, patch=patch)
        self.processes.append(subprocess.Popen(
            [sys.executable, '-c', program, *arguments],
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


def test_a_bag_that_takes_longer_to_close_than_a_shutdown_may_is_closed(
        vehicle: Vehicle, tmp_path: Path) -> None:
    process = vehicle.run('flock_desk', 'recorder_node', SLOW, str(tmp_path / 'bag'),
                          '/vio/odom:nav_msgs/msg/Odometry')
    wait_until(lambda: vehicle.odom.get_subscription_count() > 0, 20.0, 'the recorder')
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=20.0)
    assert (process.returncode, 'Traceback' in error) == (0, False), error
    assert f'closing {tmp_path / "bag"}' in out
    with open_bag(tmp_path / 'bag') as bag:
        assert bag.incomplete == '' and bag.message_count > 5


def test_a_full_disk_ends_the_recorder_and_keeps_what_it_holds(
        ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    recorder = recorder_node.Recorder(str(tmp_path / 'bag'), {'words': 'std_msgs/msg/String'})

    def fill(node: recorder_node.Recorder) -> None:
        for _ in range(10_000):
            node._write('words', 'std_msgs/msg/String', random.randbytes(1000))
    monkeypatch.setattr(recorder_node, 'spin', fill)
    with disk_of(3_000_000):
        assert recorder.record() == 1
    recorder.destroy_node()
    assert capsys.readouterr().err.splitlines()[-1] == (
        f'error: {tmp_path / "bag"}: File too large; the recording so far is kept, '
        'marked incomplete')
    with open_bag(tmp_path / 'bag') as bag:
        assert bag.incomplete and bag.message_count > 100

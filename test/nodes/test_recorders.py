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

"""Black box and recorder: kills, a full disk, a slow end, and the content of a recording."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
import errno
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

from driven import Driven, overrides, START
from full_disk import disk_of
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import String

from flock_desk import recorder_node
from flock_desk.runs.processes import wait_until
from flock_follower import nodes
from flock_follower.bags.bag import BagError, deserialize, open_bag
from flock_follower.messages import NANOSECONDS
from flock_follower.nodes import black_box
from flock_follower.nodes.support.exit_deadline import no_exit_deadline
from flock_follower.nodes.support.inputs import LATCHED_QOS
from flock_follower.parameters.files import parameters_flown
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.perception.images import decode_compressed

PIXELS = (np.add.outer(np.arange(480), np.arange(640)) // 5 % 256).astype(np.uint8)


class Vehicle:
    """Publishes numbered odometry, and starts programs."""

    def __init__(self) -> None:
        self.node = Node('vehicle')
        self.odom = self.node.create_publisher(Odometry, '/vio/odom', 10)
        self.sent = 0

    def publish(self) -> None:
        message = Odometry()
        message.pose.pose.position.x = float(self.sent)
        self.odom.publish(message)
        self.sent += 1

    def fly(self, seconds: float, until: Callable[[], object] = lambda: False) -> None:
        """Publish at 100 Hz, for a time or until a condition holds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            self.publish()
            time.sleep(0.01)


@pytest.fixture
def vehicle(ros: None) -> Iterator[Vehicle]:
    made = Vehicle()
    yield made
    made.node.destroy_node()


@pytest.fixture
def box(vehicle: Vehicle, tmp_path: Path) -> Iterator[Driven]:
    """Give a black box without threads: tests have it take and write."""
    made = Driven(black_box.BlackBox(namespace='/drone1', cli_args=[
        '--ros-args', '-r', 'odom:=/vio/odom'], parameter_overrides=overrides(
            record_folder=str(tmp_path / 'box'), disk_free=10.0)))
    wait_until(vehicle.odom.get_subscription_count, 20.0, 'the subscription')
    yield made
    made.close()


def numbers(path: Path) -> list[int]:
    """Return the numbers of the odometry messages in a recording; empty if it cannot be read."""
    try:
        with open_bag(path) as bag:
            return [round(deserialize(m.data, m.msgtype).pose.pose.position.x)
                    for m in bag.messages(['odom'])]
    except BagError:
        return []


@pytest.mark.parametrize('end', [signal.SIGKILL, signal.SIGINT])
def test_killed_black_box_lacks_at_most_its_last_second(
        vehicle: Vehicle, tmp_path: Path, end: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, '-m', 'flock_follower.nodes.black_box', '--ros-args', '-r',
         'odom:=/vio/odom', '-p', f'record_folder:={tmp_path}', '-p', 'disk_free:=10.0'])
    vehicle.fly(20.0, lambda: any(
        file.stat().st_size > 20_000 for file in tmp_path.glob('*/*.mcap')))
    vehicle.fly(random.uniform(0.0, 0.8))
    process.send_signal(end)
    ended = time.time()
    process.wait(20.0)
    path, = tmp_path.iterdir()
    with open_bag(path) as bag:
        assert bag.incomplete.startswith('still being written' if end == signal.SIGKILL else '')
        assert bool(bag.incomplete) == (end == signal.SIGKILL)
        assert ended - bag.end_ns / NANOSECONDS < 1.0
    found = numbers(path)
    assert found == list(range(found[0], found[-1] + 1))


def test_full_disk_is_reported_and_recording_resumes_with_room(
        vehicle: Vehicle, box: Driven, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with monkeypatch.context() as patch:
        patch.setattr(os, 'fsync', full)
        for _ in range(2):
            vehicle.publish()
            box.node._take()
            box.node._write()
        told = f'not recording to {tmp_path / "box"}: No space left on device'
        assert box.problems() == told
    assert box.counters['not recorded'] >= 2
    box.node._retry = 0.0

    def recorded() -> list[int]:
        vehicle.publish()
        box.node._take()
        box.node._write()
        return [n for path in (tmp_path / 'box').iterdir() for n in numbers(path)]
    wait_until(recorded, 10.0, 'a recording')
    assert box.problems() == ''
    box.node._notes['parameters.yaml'] = 'v_max: 0.5'
    with monkeypatch.context() as patch:
        patch.setattr(os, 'fsync', full)
        box.node._write()
    assert box.problems() == told
    box.node._retry = 0.0
    box.node._write()
    assert next((tmp_path / 'box').glob('*/parameters.yaml')).read_text() == 'v_max: 0.5'
    box.node._recording.close()


def test_recording_holds_images_latched_states_and_parameters(
        vehicle: Vehicle, box: Driven, tmp_path: Path) -> None:
    planner = Node('planner', namespace='drone1')
    planner.declare_parameter('v_max', 0.75)
    planner.declare_parameter('epsilon', 1e-5)
    planner.create_publisher(String, 'planner/state', LATCHED_QOS).publish(String(data='IDLE'))
    images = planner.create_publisher(Image, 'image_raw', 1)
    executor = SingleThreadedExecutor()
    for node in (planner, box.node):
        executor.add_node(node)

    def kept(text: str) -> bool:
        vehicle.publish()
        images.publish(Image(height=480, width=640, step=640, encoding='mono8',
                             data=array('B', PIXELS.tobytes())))
        executor.spin_once(timeout_sec=0.01)
        box.node._take()
        box.node._write()
        return any(text in file.read_text()
                   for file in (tmp_path / 'box').glob('*/parameters.yaml'))
    wait_until(lambda: kept('v_max: 0.75\n'), 20.0, 'the parameters')
    assert kept('    epsilon: 1.0e-05\n')
    planner.undeclare_parameter('epsilon')
    planner.set_parameters([Parameter('v_max', value=0.5)])
    wait_until(lambda: kept('v_max: 0.5\n'), 20.0, 'the parameters')
    box.node._recording.close()
    executor.shutdown()
    planner.destroy_node()
    path, = (tmp_path / 'box').iterdir()
    with open_bag(path) as bag:
        counts = {name: topic.count for name, topic in bag.topics.items()}
        assert bag.topics['/planner/state'].latched and counts['/planner/state'] == 1
        image = next(bag.messages(['/image_raw/compressed']))
        stamps = [m.stamp_ns for m in bag.messages(['/odom'])]
    decoded = decode_compressed(deserialize(image.data, image.msgtype).data)
    assert np.abs(decoded.astype(int) - PIXELS).mean() < 1.0
    assert counts['/image_raw/compressed'] > 1 and '/image_raw' not in counts
    assert np.all(np.diff(stamps) >= 0)
    values = parameters_flown(path, TABLE)
    assert values is not None and values['planner']['v_max'] == 0.5


def test_messages_of_a_topic_keep_order_in_simulated_time(
        box: Driven, monkeypatch: pytest.MonkeyPatch) -> None:
    topic, _, kind, _ = box.node._inputs[0]
    for clock, waited in ((START, 0), (START + 33_000_000, 40_000_000)):  # the clock has steps
        monkeypatch.setattr(box.node, 'get_clock', lambda clock=clock: SimpleNamespace(
            now=lambda: SimpleNamespace(nanoseconds=clock)))
        waiting = [(b'', {'received_timestamp': time.time_ns() - waited})]
        box.node._inputs = [(topic, SimpleNamespace(
            take_message=lambda *_, waiting=waiting: waiting.pop() if waiting else None),
            kind, bytes)]
        box.node._take()
    stamps = [message.stamp_ns for message in box.node._taken]
    assert len(stamps) == 2 and stamps == sorted(stamps)


def test_no_deadline_ends_a_process_that_finishes_its_files(
        monkeypatch: pytest.MonkeyPatch) -> None:
    deadlines: list[float] = []
    monkeypatch.setattr(nodes, 'AS_A_PROGRAM', True)
    monkeypatch.setattr(signal, 'setitimer', lambda _, seconds: deadlines.append(seconds))
    with no_exit_deadline():
        nodes.set_deadline()
    assert deadlines == []
    nodes.set_deadline()
    assert deadlines == [nodes.SHUTDOWN_TIMEOUT]


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

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

"""The replay node: what it publishes when, and how it ends; once as a real process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
import threading
from typing import Any

from driven import Driven
import numpy as np
import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header, String

from flock_desk.runs.processes import wait_until
from flock_follower.bags.bag import open_bag, typestore
from flock_follower.bags.writer import BagWriter
from flock_follower.messages import stamp_to_nanoseconds
from flock_follower.nodes.replay import Replay

START = 1_700_000_000_000_000_000
PERIOD = 20_000_000  # ns between the messages of /stamps
COUNT = 50
DEADLINE = 20.0  # s, for what should take a fraction of it


def header(stamp_ns: int) -> Any:
    types = typestore().types
    stamp = types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return types['std_msgs/msg/Header'](stamp, 'odom')


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give 1 s of headers, images and a latched string."""
    path = tmp_path_factory.mktemp('bags') / 'flight'
    types = typestore().types
    image = types['sensor_msgs/msg/CompressedImage']
    with BagWriter(path, latched=['mode']) as writer:
        writer.write('mode', 'std_msgs/msg/String', START, types['std_msgs/msg/String']('hover'))
        for i in range(COUNT):
            stamp = START + i * PERIOD
            writer.write('stamps', 'std_msgs/msg/Header', stamp, header(stamp))
            if i % 5 == 0:
                writer.write('image_raw/compressed', 'sensor_msgs/msg/CompressedImage', stamp,
                             image(header(stamp), 'jpeg', np.full(50_000, i, np.uint8)))
    return path


class Player(Driven):
    """The node; ``sent`` holds raw messages."""

    def __init__(self, bag: Path, *parameters: str, remaps: tuple[str, ...] = ()) -> None:
        rclpy.init(args=['replay', '--ros-args', *(
            word for p in ('wait_for_subscribers:=0.0', *parameters) for word in ('-p', p)), *(
            word for rule in remaps for word in ('-r', rule))])
        super().__init__(Replay(str(bag)))
        self.clocks = self.sent['clock']
        self.thread = threading.Thread(target=self.node.play)

    def stamps(self) -> list[int]:
        return [stamp_to_nanoseconds(deserialize_message(raw, Header).stamp)
                for raw in self.sent['stamps']]

    def clock(self) -> list[int]:
        return [stamp_to_nanoseconds(message.clock) for message in self.clocks]

    def close(self) -> None:
        rclpy.shutdown()
        if self.thread.ident:
            self.thread.join()
        super().close()


@pytest.fixture
def player() -> Iterator[Callable[..., Player]]:
    made: list[Player] = []

    def make(*arguments: Any, **options: Any) -> Player:
        made.append(Player(*arguments, **options))
        return made[-1]
    yield make
    for each in made:
        each.close()


def padded(cdr: bytes) -> bytes:
    """Return CDR bytes padded to a multiple of 4."""
    return cdr + bytes(-len(cdr) % 4)


def test_every_message_is_sent_bit_for_bit_clock_knows_stamp(
        player: Callable[..., Player], bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    p = player(bag, 'rate:=2.0')
    latched = {}
    for publisher in p.node.publishers:  # reliable ones reach best-effort subscribers, too
        assert publisher.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        latched[publisher.topic_name] = publisher.qos_profile.durability
    assert latched['/mode'] == DurabilityPolicy.TRANSIENT_LOCAL != latched['/stamps']
    assert p.node.play() == 0
    assert f'replayed {COUNT + 11} messages of 3 topics' in capsys.readouterr().out
    with open_bag(bag) as recorded:
        for topic in recorded.topics:
            assert [padded(raw) for raw in p.sent[topic[1:]]] == [
                padded(m.data) for m in recorded.messages([topic])]
    clocks = p.clock()
    assert clocks == sorted(clocks) and clocks[0] == START
    assert {START + i * PERIOD for i in range(COUNT)} <= set(clocks)
    assert np.median(np.diff(clocks)) <= 6_500_000  # 200 Hz of bag time between the messages
    # No more of them: every node that uses the time of the bag wakes for each.
    assert len(clocks) <= COUNT * PERIOD / 5_000_000 + COUNT


def test_start_and_topics_choose_what_is_played(
        player: Callable[..., Player], bag: Path) -> None:
    p = player(bag, 'start:=0.5', 'topics:=[stamps, /mode]',
               remaps=('__ns:=/drone', '/drone/mode:=/mode_out'))
    assert {publisher.topic_name for publisher in p.node.publishers} >= {
        '/drone/stamps', '/mode_out', '/clock'}
    assert p.node.play() == 0
    assert p.stamps() == [START + i * PERIOD for i in range(25, COUNT)]
    assert deserialize_message(p.sent['mode_out'][0], String).data == 'hover'


def test_duration_and_clock_and_the_line_of_progress(
        player: Callable[..., Player], bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    p = player(bag, 'start:=0.2', 'duration:=0.3', 'clock:=false')
    assert p.node.play() == 0
    assert p.stamps() == [START + i * PERIOD for i in range(10, 25)]
    assert '/clock' not in {publisher.topic_name for publisher in p.node.publishers}
    out = capsys.readouterr().out.splitlines()
    assert out[0].endswith(' of 0.5 s, 0 messages') and '[' not in out[0]  # no terminal, no bar
    p.node._line.on_terminal = True
    p.node._show_progress(1e9)  # long after the end
    assert f'[{"#" * 20}] 0.5 of 0.5 s' in capsys.readouterr().out


def test_pause_stops_messages_and_clock_and_resume_goes_on(
        player: Callable[..., Player], bag: Path) -> None:
    p = player(bag)
    p.thread.start()
    wait_until(lambda: len(p.sent['stamps']) > 5, DEADLINE, 'messages')
    assert p.call('replay/pause', data=True).message.startswith('paused at 0.')
    p.thread.join(0.1)  # what was under way
    before = len(p.sent['stamps']), len(p.clocks)
    p.thread.join(0.2)
    assert (len(p.sent['stamps']), len(p.clocks)) == before and p.values['paused']
    assert p.call('replay/pause', data=False).message.startswith('playing at 0.')
    p.thread.join(DEADLINE)
    assert len(p.sent['stamps']) == COUNT and p.values['position_s'] == '0.98'


def test_a_loop_steps_the_clock_back_and_rate_and_loop_are_live(
        player: Callable[..., Player], bag: Path) -> None:
    p = player(bag, 'loop:=true', 'rate:=5.0')
    p.thread.start()
    wait_until(lambda: p.stamps().count(START) >= 3, DEADLINE, 'a second loop')
    jumps = [after for before, after in pairwise(p.clock()) if after < before]
    assert {*jumps} == {START}  # published before any message
    assert p.set(rate=20.0, loop=False) == ''
    p.thread.join(DEADLINE)
    assert not p.thread.is_alive() and p.node._timeline.rate == 20.0


def test_recorded_states_and_commands_are_played_only_if_named(
        player: Callable[..., Player], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        for topic in ('mode', '/rosout', '/drone1/command/trajectory'):
            writer.write(topic, 'std_msgs/msg/String', START,
                         typestore().types['std_msgs/msg/String'](topic))
    assert player(tmp_path / 'bag').node.play() == 0
    out, err = capfd.readouterr()
    assert 'replayed 1 messages of 1 topics' in out
    assert 'not played unless named: /drone1/command/trajectory, /rosout' in err


def write_steps(path: Path, *steps_ns: int) -> Path:
    """Write 4 headers, each of ``steps_ns`` later than it should come, 1 file for each step."""
    path.mkdir()
    for number, step in enumerate(steps_ns):
        with BagWriter(path.parent / f'{path.name}{number}') as writer:
            for i in range(4):
                stamp = START + step + (4 * number + i) * PERIOD
                writer.write('stamps', 'std_msgs/msg/Header', stamp, header(stamp))
        (path.parent / f'{path.name}{number}' / f'{path.name}{number}.mcap').rename(
            path / f'{number}.mcap')
    return path


HOUR = 3_600_000_000_000  # ns


@pytest.mark.parametrize(('steps', 'jumps'), [
    ((0, HOUR), ['+3600.0 s at 0.1 s']), ((0, 7_000_000_000), ['+7.0 s at 0.1 s']),
    ((0, HOUR, HOUR), ['+3600.0 s at 0.1 s']), ((-START, 0, 0), ['+1700000000.0 s at 0.1 s']),
    ((HOUR, 0), ['+3599.9 s at 0.0 s', '-3600.0 s at 3600.0 s']),
    ((0, HOUR, 0), ['+3600.0 s at 0.1 s', '-3600.0 s at 3600.1 s'])])
def test_gaps_in_the_times_of_a_bag_are_named_and_not_waited_for(
        player: Callable[..., Player], tmp_path: Path, capsys: pytest.CaptureFixture[str],
        steps: tuple[int, ...], jumps: list[str]) -> None:
    p = player(write_steps(tmp_path / 'bag', *steps))
    p.thread.start()
    p.thread.join(DEADLINE)
    assert not p.thread.is_alive()
    stamps = [START + step + (4 * number + i) * PERIOD
              for number, step in enumerate(steps) for i in range(4)]
    assert p.stamps() == stamps
    assert set(stamps) <= set(p.clock())
    assert sum(after < before for before, after in pairwise(p.clock())) == sum(
        jump.startswith('-') for jump in jumps)
    out = capsys.readouterr().out
    assert [line.split(' jump by ')[1].split(':')[0] for line in out.splitlines()
            if line.startswith('warning: the times in the bag jump')] == jumps

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

"""Recordings in flight: what is written stays, makes room, and opens however it ends."""

from __future__ import annotations

from collections.abc import Sequence
import errno
import json
import os
from pathlib import Path
import random

from full_disk import disk_of
from mcap.reader import make_reader
import pytest
from rosbags.highlevel import AnyReader

from flock_follower.bags import mcap_file, recording
from flock_follower.bags.bag import BagError, BagMessage, open_bag, serialize
from flock_follower.bags.mcap_file import McapFile, RecordedTopic, TakenMessage
from flock_follower.bags.message_types import typestore
from flock_follower.bags.recording import FlightRecording
from flock_follower.bags.schedule import NS_PER_S

START = 1_700_000_000 * NS_PER_S
STRING = 'std_msgs/msg/String'
WORDS = RecordedTopic('/words', STRING)
STATE = RecordedTopic('/state', STRING, latched=True, source='/drone1/state')
LIMITS = 10.0, 10.0  # MB used, free


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit files to 1 MB, of which the newest three stay."""
    monkeypatch.setattr(recording, 'FILE_SIZE', 1.0)
    monkeypatch.setattr(recording, 'KEPT', 3)


def word(number: int, size: int = 40) -> bytes:
    return serialize(typestore().types[STRING](f'{number} '.ljust(size)), STRING)


def second(number: int, size: int = 40) -> list[TakenMessage]:
    """Return ten messages of a second."""
    return [TakenMessage(WORDS, START + number * NS_PER_S + k, word(10 * number + k, size))
            for k in range(10)]


def fill(box: FlightRecording, begin: float, *numbers: int, size: int = 40) -> Path:
    """Write the messages of some seconds, the first at a time, s; return the recording."""
    for number in numbers:
        box.write(second(number, size), begin + number - numbers[0])
    assert box.path is not None
    return box.path


def read(path: Path) -> tuple[str, list[BagMessage]]:
    """Return why a bag is incomplete, and its messages."""
    with open_bag(path) as bag:
        return bag.incomplete, list(bag.messages())


def numbers(path: Path) -> list[int]:
    return [int(m.data[8:].split()[0]) for m in read(path)[1] if m.topic == '/words']


def test_a_recording_is_a_bag_of_rosbag2_with_what_was_written(tmp_path: Path) -> None:
    box = FlightRecording(tmp_path, *LIMITS)
    box.note('parameters.yaml', 'planner: {}\n')
    box.write([TakenMessage(STATE, START, word(7)), *second(0)], 0.0)
    path = tmp_path / '0001_20231114T221320Z'
    assert box.path == path and read(path)[0].startswith('still being written')
    with pytest.raises(OSError, match='another process records in'):
        FlightRecording(tmp_path, *LIMITS)
    box.close()
    assert sorted(file.name for file in path.iterdir()) == [
        '0001_20231114T221320Z_0.mcap', 'metadata.yaml', 'parameters.yaml']
    with open_bag(path) as bag:
        assert [(t.name, t.msgtype, t.count, t.latched) for t in bag.topics.values()] == [
            ('/state', STRING, 1, True), ('/words', STRING, 10, False)]
        assert (bag.incomplete, bag.start_ns, bag.end_ns) == ('', START, START + 9)
    assert read(path)[1] == read(path / f'{path.name}_0.mcap')[1]
    with AnyReader([path]) as reader:  # the types come from the file
        words = [str(reader.deserialize(data, connection.msgtype).data).strip()
                 for connection, _, data in reader.messages() if connection.topic == '/words']
    assert words == [str(k) for k in range(10)]
    with (path / f'{path.name}_0.mcap').open('rb') as file:  # another reader, by the index
        found = list(make_reader(file).iter_messages(topics=['/state']))
    assert [(channel.metadata['source'], message.log_time) for _, channel, message in found] == [
        ('/drone1/state', START)]


def test_every_write_is_on_the_disk_when_it_returns(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    sync = os.fsync

    def note(descriptor: int) -> None:
        sync(descriptor)
        synced.append(os.fstat(descriptor).st_size)

    monkeypatch.setattr(mcap_file.os, 'fsync', note)
    file = McapFile(tmp_path / 'a.mcap')
    for number in range(3):
        file.write(second(number))
        assert synced[-1] == file.size == (tmp_path / 'a.mcap').stat().st_size
        assert len(read(tmp_path / 'a.mcap')[1]) == 10 * (number + 1)
    file.close()
    assert synced[-1] == (tmp_path / 'a.mcap').stat().st_size


@pytest.mark.parametrize(('writes', 'recordings'), [
    ((second(1)[::-1], [TakenMessage(WORDS, START + NS_PER_S - 5, word(20))]),  # a little late
     [[*range(10, 20), 20]]),
    ((second(100), second(0)), [[*range(1000, 1010)], [*range(10)]]),  # the clock was set
    ((second(-1_600_000_000), second(1)), [[*range(-16_000_000_000, -15_999_999_990)],
                                           [*range(10, 20)]])])
def test_unordered_messages_are_ordered_or_begin_new_recording(
        tmp_path: Path, writes: Sequence[list[TakenMessage]], recordings: list[list[int]]) -> None:
    box = FlightRecording(tmp_path, *LIMITS)
    for now, messages in enumerate(writes):
        box.write(messages, float(now))
    box.close()
    assert [numbers(path) for path in sorted(tmp_path.iterdir())] == recordings
    for path in tmp_path.iterdir():
        stamps = [message.stamp_ns for message in read(path)[1]]
        assert stamps == sorted(stamps)


def test_files_turn_over_and_each_has_what_is_latched(tmp_path: Path) -> None:
    box = FlightRecording(tmp_path, *LIMITS)
    box.write([TakenMessage(STATE, START, word(7))], 0.0)
    path = fill(box, 0.0, *range(6), size=60_000)
    box.close()
    files = sorted(path.glob('*.mcap'))
    assert len(files) == 3
    for file in files:
        assert [m.topic for m in read(file)[1]].count('/state') == 1
    described = json.loads((path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert described['relative_file_paths'] == [file.name for file in files]
    assert described['message_count'] == len(read(path)[1]) == 63
    assert numbers(path) == sorted(numbers(path))


def test_the_oldest_files_make_way_but_none_of_the_newest(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    earlier = FlightRecording(tmp_path, *LIMITS)
    first = fill(earlier, 0.0, *range(8), size=60_000)  # 0.6 MB each; a file has two of them
    earlier.close()
    box = FlightRecording(tmp_path, *LIMITS)
    path = fill(box, 1000.0, *range(12), size=60_000)
    assert (read(first)[0], numbers(first)[0]) == ('no metadata.yaml in it', 20)

    def refused(self: FlightRecording, file: Path) -> None:
        raise PermissionError(13, 'Permission denied')
    with monkeypatch.context() as patch:
        patch.setattr(FlightRecording, '_delete', refused)
        fill(box, 1012.0, *range(12, 24), size=60_000)
    fill(box, 1024.0, *range(24, 40), size=60_000)
    box.close()
    assert [p.name[:4] for p in sorted(tmp_path.iterdir())] == ['0002']
    kept = sorted({n // 10 for n in numbers(path)})
    assert read(path)[0] == '' and kept == list(range(kept[0], 40))
    assert 8e6 < sum(file.stat().st_size for file in path.glob('*.mcap')) < 14e6
    monkeypatch.setattr(recording, 'KEPT', 100)
    box = FlightRecording(tmp_path / 'other', *LIMITS)
    path = fill(box, 0.0, *range(40), size=60_000)
    box.close()
    assert len(numbers(path)) == 400


def test_little_disk_room_costs_oldest_files_then_recording(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used_by_others = 0.0

    def free(folder: Path) -> float:
        own = sum(file.stat().st_size for file in folder.glob('*/*.mcap'))
        return 15e6 - used_by_others - own

    monkeypatch.setattr(recording, '_free', free)
    box = FlightRecording(tmp_path, 1000.0, 10.0)
    path = fill(box, 0.0, *range(40), size=60_000)
    kept = numbers(path)
    assert kept == list(range(kept[0], 400)) and 60 < len(kept) < 170
    used_by_others = 15e6
    with pytest.raises(OSError, match='less than 10 MB free'):
        box.write(second(50), 50.0)
    assert len(list(path.glob('*.mcap'))) == 3
    kept = numbers(path)
    used_by_others = 0.0
    box.write(second(60), 60.0)
    box.close()
    assert read(path)[0] == '' and numbers(path) == [*kept, *range(600, 610)]


@pytest.mark.parametrize('size', [20_000, 20_050])
def test_full_disk_keeps_written_data_and_recording_resumes(
        tmp_path: Path, size: int) -> None:
    box = FlightRecording(tmp_path, *LIMITS)
    done = 0
    with disk_of(size), pytest.raises(OSError) as caught:
        for done in range(1000):
            box.write(second(done), done)
    assert caught.value.errno == errno.EFBIG and box.path is not None
    path = box.path
    assert numbers(path) == list(range(10 * done))
    box.write(second(2000), 2000.0)
    box.close()
    assert numbers(path) == [*range(10 * done), *range(20_000, 20_010)]
    assert read(path)[0] == f'{path.name}_0.mcap was cut short'


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, list[BagMessage]]:
    """Return a recording of 8 chunks, and its messages."""
    box = FlightRecording(tmp_path / 'box', *LIMITS)
    for number in range(8):
        box.write([TakenMessage(STATE, START + number * NS_PER_S, word(number)),
                   *second(number)], number)
    path = box.path
    assert path is not None
    box.close()
    return path, read(path)[1]


Recorded = tuple[Path, list[BagMessage]]


def test_recording_cut_anywhere_opens_or_reports_it_is_empty(
        recorded: Recorded) -> None:
    path, messages = recorded
    file = next(path.glob('*.mcap'))
    whole = file.read_bytes()
    chance = random.Random(5)
    found = set()
    cuts = [0, 8, len(whole) - 1, *(chance.randrange(len(whole)) for _ in range(80))]
    for k, where in enumerate(cuts):
        # A power cut leaves zeros where nothing had reached the disk yet.
        file.write_bytes(whole[:where] + bytes(5000 if k % 3 == 2 and where > 8 else 0))
        for what in (file, path) if k % 8 == 0 else (file,):
            try:
                reason, kept = read(what)
            except BagError as error:
                assert str(error).endswith('nothing is in it') and '\n' not in str(error)
                kept = []
            else:
                assert reason == f'{file.name} was cut short'
                assert kept == messages[:len(kept)]
        found.add(len(kept))
        # Nothing is lost but the chunk that was cut.
        assert len(kept) >= 11 * (where * 8 // len(whole) - 2)
    assert found == {11 * k for k in range(9)}


def test_a_folder_without_metadata_is_read_file_by_file(recorded: Recorded) -> None:
    path, messages = recorded
    (path / 'metadata.yaml').unlink()
    assert read(path) == ('no metadata.yaml in it', messages)
    (path / 'empty.mcap').write_bytes(b'')
    assert read(path) == ('empty.mcap was cut short', messages)

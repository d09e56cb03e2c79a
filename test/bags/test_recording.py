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
import shutil

from full_disk import disk_of
import pytest
from rosbags.highlevel import AnyReader

from flock_follower.bags import mcap_file, recording
from flock_follower.bags.bag import BagError, BagMessage, open_bag, serialize
from flock_follower.bags.mcap_file import McapFile, RecordedTopic, TakenMessage
from flock_follower.bags.message_types import typestore
from flock_follower.bags.recording import FlightRecording, Limits
from flock_follower.bags.schedule import NANOSECONDS

START = 1_700_000_000 * NANOSECONDS
STRING = 'std_msgs/msg/String'
WORDS = RecordedTopic('/words', STRING)
STATE = RecordedTopic('/state', STRING, latched=True, source='/drone1/state')
LIMITS = Limits(file_size=1.0, disk_used=10.0, disk_free=10.0, kept=10.0)


def word(number: int, size: int = 40) -> bytes:
    return serialize(typestore().types[STRING](f'{number} '.ljust(size)), STRING)


def second(number: int, size: int = 40) -> list[TakenMessage]:
    """Return ten messages of a second."""
    return [TakenMessage(WORDS, START + number * NANOSECONDS + k, word(10 * number + k, size))
            for k in range(10)]


def fill(box: FlightRecording, begin: float, *numbers: int, size: int = 40) -> Path:
    """Write the messages of some seconds, the first at a time, s; return the recording."""
    for number in numbers:
        box.write(second(number, size), begin + number - numbers[0])
    assert box.path is not None
    return box.path


def made(folder: Path, limits: Limits = LIMITS, now: float = 0.0) -> FlightRecording:
    return FlightRecording(folder, limits, now, clock=START / NANOSECONDS)


def read(path: Path) -> tuple[str, list[BagMessage]]:
    """Return why a bag is incomplete, and its messages."""
    with open_bag(path) as bag:
        return bag.incomplete, list(bag.messages())


def numbers(path: Path) -> list[int]:
    return [int(m.data[8:].split()[0]) for m in read(path)[1] if m.topic == '/words']


def place(box: FlightRecording) -> Path:
    assert box.path is not None
    return box.path


def kill(recording: FlightRecording) -> None:
    """Leave a recording as a killed process does: the kernel closes its files."""
    os.close(recording._lock)


def test_a_recording_is_a_bag_of_rosbag2_with_what_was_written(tmp_path: Path) -> None:
    box = made(tmp_path)
    box.note('parameters.yaml', 'planner: {}\n')
    box.write([TakenMessage(STATE, START, word(7)), *second(0)], 0.0)
    path = box.path
    assert path == tmp_path / '0001_20231114T221320Z'
    assert read(path)[0].startswith('still being written')
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
    assert b'/drone1/state' in (path / f'{path.name}_0.mcap').read_bytes()


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
    ((second(1)[::-1], [TakenMessage(WORDS, START + NANOSECONDS - 5, word(20))]),  # a little late
     [[*range(10, 20), 20]]),
    ((second(100), second(0)), [[*range(1000, 1010)], [*range(10)]]),  # the clock was set
    ((second(-1_600_000_000), second(1)), [[*range(-16_000_000_000, -15_999_999_990)],
                                           [*range(10, 20)]])])
def test_what_comes_out_of_order_is_put_in_order_or_begins_another_recording(
        tmp_path: Path, writes: Sequence[list[TakenMessage]], recordings: list[list[int]]) -> None:
    box = made(tmp_path)
    for now, messages in enumerate(writes):
        box.write(messages, float(now))
    box.close()
    assert [numbers(path) for path in sorted(tmp_path.iterdir())] == recordings
    for path in tmp_path.iterdir():
        stamps = [message.stamp_ns for message in read(path)[1]]
        assert stamps == sorted(stamps)


def test_what_keeps_it_from_starting_once_does_not_keep_it_for_ever(tmp_path: Path) -> None:
    broken = tmp_path / '0001_20260101T000000Z' / '0001_20260101T000000Z_0.mcap'
    broken.parent.mkdir()
    broken.symlink_to(tmp_path / 'nowhere')
    for _ in range(2):
        with pytest.raises(OSError, match='No such file'):
            made(tmp_path)
    broken.unlink()
    made(tmp_path).close()


def test_an_old_file_that_may_not_be_deleted_stops_nothing(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = Limits(file_size=0.001, disk_used=0.002, disk_free=1.0, kept=0.0)
    box = made(tmp_path, small)
    fill(box, 0.0, *range(4), size=200)
    box.close()
    old, delete = set(tmp_path.rglob('*.mcap')), Path.unlink

    def refused(path: Path) -> None:
        if path in old:
            raise PermissionError(13, 'Permission denied')
        delete(path)
    monkeypatch.setattr(Path, 'unlink', refused)
    box = made(tmp_path, small, 100.0)
    fill(box, 100.0, *range(100, 120, 6))
    box.close()
    assert len(numbers(max(tmp_path.iterdir()))) > 0


def test_files_turn_over_and_each_has_what_is_latched(tmp_path: Path) -> None:
    box = made(tmp_path)
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


def test_the_oldest_files_make_way_but_none_of_the_last_minutes(tmp_path: Path) -> None:
    kill(earlier := made(tmp_path))
    earlier.write(second(0, 60_000), 0.0)
    box = made(tmp_path, now=1000.0)
    path = fill(box, 1000.0, *range(40), size=60_000)  # 0.6 MB each; a file has two of them
    box.close()
    assert [p.name[:4] for p in sorted(tmp_path.iterdir())] == ['0002']
    kept = sorted({n // 10 for n in numbers(path)})
    assert kept == list(range(kept[0], 40))
    size = sum(file.stat().st_size for file in path.glob('*.mcap'))
    assert 8e6 < size < 14e6  # looked at every 5 s
    # What is not older than 10 s stays, however little is allowed.
    box = made(tmp_path / 'other', Limits(10.0, 10.0, 1.0, 1e6))
    path = fill(box, 0.0, *range(40), size=60_000)
    box.close()
    assert len(numbers(path)) == 400


def test_a_disk_with_little_room_costs_the_oldest_files_then_the_recording(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used_by_others = 0.0

    def free(folder: Path) -> float:
        own = sum(file.stat().st_size for file in folder.glob('*/*.mcap'))
        return 15e6 - used_by_others - own

    monkeypatch.setattr(recording, '_free', free)
    box = made(tmp_path, Limits(1000.0, 10.0, 1.0, 1e6))
    path = fill(box, 0.0, *range(40), size=60_000)
    kept = numbers(path)
    assert kept == list(range(kept[0], 400)) and 60 < len(kept) < 170
    used_by_others = 15e6  # nothing that could be deleted would help
    with pytest.raises(OSError, match='less than 10 MB free'):
        box.write(second(50), 100.0)
    assert numbers(path) == kept
    used_by_others = 0.0
    box.write(second(60), 106.0)
    box.close()
    assert read(path)[0] == '' and numbers(path)[-10:] == list(range(600, 610))


@pytest.mark.parametrize('size', [20_000, 20_050])
def test_a_full_disk_keeps_what_was_written_and_recording_goes_on_when_there_is_room(
        tmp_path: Path, size: int) -> None:
    box = made(tmp_path)
    done = 0
    with disk_of(size), pytest.raises(OSError) as caught:
        for done in range(1000):
            box.write(second(done), done)
    assert caught.value.errno == errno.EFBIG
    path = place(box)
    assert numbers(path) == list(range(10 * done))
    box.write(second(2000), 2000.0)
    box.close()
    assert numbers(path) == [*range(10 * done), *range(20_000, 20_010)]
    assert read(path)[0] == ''


def test_what_was_broken_off_is_finished_by_the_next(tmp_path: Path) -> None:
    box = made(tmp_path)
    path = fill(box, 0.0, 0, 1)
    file = next(path.glob('*.mcap'))
    whole = file.read_bytes()
    with file.open('ab') as torn:
        torn.write(whole[100:400])
    with pytest.raises(OSError, match='another process records in'):
        made(tmp_path)
    kill(box)
    assert read(path)[0].startswith('still being written') and numbers(path) == list(range(20))
    made(tmp_path).close()
    assert (read(path)[0], numbers(path)) == ('', list(range(20)))
    assert (path / 'metadata.yaml').exists()


def test_a_damaged_file_is_left_out_but_not_deleted(tmp_path: Path) -> None:
    box = made(tmp_path)
    path = fill(box, 0.0, *range(6), size=60_000)
    kill(box)
    first, second_file = sorted(path.glob('*.mcap'))[:2]
    damaged = bytearray(first.read_bytes())
    damaged[:20] = bytes(20)
    first.write_bytes(damaged)
    made(tmp_path).close()
    assert first.read_bytes() == damaged
    described = json.loads((path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert first.name not in described['relative_file_paths']
    assert numbers(path)[0] == numbers(second_file)[0] > 0


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, list[BagMessage]]:
    """Return a recording of 8 chunks, and its messages."""
    box = made(tmp_path / 'box')
    for number in range(8):
        box.write([TakenMessage(STATE, START + number * NANOSECONDS, word(number)),
                   *second(number)], number)
    path = place(box)
    box.close()
    return path, read(path)[1]


Recorded = tuple[Path, list[BagMessage]]


def test_a_recording_cut_anywhere_opens_as_far_as_it_goes_or_says_that_nothing_is_in_it(
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
    shutil.copy(next(path.glob('*.mcap')), path / 'empty.mcap')
    (path / 'empty.mcap').write_bytes(b'')
    assert read(path) == ('empty.mcap was cut short', messages)

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

"""Bags of every format: what is written is read, ROS 1 becomes ROS 2, damage is one line."""

import contextlib
import random
import re
import shutil
import subprocess
import sys

from full_disk import disk_of
import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

from flock_follower.bags.bag import BagError, deserialize, open_bag, serialize, typestore
from flock_follower.bags.writer import BagWriter

START = 1_700_000_000_000_000_000
STRING, BOOL = 'std_msgs/msg/String', 'std_msgs/msg/Bool'
ANIMAL, RANGE = 'zoo_msgs/msg/Animal', 'sensor_msgs/msg/Range'
MIGRATED = [
    'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/CameraInfo',
    'sensor_msgs/msg/Imu', 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped',
    'trajectory_msgs/msg/MultiDOFJointTrajectory',
]


def example(types, msgtype):
    """Return a message with a different value in every field; seq counts for nothing."""
    counter = iter(range(1, 1000))

    def fill(description):
        kind, detail = description
        if kind == Nodetype.NAME:
            return message(detail)
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            element, length = detail
            values = [fill(element) for _ in range(length or 3)]
            numeric = element[0] == Nodetype.BASE and element[1][0] != 'string'
            return np.array(values, dtype=element[1][0]) if numeric else values
        return f'text {next(counter)}' if detail[0] == 'string' else next(counter)

    def message(name):
        fields = types.fielddefs[name][1]
        return types.types[name](*(
            77 if field == 'seq' else fill(description) for field, description in fields))

    return message(msgtype)


def topic_of(msgtype):
    return f'/{msgtype.split("/")[-1].lower()}'


def write_rosbag1(path, messages, types=None, compression=None, topic=None):
    types = types or get_typestore(Stores.ROS1_NOETIC)
    writer = Rosbag1Writer(path)
    if compression:
        writer.set_compression(Rosbag1Writer.CompressionFormat[compression])
    connections = {}
    with writer:
        for i, (msgtype, message) in enumerate(messages):
            if msgtype not in connections:
                connections[msgtype] = writer.add_connection(
                    topic or topic_of(msgtype), msgtype, typestore=types)
            writer.write(connections[msgtype], START + i * 10_000_000,
                         types.serialize_ros1(message, msgtype))
    return path


def string(text):
    return typestore().types[STRING](text)


def write_strings(path, count=300):
    with BagWriter(path) as bag:
        for i in range(count):
            bag.write('chatter', STRING, START + i * 10_000_000, string(f'number {i} ' * 40))
    return path


def write_sqlite3(path, count=300):
    """Write the strings as others do: there is no writer of sqlite3 here."""
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        chatter = writer.add_connection('/chatter', STRING, typestore=typestore())
        for i in range(count):
            writer.write(chatter, START + i * 10_000_000,
                         serialize(string(f'number {i} ' * 40), STRING))
    return path


def storage_file(bag):
    return next(file for file in bag.iterdir() if file.suffix != '.yaml')


def read_all(path):
    with open_bag(path) as bag:
        return list(bag.messages())


def error_of(path):
    with pytest.raises(BagError) as caught:
        read_all(path)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def test_written_data_is_read_from_folder_and_bare_file(tmp_path):
    imu = example(typestore(), 'sensor_msgs/msg/Imu')
    with BagWriter(tmp_path / 'flight', latched=['mode']) as bag:
        bag.write('mode', STRING, START, string('hover'))
        bag.write('/imu', 'sensor_msgs/msg/Imu', START + 5, imu)
        bag.write('/imu', 'sensor_msgs/msg/Imu', START + 9, serialize(imu, 'sensor_msgs/msg/Imu'))
    for path in (tmp_path / 'flight', storage_file(tmp_path / 'flight')):
        with open_bag(path) as bag:
            assert (bag.start_ns, bag.end_ns, bag.duration_ns) == (START, START + 9, 9)
            assert bag.message_count == 3 and not bag.skipped
            assert [(t.name, t.msgtype, t.count, t.latched) for t in bag.topics.values()] == [
                ('/imu', 'sensor_msgs/msg/Imu', 2, False), ('/mode', STRING, 1, True)]
            messages = list(bag.messages())
            assert [m.stamp_ns - START for m in messages] == [0, 5, 9]
            assert [m.topic for m in messages] == ['/mode', '/imu', '/imu']
            assert messages[1].data == messages[2].data == serialize(imu, 'sensor_msgs/msg/Imu')
            assert deserialize(messages[0].data, STRING).data == 'hover'


def test_stamps_may_go_back_and_the_bytes_are_the_same_each_time(tmp_path):
    for name in 'ab':
        with BagWriter(tmp_path / name / 'bag') as bag:
            for stamp in (5, 3, 9):
                bag.write('a', STRING, START + stamp, string('x' * 2**20))  # a chunk each
    with open_bag(tmp_path / 'a' / 'bag') as bag:
        assert (bag.start_ns, bag.end_ns) == (START + 3, START + 9)
        assert [m.stamp_ns - START for m in bag.messages()] == [3, 5, 9]
    for name in ('bag.mcap', 'metadata.yaml'):
        first, second = ((tmp_path / folder / 'bag' / name).read_bytes() for folder in 'ab')
        assert first == second


def test_topics_and_times_select_messages(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for i in range(10):
            bag.write('a' if i % 2 else 'b', STRING, START + i, string(str(i)))
    with open_bag(tmp_path / 'bag') as bag:
        for topics, start, stop, found in ((['a'], None, None, [1, 3, 5, 7, 9]),
                                           (['a', '/a'], None, 5, [1, 3]), ([], 3, 6, [3, 4, 5])):
            assert [m.stamp_ns - START for m in bag.messages(
                topics, start and START + start, stop and START + stop)] == found
        with pytest.raises(BagError, match=r'holds no topic /c, only /a, /b'):
            list(bag.messages(['c']))


@pytest.mark.parametrize(('topics', 'said'), [
    ([('a', 'a_msgs/msg/B')], 'unknown message type a_msgs/msg/B'),
    ([('b', STRING), ('b', BOOL)], f'/b: has type {STRING}, not {BOOL}')])
def test_a_writer_refuses_what_no_reader_could_use(tmp_path, topics, said):
    with pytest.raises(BagError, match=said), BagWriter(tmp_path / 'bag') as bag:
        for topic, msgtype in topics:
            bag.write(topic, msgtype, START, b'\x00\x01\x00\x00\x01')
    assert (tmp_path / 'bag').exists() == (len(topics) == 2)  # one of them was written
    (tmp_path / 'bag').mkdir(exist_ok=True)
    with pytest.raises(BagError, match='exists already'):
        BagWriter(tmp_path / 'bag')


def test_messages_written_before_a_failure_are_kept_and_marked(tmp_path):
    with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / 'bag') as writer:
        for i in range(20):
            writer.write('a', STRING, START + i, string(str(i)))
        raise ZeroDivisionError('oops')
    for path in (tmp_path / 'bag', tmp_path / 'bag' / 'bag.mcap'):
        with open_bag(path) as bag:
            assert bag.incomplete.startswith('still being written, or the process that wrote it ')
            assert len(list(bag.messages())) == 20


# The second leaves no room for the end of a file behind its last whole chunk; with the third the
# disk is full when the bag is closed.
@pytest.mark.parametrize('size', [3_500_000, 2_098_800, 10_600_000])
def test_a_full_disk_costs_the_last_chunk_and_no_more(tmp_path, size):
    said = '^.*bag: File too large$'
    with disk_of(size), pytest.raises(BagError, match=said), BagWriter(tmp_path / 'bag') as writer:
        for i in range(10_000):
            writer.write('chatter', STRING, START + i, string(f'number {i} ' * 100))
    with open_bag(tmp_path / 'bag') as bag:
        assert bag.incomplete
        texts = [deserialize(m.data, m.msgtype).data for m in bag.messages()]
    assert texts == [f'number {i} ' * 100 for i in range(len(texts))]
    assert size - 2.2e6 < sum(map(len, texts)) < size


@pytest.mark.ros
def test_a_recording_that_was_killed_is_no_whole_bag(tmp_path):
    script = ('import os, sys; from flock_follower.bags.writer import BagWriter\n'
              f'bag = BagWriter({str(tmp_path / "bag")!r})\n'
              'bag.write("a", "std_msgs/msg/Bool", 1, bytes([0, 1, 0, 0, 1]))\n'
              'os.kill(os.getpid(), 9)')
    assert subprocess.run([sys.executable, '-c', script]).returncode == -9
    said = error_of(tmp_path / 'bag')
    assert said.startswith(f'{tmp_path / "bag"}: incomplete (still being written, or the process ')
    assert said.endswith('nothing is in it')


@pytest.mark.parametrize('msgtype', MIGRATED)
def test_ros1_messages_become_their_ros2_type_field_by_field(tmp_path, msgtype):
    noetic = get_typestore(Stores.ROS1_NOETIC)
    path = write_rosbag1(tmp_path / 'old.bag', [(msgtype, example(noetic, msgtype))], noetic)
    assert read_all(path) == [
        (topic_of(msgtype), msgtype, START, serialize(example(typestore(), msgtype), msgtype))]


@pytest.mark.parametrize(('msgtypes', 'topic', 'skipped'), [
    ([STRING, ANIMAL, RANGE], None, {
        '/animal': f'type {ANIMAL} does not exist in ROS 2 Jazzy',
        '/range': f'type {RANGE} has other fields in ROS 2 Jazzy'}),  # ROS 2 has one more
    ([ANIMAL], None, {'/animal': f'type {ANIMAL} does not exist in ROS 2 Jazzy'}),
    ([STRING, BOOL], '/mixed', {'/mixed': f'several types on one topic ({BOOL}, {STRING})'})])
def test_unreadable_ros1_topics_are_skipped_with_reason(
        tmp_path, msgtypes, topic, skipped):
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg('float32 size', ANIMAL))
    path = write_rosbag1(tmp_path / 'old.bag', [
        (msgtype, example(types, msgtype)) for msgtype in msgtypes], types, topic=topic)
    if len(skipped) == len(msgtypes) or topic:
        assert error_of(path).endswith('old.bag: holds no message that can be read' + ''.join(
            f'; {name}: {why}' for name, why in skipped.items()))
        return
    with open_bag(path) as bag:
        assert (list(bag.topics), bag.skipped) == (['/string'], skipped)
        assert len(list(bag.messages())) == 1
        with pytest.raises(BagError, match='topic /animal cannot be read: type zoo_msgs'):
            list(bag.messages(['/animal']))


def test_custom_ros2_types_pass_undecoded_fail_decoded(tmp_path):
    types, data = get_typestore(Stores.EMPTY), b'\x00\x01\x00\x00\x00\x00\x80\x3f'
    types.register(get_types_from_msg('float32 size', ANIMAL))
    with Rosbag2Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.write(writer.add_connection('/animal', ANIMAL, typestore=types), START, data)
    [message] = read_all(tmp_path / 'bag')
    assert (message.msgtype, message.data) == (ANIMAL, data)
    with pytest.raises(BagError, match=f'unknown message type {ANIMAL}'):
        deserialize(message.data, message.msgtype)


def test_missing_bag_unknown_format_and_empty_bag_are_one_line(tmp_path):
    assert error_of(tmp_path / 'none').endswith('none: no such bag')
    (tmp_path / 'notes.txt').write_text('hello')
    assert 'notes.txt: unknown format: must be .bag, .mcap, .db3' in error_of(
        tmp_path / 'notes.txt')
    (tmp_path / 'folder').mkdir()
    assert error_of(tmp_path / 'folder').endswith(
        'folder: no metadata.yaml in it, so not a finished ROS 2 bag')
    with BagWriter(tmp_path / 'mcap'):
        pass
    write_sqlite3(tmp_path / 'sqlite3', 0)
    for storage in ('mcap', 'sqlite3'):
        assert error_of(tmp_path / storage).endswith(f'{storage}: holds no message that can be '
                                                     'read')


def test_a_file_with_less_than_its_folder_announces_is_one_line(tmp_path):
    path = write_strings(tmp_path / 'bag')
    shutil.copy(storage_file(write_strings(tmp_path / 'other' / 'bag', count=299)),
                storage_file(path))
    assert ('299 of 300 announced messages found; if only metadata.yaml is wrong: ros2 bag '
            f'reindex {path}') in error_of(path)


def test_only_a_file_without_its_end_needs_the_library_mcap(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'mcap.stream_reader', None)
    file = storage_file(write_strings(tmp_path / 'bag'))
    assert len(read_all(tmp_path / 'bag')) == 300
    file.write_bytes(file.read_bytes()[:-200])
    assert error_of(file).endswith('needs the library mcap: pip install mcap')


def test_an_unclosed_sqlite3_recording_is_noticed(tmp_path):
    file = storage_file(write_sqlite3(tmp_path / 'bag.bag'))  # a folder may have any name
    assert len(read_all(tmp_path / 'bag.bag')) == 300
    file.with_name(f'{file.name}-wal').write_bytes(b'rows not merged yet')
    for path in (file, tmp_path / 'bag.bag'):
        assert 'recording was not closed' in error_of(path)


@pytest.mark.parametrize('lost', [1, 5, 4096, 10_000])
def test_an_sqlite3_file_that_was_cut_short_is_refused(tmp_path, lost):
    file = storage_file(write_sqlite3(tmp_path / 'bag', count=30))
    file.write_bytes(file.read_bytes()[:-lost])  # SQLite reads zeros: a message of another time
    for path in (file, tmp_path / 'bag'):
        assert re.search(r'was cut short: .* of .* bytes.*sqlite3 .* \.recover', error_of(path))


def good_bags(tmp_path):
    noetic = get_typestore(Stores.ROS1_NOETIC)
    strings = [(STRING, noetic.types[STRING](f'number {i} ' * 40)) for i in range(300)]
    return [
        storage_file(write_strings(tmp_path / 'm')),
        storage_file(write_sqlite3(tmp_path / 's')),
        write_rosbag1(tmp_path / 'plain.bag', strings),
        write_rosbag1(tmp_path / 'bz2.bag', strings, compression='BZ2'),
    ]


def test_damage_is_noticed_in_one_line(tmp_path):
    rng = random.Random(1)
    for file in good_bags(tmp_path):
        whole = file.read_bytes()
        for _ in range(25):
            damaged = bytearray(whole)
            at = rng.randrange(len(whole) // 5, len(whole) * 4 // 5)
            damaged[at:at + 2000] = rng.randbytes(2000)
            file.write_bytes(damaged)
            error_of(file)
            if file.suffix == '.bag':
                file.write_bytes(whole[:rng.randrange(len(whole))])
                error_of(file)


def test_damaged_messages_raise_bag_error_pixels_not_copied():
    rng = np.random.default_rng(1)
    for msgtype in ('nav_msgs/msg/Odometry', 'sensor_msgs/msg/Image'):
        good = serialize(example(typestore(), msgtype), msgtype)
        for kept in (0, 3, 11, 40, -1):
            with pytest.raises(BagError, match=f'^{msgtype}: corrupt message'):
                deserialize(good[:kept], msgtype)
        for _ in range(100):
            data = bytearray(good)
            for at in rng.integers(0, 40, size=3):
                data[at] = rng.integers(256)
            with contextlib.suppress(BagError):
                deserialize(bytes(data), msgtype)
    assert np.shares_memory(deserialize(good, msgtype).data, np.frombuffer(good, np.uint8))


@pytest.mark.parametrize('metadata', [True, False])
@pytest.mark.parametrize('form', ['mcap', 'sqlite3'])
def test_split_files_that_overlap_are_read_by_time(tmp_path, form, metadata):
    """Files of one folder, the later one first and both with messages of the same time."""
    folder = tmp_path / 'split'
    folder.mkdir()
    plugin = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}[form]
    names, stamps = [], ([4, 6, 8, 10], [1, 5, 6, 9], [20], [0, 2, 3])
    for i, each in enumerate(stamps):
        part = tmp_path / f'part_{i}'
        with Rosbag2Writer(part, version=9, storage_plugin=plugin) as writer:
            topic = writer.add_connection(f'/topic_{i % 2}', STRING, typestore=typestore())
            for stamp in each:
                writer.write(topic, START + stamp, serialize(string(f'{stamp} of {i}'), STRING))
        names.append(f'split_{i}{storage_file(part).suffix}')
        storage_file(part).rename(folder / names[-1])
    if metadata:
        (folder / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': {
            'version': 9, 'storage_identifier': form, 'compression_format': '',
            'compression_mode': '', 'relative_file_paths': names,
            'message_count': sum(map(len, stamps)), 'duration': {'nanoseconds': 20},
            'starting_time': {'nanoseconds_since_epoch': START}, 'topics_with_message_count': [{
                'topic_metadata': {
                    'name': f'/topic_{k}', 'type': STRING, 'serialization_format': 'cdr',
                    'offered_qos_profiles': []},
                'message_count': sum(map(len, stamps[k::2]))} for k in (0, 1)]}}))
    with open_bag(folder) as bag:
        read = [m.stamp_ns - START for m in bag.messages()]
        part = [m.stamp_ns - START for m in bag.messages(['/topic_1'], START + 2, START + 7)]
        texts = [deserialize(m.data, STRING).data for m in bag.messages()]
        assert bag.set_back_ns == 9  # the fourth file begins with 0, the second ended with 9
    assert read == [0, 1, 2, 3, 4, 5, 6, 6, 8, 9, 10, 20] and part == [2, 3, 5, 6]
    assert texts[6:8] == ['6 of 0', '6 of 1']  # of the same time: in the order of the files

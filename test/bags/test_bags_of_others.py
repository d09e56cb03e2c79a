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
"""Finished bags as other programs write them are read; what cannot be read is named."""

from collections.abc import Callable
from pathlib import Path
import re
import sqlite3
from typing import Any, NamedTuple

from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import get_typestore, Stores

from flock_follower.bags.bag import BagError, open_bag, serialize, typestore
from flock_follower.bags.mcap_file import definition
from flock_follower.bags.sequential import decompress

START, STEP = 1_700_000_000_000_000_000, 10_000_000
COUNT = 300
STRING = 'std_msgs/msg/String'
TEXT = f'number {{}} {"x" * 200}'
#: rosbag2's name of a storage, and the suffix of its files.
SUFFIXES = {'mcap': '.mcap', 'sqlite3': '.db3'}


def string(number: int) -> bytes:
    return serialize(typestore().types[STRING](TEXT.format(number)), STRING)


class Channel(NamedTuple):
    """A channel of an MCAP file; its messages are ``data(number)``."""

    topic: str
    encoding: str = 'cdr'
    schema: tuple[str, str, bytes] | None = (STRING, 'ros2msg', definition(STRING).encode())
    data: Callable[[int], bytes] = string


CHATTER = Channel('/chatter')


def write_mcap(path: Path, *channels: Channel, profile: str = 'ros2', unsorted: int = 0,
               **options: Any) -> Path:
    """Write COUNT messages of each channel; pairs ``unsorted`` messages apart are exchanged."""
    order = list(range(COUNT))
    for number in range(0, COUNT - unsorted, 10) if unsorted else ():
        order[number], order[number + unsorted] = order[number + unsorted], order[number]
    with path.open('wb') as file:
        writer = McapWriter(file, **{'chunk_size': 20_000, **options})
        writer.start(profile)
        numbers = []
        for channel in channels:
            schema = channel.schema and writer.register_schema(*channel.schema)
            numbers.append(writer.register_channel(channel.topic, channel.encoding, schema or 0))
        for number in order:
            for channel, name in zip(channels, numbers):
                stamp = START + number * STEP
                writer.add_message(name, stamp, channel.data(number), stamp)
        writer.finish()
    return path


def write_rosbag2(path: Path, storage: str = 'sqlite3', compression: str = '') -> Path:
    writer = Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        chatter = writer.add_connection('/chatter', STRING, typestore=typestore())
        for number in range(COUNT):
            writer.write(chatter, START + number * STEP, string(number))
    return path


def edit(path: Path, pattern: str, replacement: str) -> Path:
    """Change the metadata.yaml of a bag."""
    metadata = path / 'metadata.yaml'
    text, count = re.subn(pattern, replacement, metadata.read_text())
    assert count
    metadata.write_text(text)
    return path


def read(path: Path, topic: str = '/chatter') -> tuple[str, dict[str, str]]:
    """Assert that all messages are there, in order; return incomplete and skipped."""
    with open_bag(path) as bag:
        found = list(bag.messages([topic]))
        assert [(m.stamp_ns, m.msgtype, m.data) for m in found] == [
            (START + number * STEP, STRING, string(number)) for number in range(COUNT)]
        assert bag.topics[topic].count == COUNT
        assert (bag.start_ns, bag.end_ns) == (START, START + (COUNT - 1) * STEP)
        part = list(bag.messages([topic], START + 5 * STEP, START + 8 * STEP))
        assert part == found[5:8]
        return bag.incomplete, bag.skipped


def error_of(path: Path) -> str:
    with pytest.raises(BagError) as caught, open_bag(path) as bag:
        list(bag.messages())
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize('storage', SUFFIXES)
@pytest.mark.parametrize(('pattern', 'replacement'), [
    (r'offered_qos_profiles: .*', 'offered_qos_profiles: ""'),
    (r'offered_qos_profiles: .*', r"offered_qos_profiles: '- {history: 3, depth: 7, reliability: "
     '1, durability: 2, deadline: {sec: 1, nsec: 0}, lifespan: {sec: 1, nsec: 0}, liveliness: 1, '
     "liveliness_lease_duration: {sec: 1, nsec: 0}, avoid_ros_namespace_conventions: false}'"),
    (r'type_description_hash: .*', 'type_description_hash: RIHS01_00'),
    (r'storage_identifier: .*', "storage_identifier: ''"),
    (r'version: 9', 'version: 10'),
    (r'serialization_format: cdr', "serialization_format: ''")])
def test_metadata_unlike_the_file_yields_to_the_file(
        tmp_path: Path, storage: str, pattern: str, replacement: str) -> None:
    path = edit(write_rosbag2(tmp_path / 'bag', storage), pattern, replacement)
    assert read(path) == ('', {})


@pytest.mark.parametrize('storage', SUFFIXES)
@pytest.mark.parametrize(('text', 'said'), [
    ('', 'metadata.yaml cannot be read'), ('a: [', 'metadata.yaml cannot be read'),
    ('a: 1', 'metadata.yaml cannot be read'),
    ('rosbag2_bagfile_information: 3', 'metadata.yaml cannot be read'),
    (None, 'no metadata.yaml in it')])
def test_without_usable_metadata_the_files_are_read(
        tmp_path: Path, storage: str, text: str | None, said: str) -> None:
    path = write_rosbag2(tmp_path / 'bag', storage)
    (path / 'metadata.yaml').unlink()
    if text is not None:
        (path / 'metadata.yaml').write_text(text)
    assert read(path) == (said, {})


def test_a_renamed_file_is_read_and_the_name_missed(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / 'bag')
    (path / 'bag.db3').rename(path / 'flight.db3')
    assert read(path) == ('no bag.db3 in it, which metadata.yaml names', {})


def test_a_file_that_metadata_does_not_name_is_not_read(tmp_path: Path) -> None:
    path = edit(write_rosbag2(tmp_path / 'bag'), 'storage_identifier: .*',
                "storage_identifier: ''")
    (path / 'bag_copy.db3').write_bytes((path / 'bag.db3').read_bytes())
    assert read(path) == ('', {})


@pytest.mark.parametrize('options', [
    {'index_types': IndexType.NONE}, {'index_types': IndexType.CHUNK},
    {'index_types': IndexType.MESSAGE}, {'use_chunking': False},
    {'use_chunking': False, 'use_statistics': False},
    {'index_types': IndexType.NONE, 'use_statistics': False},
    {'repeat_channels': False}, {'repeat_schemas': False},
    {'index_types': IndexType.NONE, 'use_statistics': False, 'repeat_channels': False,
     'repeat_schemas': False, 'use_summary_offsets': False},
    {'index_types': IndexType.NONE, 'compression': CompressionType.LZ4}])
@pytest.mark.parametrize('unsorted', [0, 3, 150])
def test_mcap_without_indexes_is_read_in_order(
        tmp_path: Path, options: dict[str, Any], unsorted: int) -> None:
    path = write_mcap(tmp_path / 'a.mcap', CHATTER, unsorted=unsorted, **options)
    assert read(path) == ('', {})


@pytest.mark.parametrize(('encoding', 'schema'), [
    ('protobuf', ('foxglove.Log', 'protobuf', b'\x0a\xff\xfe')), ('json', None),
    ('json', ('Log', 'jsonschema', b'{}')), ('flatbuffer', ('Log', 'flatbuffer', b'\xff')),
    ('', None)])
def test_a_channel_that_is_not_of_ros_is_skipped_by_name(
        tmp_path: Path, encoding: str, schema: tuple[str, str, bytes] | None) -> None:
    other = Channel('/log', encoding, schema, lambda number: b'{}')
    reason = {'/log': f'serialized as {encoding!r}, not CDR'}
    assert read(write_mcap(tmp_path / 'a.mcap', other, CHATTER)) == ('', reason)
    assert error_of(write_mcap(tmp_path / 'b.mcap', other)).endswith(
        f'b.mcap: holds no message that can be read; /log: {reason["/log"]}')


@pytest.mark.parametrize('profile', ['', 'ros1', 'px4'])
def test_the_profile_of_mcap_does_not_matter(tmp_path: Path, profile: str) -> None:
    assert read(write_mcap(tmp_path / 'a.mcap', CHATTER, profile=profile)) == ('', {})


def test_ros1_messages_in_mcap_become_ros2_messages(tmp_path: Path) -> None:
    noetic = get_typestore(Stores.ROS1_NOETIC)
    text = noetic.generate_msgdef('std_msgs/msg/String', ros_version=1)[0]
    path = write_mcap(tmp_path / 'a.mcap', Channel(
        '/chatter', 'ros1', ('std_msgs/String', 'ros1msg', text.encode()),
        lambda number: bytes(noetic.serialize_ros1(
            noetic.types[STRING](TEXT.format(number)), STRING))), Channel(
        '/animal', 'ros1', ('zoo_msgs/Animal', 'ros1msg', b'float32 size'), lambda _: bytes(4)),
        profile='ros1')
    assert read(path) == ('', {'/animal': 'type zoo_msgs/msg/Animal does not exist in ROS 2 '
                                          'Jazzy'})


def test_sqlite_without_definitions_of_types_is_read(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / 'bag')
    with sqlite3.connect(path / 'bag.db3') as file:  # rosbag2 does not find those of each type
        file.execute("UPDATE message_definitions SET encoding = 'unknown'")
    assert read(path) == read(path / 'bag.db3') == ('', {})


def test_a_topic_of_another_serialization_is_named(tmp_path: Path) -> None:
    for storage in SUFFIXES:
        path = edit(write_rosbag2(tmp_path / storage, storage), 'serialization_format: cdr',
                    'serialization_format: other')
        if storage == 'mcap':
            write_mcap(path / 'mcap.mcap', Channel('/chatter', 'other'))
        else:
            with sqlite3.connect(path / 'sqlite3.db3') as file:
                file.execute("UPDATE topics SET serialization_format = 'other'")
        assert error_of(path).endswith(
            "holds no message that can be read; /chatter: serialized as 'other', not CDR")


def test_messages_lost_in_an_unindexed_file_are_noticed(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / 'a.mcap', CHATTER, index_types=IndexType.NONE)
    data = bytearray(path.read_bytes())
    # The record of a chunk begins with 6, its length, and the stamps of its messages.
    first = next(match.start() for match in re.finditer(b'\x06', data)
                 if 0 < int.from_bytes(data[match.start() + 9:match.start() + 17], 'little')
                 - START < COUNT * STEP)
    data[first] = 0x90  # an unknown record: a reader passes over it
    path.write_bytes(data)
    assert re.search(r': \d+ of 300 announced messages found', error_of(path))


@pytest.mark.parametrize(('damage', 'command'), [
    ('a.mcap', 'mcap recover {0} -o recovered.mcap'),
    ('a.db3', 'sqlite3 {0} .recover | sqlite3 recovered.db3'),
    ('a.bag', 'rosbag reindex {0}')])
def test_damage_names_the_command_that_saves_the_rest(
        tmp_path: Path, damage: str, command: str) -> None:
    path = tmp_path / damage
    path.write_bytes(b'\x89MCAP0\r\n' + bytes(100) + b'\x89MCAP0\r\n')
    assert f'(to save what is whole: {command.format(path)})' in error_of(path)


@pytest.mark.parametrize('mode', ['FILE', 'MESSAGE'])
def test_compressed_bags_with_other_metadata_are_read(tmp_path: Path, mode: str) -> None:
    path = edit(write_rosbag2(tmp_path / 'bag', compression=mode),
                r'offered_qos_profiles: .*', 'offered_qos_profiles: ""')
    assert read(path) == ('', {})


@pytest.mark.parametrize('storage', SUFFIXES)
def test_compressed_messages_are_read_without_their_metadata(
        tmp_path: Path, storage: str) -> None:
    path = write_rosbag2(tmp_path / 'bag', storage, 'MESSAGE')
    assert read(path / f'bag{SUFFIXES[storage]}') == ('', {})
    (path / 'metadata.yaml').unlink()
    assert read(path) == ('no metadata.yaml in it', {})


@pytest.mark.parametrize('storage', SUFFIXES)
def test_compressed_files_alone_name_the_command_that_unpacks(
        tmp_path: Path, storage: str) -> None:
    path = write_rosbag2(tmp_path / 'bag', storage, 'FILE')
    file = path / f'bag{SUFFIXES[storage]}.zstd'
    said = f': compressed as a whole; to unpack it: zstd -d {file} -o {file.with_suffix("")}'
    assert error_of(file).endswith(said)
    (path / 'metadata.yaml').unlink()
    assert error_of(path).endswith(said)
    file.with_suffix('').write_bytes(decompress(file.read_bytes()))
    assert read(path) == ('no metadata.yaml in it', {})


@pytest.mark.parametrize('storage', SUFFIXES)
def test_an_empty_file_of_several_leaves_the_others(tmp_path: Path, storage: str) -> None:
    path = write_rosbag2(tmp_path / 'bag', storage)
    empty = f'bag_1{SUFFIXES[storage]}'
    (path / empty).touch()
    (path / 'metadata.yaml').unlink()
    assert read(path)[0] == f'{empty} was cut short'


def test_messages_compressed_in_an_unknown_way_are_refused(tmp_path: Path) -> None:
    path = edit(write_rosbag2(tmp_path / 'bag'), 'compression_format: .*',
                'compression_format: fake')
    edit(path, 'compression_mode: .*', 'compression_mode: message')
    assert "Compression format 'fake' is not supported" in error_of(path)


def test_files_of_one_recording_are_read_one_after_the_other(tmp_path: Path) -> None:
    (tmp_path / 'bag').mkdir()
    whole = read_numbers(write_mcap(tmp_path / 'whole.mcap', CHATTER))
    for name in range(3):
        part = Channel('/chatter', data=lambda number, k=name: string(number + COUNT * k))
        write_mcap(tmp_path / 'bag' / f'bag_{name}.mcap', part, profile='')
    assert len(read_numbers(tmp_path / 'bag')) == 3 * len(whole)


def read_numbers(path: Path) -> list[bytes]:
    with open_bag(path) as bag:
        return [message.data for message in bag.messages()]

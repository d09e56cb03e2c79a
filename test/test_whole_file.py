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

"""Files that are whole or not there."""

from pathlib import Path

from full_disk import disk_of
import pytest

from flock_follower.system.whole_file import whole_file


def test_a_file_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / 'x'
    path.write_bytes(b'old')
    with whole_file(path) as file:
        file.write(b'new')
        assert path.read_bytes() == b'old'
    assert path.read_bytes() == b'new'
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(('size', 'error'), [(100_000, OSError), (10, KeyboardInterrupt)])
def test_a_part_is_not_left_by_a_full_disk_or_an_interrupt(
        tmp_path: Path, size: int, error: type[BaseException]) -> None:
    path = tmp_path / 'x'
    path.write_bytes(b'old')
    with disk_of(1000), pytest.raises(error) as caught, whole_file(path) as file:
        file.write(bytes(size))
        raise KeyboardInterrupt
    assert getattr(caught.value, 'filename', str(path)) == str(path)
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [b'old']

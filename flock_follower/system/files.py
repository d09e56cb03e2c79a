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

"""Paths and texts of the files that the package ships, for every kind of installation."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
import sys


def resource(relative: str) -> Path:
    """
    Return the path of a file or folder that the package ships, such as 'config/follower.yaml'.

    The function searches the ament install (colcon), then the interpreter's prefix (pip), then the
    source tree, because an editable install copies no data files.

    :raises FileNotFoundError: naming every place that was searched.
    """
    bases = [Path(__file__).resolve().parents[2],
             Path(sys.prefix) / 'share' / 'flock_follower']
    with suppress(ImportError, LookupError, OSError):  # not an ament install
        from ament_index_python.packages import get_package_share_directory
        bases.insert(0, Path(get_package_share_directory('flock_follower')))
    for base in bases:
        if (base / relative).exists():
            return base / relative
    places = ', '.join(str(base / relative) for base in bases)
    raise FileNotFoundError(f'{relative} is not installed: looked for {places}')


def read_text(path: str | Path) -> str:
    """
    Return the text of a file.

    :raises OSError: naming the file, also if the disk fails during reading.
    :raises ValueError: if the file is not UTF-8.
    """
    try:
        return Path(path).read_text(encoding='utf-8')
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None

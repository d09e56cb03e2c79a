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

"""The command `flights`, run on a scenario of one's own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from flock_desk.flights import main


def flown_by_the_command(folder: Path, text: str,
                         all_jobs: tuple[str, ...] = ('1', '2')) -> dict[str, dict[str, Any]]:
    """
    Return what it writes of three runs of ``mine.yaml``, law and guard.

    It has to be the same with one job and with more.
    """
    mine = folder / 'mine.yaml'
    mine.write_text(text)
    texts = []
    for jobs in all_jobs:
        out = folder / jobs
        assert main(['--scenario', str(mine), '--runs', '3', '--jobs', jobs,
                     '--output', str(out)]) == 0
        texts.append((out / 'flights.json').read_text())
    assert len(set(texts)) == 1
    results: dict[str, dict[str, Any]] = json.loads(texts[0])['mine']
    assert all(values['runs'] == 3 for values in results.values())
    return results

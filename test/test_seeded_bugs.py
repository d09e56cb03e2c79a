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
"""The table of seeded bugs fits the code: no entry is lost when a line or a test is renamed."""

from collections import Counter

from seeded_bugs import read, ROOT


def test_each_seeded_bug_names_code_and_test_that_exist():
    stale = []
    for bug in read():
        path, name = bug.test.split('::', 1)
        function = name.split('[')[0].split('::')[-1]
        found = (ROOT / bug.file).read_text(encoding='utf-8').count(bug.old)
        tested = f'def {function}(' in (ROOT / path).read_text(encoding='utf-8')
        if found == 0 or not tested:
            stale.append(f'{bug.file}: {bug.bug}: ' + (
                f'{path} has no {function}: correct "test"' if found else
                f'the code has no {bug.old!r}: correct "old" and "new"'))
    assert not stale, '\n'.join(['test/seeded_bugs.yaml:', *stale])


def test_no_seeded_bug_has_its_name_twice():
    counts = Counter((bug.file, bug.bug) for bug in read())
    assert [each for each, count in counts.items() if count > 1] == []

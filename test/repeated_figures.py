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


"""
List the numbers with a unit that stand in more than one page: ``python test/repeated_figures.py``.

A fact stands once, where it is needed; other pages link to it. The field card, the questions and
the tutorial repeat what must be read there. Single digits are left out: most agree by chance.
"""

from collections import defaultdict
from pathlib import Path
import re

ROOT = Path(__file__).resolve().parents[1]
PAGES = ('README.md', 'CONTRIBUTING.md', 'benchmarks/RESULTS.md', 'docs/*.md')
REPEATING = {'field_card.md', 'questions.md', 'tutorial.md'}
FIGURE = re.compile(r'(?<![\w.])(\d[\d.,]*\d) ?'
                    r'(m/s[²³]?|m²|[mck]?m|ms|s|Hz|rad/s|rad|°|%|px|[kM]B/s|[kMG]B)(?![\w/])')


def repeated() -> dict[str, dict[str, list[str]]]:
    """Return the lines that hold each figure, by figure and page, for those of several pages."""
    found = defaultdict[str, dict[str, list[str]]](dict)
    for path in sorted(page for pattern in PAGES for page in ROOT.glob(pattern)):
        if path.name in REPEATING:
            continue
        for number, line in enumerate(path.read_text(encoding='utf-8').splitlines(), 1):
            for match in FIGURE.finditer(line):
                near = line[max(0, match.start() - 40):match.end() + 30].strip()
                found[f'{match[1]} {match[2]}'].setdefault(path.name, []).append(
                    f'{number}: {near}')
    return {figure: pages for figure, pages in found.items() if len(pages) > 1}


if __name__ == '__main__':
    for figure, pages in sorted(repeated().items()):
        print(figure)
        for page, lines in pages.items():
            print(*(f'    {page} {line}' for line in lines), sep='\n')

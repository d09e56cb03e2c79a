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
List the facts with a number and a unit that stand on more than one page.

A fact stands once, where it is needed; other pages link to it. ``python test/repeated_figures.py``
lists a figure if it stands on two pages with the same words around it, and ends with 1 if the
figure has no reason in REASONS. The field card, the questions and the tutorial repeat what must
be read there. Single digits are left out: most agree by chance.
"""

from collections import defaultdict
from itertools import combinations
from pathlib import Path
import re
import sys

ROOT = Path(__file__).resolve().parents[1]
PAGES = ('README.md', 'CONTRIBUTING.md', 'benchmarks/RESULTS.md', 'docs/*.md')
REPEATING = {'field_card.md', 'questions.md', 'tutorial.md'}
FIGURE = re.compile(r'(?<![\w.])(\d[\d.,]*\d) ?'
                    r'(m/s[²³]?|m²|[mck]?m|ms|s|Hz|rad/s|rad|°|%|px|[kM]B/s|[kMG]B)(?![\w/])')
NEAR = 70  # characters before and after a figure that are compared
SHARED_WORDS = 2  # words of at least WORD_LENGTH letters around the same figure: one fact
WORD_LENGTH = 6

#: Facts that stand on several pages, and why.
REASONS: dict[str, str] = {
    '0.20 m': 'the warning beside relative_flight names the worst flight',
    '0.42 m': 'the promise of the guard; RESULTS.md has the flights',
    '0.1 m/s': 'two facts: a drift that is not detected, and a v_max',
    '0.2 s': 'two facts: perception_timeout, and the least predict_timeout',
    '0.25 m': 'two facts: a step of a frame, and the size of a marker',
    '0.25 s': 'two facts: a clock that is behind, and a gap of the odometry',
    '0.3 m': 'two facts: what a row of check can show, and what was simulated',
    '0.3 s': 'two facts: odometry that is missing, and a stamp that is ahead',
    '0.5 s': 'two facts: the fading of an edge, and the age of an estimate',
    '0.6 s': 'two facts: the autopilot, and the reaction of the bridge to it',
    '0.9 m': 'the distance by which several tables count runs',
    '50 Hz': 'two facts: odometry that is received, and telemetry',
    '50 ms': 'two facts: a late cycle, and a simulated offset of stamps',
    '60 s': 'two facts: engage_timeout, and the length of the chart',
}


def _words(text: str) -> set[str]:
    return {word for word in re.findall(r'[a-z_]+', text.lower()) if len(word) >= WORD_LENGTH}


def repeated() -> dict[str, dict[str, str]]:
    """Return the surroundings of each figure that stands on several pages, by figure and page."""
    found = defaultdict[str, list[tuple[str, str]]](list)
    for path in sorted(page for pattern in PAGES for page in ROOT.glob(pattern)):
        if path.name in REPEATING:
            continue
        text = ' '.join(path.read_text(encoding='utf-8').split())
        for match in FIGURE.finditer(text):
            near = text[max(0, match.start() - NEAR):match.end() + NEAR]
            found[f'{match[1]} {match[2]}'].append((path.name, near))
    pages: dict[str, dict[str, str]] = {}
    for figure, places in found.items():
        for (page, near), (other, also_near) in combinations(places, 2):
            if page != other and len(_words(near) & _words(also_near)) >= SHARED_WORDS:
                pages.setdefault(figure, {}).update({page: near, other: also_near})
    return pages


if __name__ == '__main__':
    listed = repeated()
    for figure, pages in sorted(listed.items()):
        print(f'{figure}: {REASONS.get(figure, "no reason")}')
        for page, near in pages.items():
            print(f'    {page}: ... {near} ...')
    for figure in sorted(REASONS.keys() - listed):
        print(f'{figure}: has a reason, and stands on one page')
    sys.exit(1 if listed.keys() ^ REASONS.keys() else 0)

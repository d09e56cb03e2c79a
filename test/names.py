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
List the names, constants and comments that a reader cannot understand where they are used.

The rules, each with the breach that it lists:

- ``word``: a number of a module has a one-word name, and another module or two functions use it.
- ``line``: one statement sets several numbers of a module.
- ``comment``: the comment of a number goes on from the one above, or ends within a sentence; or
  one number has a comment and the next one has none.
- ``function``: the name of a function is an adverb, a preposition, an adjective or a participle.
- ``length``: the name of a test has more than 60 characters.
- ``spelling``: a word has a British spelling; ``--mend PATH ...`` replaces it.

``names_accepted.yaml`` lists the accepted breaches of each file. A breach that is not listed, and
a listed one that is gone, are errors; ``--shrink`` removes those that are gone and adds none.
"""

from __future__ import annotations

import argparse
import ast
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
import io
from pathlib import Path
import re
import sys
import tokenize

import yaml

ROOT = Path(__file__).resolve().parents[1]
ACCEPTED = Path(__file__).with_name('names_accepted.yaml')
#: What the rules of names and constants hold for.
PACKAGES = ('flock_follower', 'flock_desk')
#: What the rule of spelling holds for.
FOLDERS = (*PACKAGES, 'launch', 'examples', 'benchmarks', 'test')
RULES = ('word', 'line', 'comment', 'function', 'length', 'spelling')
MAX_TEST_NAME = 60  # characters
Breaches = dict[str, set[tuple[str, str]]]

#: One-word names that say nothing where they are called: no verb, and no noun of a value.
NO_NAMES = frozenset(re.findall(r'\w+', """
    about above abroad across after again ahead alike alone along already anew apart around
    aside at away back before begun behind below beside besides between beyond born broken
    brought built by caught chosen come done down drawn driven early else elsewhere enough
    ever fallen far farther fed felt first flown forth fought found from given gone grown
    heard held here hidden higher in inside instead into just kept known laid largest last
    late later learnt least led left lent less level likely longer longest lost lower made
    meant meanwhile met misspelt more most near nearer nearest never new newest next now off
    often old oldest on once only onto out outside over overhead paid past proven ready round
    said same seen sent shortest shown sideways since so soon sought spent spoken stood
    straight sunk sure taken taught than then there thought through thrown to together told
    too toward towards under understood until up upon well when where while widest with within
    without woken worn written yet"""))
#: Nouns and verbs that look like participles.
NO_PARTICIPLES = frozenset(re.findall(r'\w+', """
    bearing bed bring embed exceed facing feed greeting heading king meaning mounting need
    proceed reading red ring seed sibling spacing speed spelling spring string succeed thing
    timing warning"""))
#: The beginning of a comment that goes on from another one.
GOES_ON = re.compile(
    r'(and|or|but|nor|than|with (less|more)|by so|so (many|much|far|often|long)|of (it|them|these)'
    r'|the same|as much|(beyond|below|above|after|more than) that|which|whose)\b')
#: The end of a comment that goes on in another one.
UNFINISHED = re.compile(r'([,:]|\b(and|or|but|than|of|by|with|to|the|a))$')

#: British stems and their American spelling. The ends of the words stay.
SPELLINGS = {
    'neighbour': 'neighbor', 'colour': 'color', 'behaviour': 'behavior', 'favour': 'favor',
    'honour': 'honor', 'harbour': 'harbor', 'vapour': 'vapor', 'labour': 'labor',
    'centre': 'center', 'metre(?=s?\\b)': 'meter', 'fibre': 'fiber', 'calibre': 'caliber',
    'manoeuvre': 'maneuver', 'manoeuvring': 'maneuvering', 'grey': 'gray',
    'travell(?=ed|ing|er)': 'travel', 'modell(?=ed|ing|er)': 'model',
    'labell(?=ed|ing|er)': 'label', 'levell(?=ed|ing|er)': 'level',
    'cancell(?=ed(?!error)|ing)': 'cancel', 'signall(?=ed|ing|er)': 'signal',
    'channell(?=ed|ing)': 'channel', 'dialled': 'dialed', 'fuelled': 'fueled',
    'analys(?=e\\b|ed|ing)': 'analyz', 'artefact': 'artifact', 'judgement': 'judgment',
    'learnt': 'learned', 'misspelt': 'misspelled', 'spelt': 'spelled', 'burnt': 'burned',
    'focuss(?=ed|ing)': 'focus', 'licence': 'license', 'defence': 'defense',
    'offence': 'offense', 'catalogue': 'catalog', 'ageing': 'aging', 'whilst': 'while',
    'sceptic': 'skeptic', 'aluminium': 'aluminum', 'programme(?=s?\\b)': 'program',
    '(?P<stem>initial|normal|linear|optim|recogn|quant|discret|synchron|serial|organ|minim|maxim|'
    'raster|random|summar|general|equal|penal|real|stabil|local|character|parametr|polar|regular|'
    'special|visual|util|author|categor|emphas|custom|critic|neutral|symbol|vector|standard|'
    'final|factor|orthogonal|diagonal|ideal|formal|capital|priorit)is'
    '(?=e\\b|es\\b|ed|er|ing|ation|able)': r'\g<stem>iz',
}
_STEMS = [(re.compile(stem, re.IGNORECASE), other) for stem, other in SPELLINGS.items()]
_BRITISH = re.compile('|'.join(SPELLINGS), re.IGNORECASE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what is wrong, and return 1 if anything is."""
    parser = argparse.ArgumentParser(prog='names', description='Check names and comments.')
    parser.add_argument('--shrink', action='store_true', help='remove breaches that are gone')
    parser.add_argument('--count', action='store_true', help='print the breaches by rule and room')
    parser.add_argument('--mend', nargs='+', type=Path, metavar='PATH', default=(),
                        help='replace British spellings in files or folders')
    options = parser.parse_args(arguments)
    for path in files_below(options.mend):
        text = path.read_text(encoding='utf-8')
        if (mended := american(text)) != text:
            path.write_text(mended, encoding='utf-8')
    found = find_breaches(ROOT)
    if options.count:
        print_counts(found)
        return 0
    accepted = read_accepted()
    if options.shrink:
        write_accepted({file: breaches & accepted.get(file, set())
                        for file, breaches in found.items()})
        accepted = read_accepted()
    wrong = compare(found, accepted)
    print(*wrong, sep='\n', end='\n' if wrong else '')
    return 1 if wrong else 0


def compare(found: Mapping[str, set[tuple[str, str]]],
            accepted: Mapping[str, set[tuple[str, str]]]) -> list[str]:
    """Return a line for each breach that is not accepted, and for each listed one that is gone."""
    wrong = []
    for file in sorted({*found, *accepted}):
        new = found.get(file, set()) - accepted.get(file, set())
        gone = accepted.get(file, set()) - found.get(file, set())
        wrong += [f'{file}: {rule}: {name}' for rule, name in sorted(new)]
        wrong += [f'{file}: {rule}: {name} is mended: test/names.py --shrink removes it from '
                  f'{ACCEPTED.name}' for rule, name in sorted(gone)]
    return wrong


def files_below(paths: Iterable[Path]) -> Iterator[Path]:
    for path in paths:
        # This module, and its test, hold the British words.
        yield from [each for each in sorted(path.rglob('*.py')) if not each.match('test/*names.py')
                    ] if path.is_dir() else [path]


def find_breaches(root: Path) -> Breaches:
    """Return the breaches of each file, as pairs of the rule and the name."""
    texts = {path.relative_to(root).as_posix(): path.read_text(encoding='utf-8')
             for path in files_below(root / folder for folder in FOLDERS)}
    trees = {file: ast.parse(text) for file, text in texts.items()}
    imported = names_imported(trees)
    found: Breaches = {}
    for file, text in texts.items():
        breaches = {('spelling', word) for word in british_words(text)}
        if file.startswith(PACKAGES):
            breaches |= breaches_of_module(trees[file], text, imported[module_name(file)])
        breaches |= {('length', name) for name in function_names(trees[file])
                     if name.startswith('test_') and len(name) > MAX_TEST_NAME}
        if breaches:
            found[file] = breaches
    return found


def breaches_of_module(tree: ast.Module, text: str,
                       imported: set[str]) -> set[tuple[str, str]]:
    """Return the breaches of names and constants; ``imported``: what other modules use of it."""
    found = {('line', ', '.join(names)) for names, _ in constants(tree) if len(names) > 1}
    used = functions_by_name(tree)
    for names, _ in constants(tree):
        found |= {('word', name) for name in names if '_' not in name.strip('_')
                  and (name in imported or len(used[name]) > 1)}
    found |= {('comment', name) for name in running_comments(tree, text)}
    found |= {('function', name) for name in function_names(tree) if is_no_name(name)}
    return found


def constants(tree: ast.Module) -> Iterator[tuple[list[str], ast.stmt]]:
    """Yield the names that each statement gives to numbers of the module, and the statement."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            (target, *_), value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            target, value = node.target, node.value
        else:
            continue
        targets = target.elts if isinstance(target, ast.Tuple) else [target]
        names = [each.id for each in targets if isinstance(each, ast.Name)
                 and each.id.isupper()]
        if names and len(names) == len(targets) and is_number(value):
            yield names, node


def is_number(value: ast.expr) -> bool:
    """Return whether an expression holds a number, and neither a text nor a function."""
    nodes = [*ast.walk(value)]
    return (any(isinstance(node, ast.Constant) and type(node.value) in (int, float)
                for node in nodes)
            and not any(isinstance(node, (ast.Dict, ast.Lambda, ast.Set, ast.ListComp,
                                          ast.GeneratorExp, ast.DictComp, ast.JoinedStr))
                        or isinstance(getattr(node, 'value', None), (str, bytes))
                        for node in nodes))


def functions_by_name(tree: ast.Module) -> defaultdict[str, set[str]]:
    """Return the functions, and methods, of a module that use each name."""
    used: defaultdict[str, set[str]] = defaultdict(set)
    for node in tree.body:
        methods = [(f'{node.name}.', each) for each in node.body] if isinstance(
            node, ast.ClassDef) else [('', node)]
        for prefix, each in methods:
            if isinstance(each, (ast.FunctionDef, ast.AsyncFunctionDef)):
                for inner in ast.walk(each):
                    if isinstance(inner, ast.Name):
                        used[inner.id].add(f'{prefix}{each.name}')
    return used


def names_imported(trees: Mapping[str, ast.Module]) -> defaultdict[str, set[str]]:
    """Return the names of each module that others in the packages import or use."""
    imported: defaultdict[str, set[str]] = defaultdict(set)
    for file, tree in trees.items():
        if not file.startswith(PACKAGES):
            continue
        modules = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported[node.module] |= {alias.name for alias in node.names}
                modules.update({alias.asname or alias.name: f'{node.module}.{alias.name}'
                                for alias in node.names})
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                imported[modules.get(node.value.id, '')].add(node.attr)
    return imported


def module_name(file: str) -> str:
    return file.removesuffix('.py').removesuffix('/__init__').replace('/', '.')


def running_comments(tree: ast.Module, text: str) -> Iterator[str]:
    """Yield constants without a comment below another one, or with a part of a sentence."""
    comments = {token.start[0]: token.string.lstrip('#: ') for token in tokenize.generate_tokens(
        io.StringIO(text).readline) if token.type == tokenize.COMMENT}
    previous, commented = None, False
    for names, node in constants(tree):
        last = node.end_lineno or node.lineno
        own = comments.get(last, comments.get(node.lineno, ''))
        adjacent = previous == node.lineno - 1
        above = comments.get(node.lineno - 1, '') if not adjacent else ''
        shared = adjacent and not own and commented
        if shared or (adjacent and GOES_ON.match(own)) or UNFINISHED.search(own or above):
            yield names[0]
        previous, commented = last, bool(own or above)


def function_names(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.name


def is_no_name(name: str) -> bool:
    """Return whether a name of a function is one word, and neither a verb nor a noun."""
    word = name.strip('_')
    participle = re.search(r'[a-z]{2}(ed|ing)$', word) and word not in NO_PARTICIPLES
    return '_' not in word and (word in NO_NAMES or bool(participle))


def american(text: str) -> str:
    """Return a text with American spelling, in the same case."""
    for pattern, other in _STEMS:
        text = pattern.sub(lambda match, other=other: _as(match[0], match.expand(other)), text)
    return text


def british_words(text: str) -> set[str]:
    return {word for word in {*re.findall(r'[a-z]+', text.lower())} if _BRITISH.search(word)}


def _as(old: str, new: str) -> str:
    return (new.upper() if old.isupper() else
            new[0].upper() + new[1:] if old[0].isupper() else new)


def read_accepted() -> Breaches:
    document = yaml.load(ACCEPTED.read_text(encoding='utf-8'), yaml.BaseLoader)
    return {file: {(rule, str(name)) for rule, names in rules.items() for name in names}
            for file, rules in document.items()}


def write_accepted(accepted: Mapping[str, set[tuple[str, str]]]) -> None:
    """Write the list: a line for each rule that a file breaks."""
    lines = ['# Breaches of the rules of test/names.py that are accepted. This list only shrinks.']
    for file in sorted(file for file in accepted if accepted[file]):
        lines.append(f'{file}:')
        for rule in RULES:
            names = sorted(name for broken, name in accepted[file] if broken == rule)
            if names:
                quoted = [f"'{name}'" if ',' in name else name for name in names]
                lines.append(f'  {rule}: [{", ".join(quoted)}]')
    ACCEPTED.write_text('\n'.join(lines) + '\n', encoding='utf-8')


def print_counts(found: Mapping[str, set[tuple[str, str]]]) -> None:
    """Print the number of breaches of each rule, in all and in each room."""
    rooms: defaultdict[str, list[int]] = defaultdict(lambda: [0] * len(RULES))
    for file, breaches in found.items():
        parts = file.split('/')
        for room in ('all', '/'.join(parts[:2]) if len(parts) > 2 else parts[0]):
            for rule, _ in breaches:
                rooms[room][RULES.index(rule)] += 1
    print(f'{"":28}', *(f'{rule:>9}' for rule in RULES))
    for room, counts in sorted(rooms.items()):
        print(f'{room:28}', *(f'{count:9}' for count in counts))


if __name__ == '__main__':
    sys.exit(main())

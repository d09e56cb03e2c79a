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

"""The command that draws markers: to scale, detected from near and far, refusals in one line."""

from __future__ import annotations

from itertools import combinations
import os
from pathlib import Path
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml

from flock_desk.marker import APRILTAG_NOTE, Box, draw, layout, main, Page, PAGES
from flock_follower.geometry import Array
from flock_follower.perception import markers as neighbors
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import detect, dictionary_size, marker_cells
from flock_follower.system.files import resource

POINT = 25.4 / 72.0  # mm
CORNER = r'(-?[\d.]+) (-?[\d.]+) [ml]'
ISSUE = ['--id', '0', '--dictionary', 'DICT_4X4_50', '--size', '0.16']


def objects_of(pdf: bytes) -> dict[int, bytes]:
    """Return a PDF's objects by number; of one written twice the last counts."""
    return {int(number): body for number, body in re.findall(
        rb'^(\d+) 0 obj\n(.*?)\nendobj\n', pdf, re.DOTALL | re.MULTILINE)}


def pages_of(pdf: bytes) -> list[Page]:
    """Return the pages of a PDF from what is drawn on them; no size that it claims is believed."""
    objects, pages = objects_of(pdf), []
    for body in objects.values():
        if not re.search(rb'/Type /Page\b', body):
            continue
        assert b'/UserUnit' not in body and b'/Rotate' not in body
        width, height = (float(n) * POINT for n in re.search(
            rb'/MediaBox \[ 0 0 (\S+) (\S+) \]', body).groups())
        content = objects[int(re.search(rb'/Contents (\d+) 0 R', body)[1])]
        # Two paths, the white page and then all that is black, unscaled and unclipped; then text.
        white, black, text = content.decode('latin-1').split('stream\n')[1].split('\nf\n')
        assert not re.search(r'\b(cm|W)\b', white + black) and ' l\n' not in text
        pages.append(Page('', width, height, [
            (x, height - y - h, w, h) for x, y, w, h in boxes_of(black)], []))
    return pages


def boxes_of(path: str) -> list[Box]:
    """Return the boxes, mm, whose corners follow one another in a path in points."""
    corners = POINT * np.array(re.findall(CORNER, path), dtype=float).reshape(-1, 4, 2)
    low, high = corners.min(axis=1), corners.max(axis=1)
    for box, (left, top), (right, bottom) in zip(corners, low, high):
        assert {tuple(each) for each in box} == {
            (left, top), (right, top), (right, bottom), (left, bottom)}
    return [tuple(box) for box in np.hstack([low, high - low])]


def rasterize(page: Page, per_mm: int = 4, finer: int = 4) -> GrayImage:
    scale = per_mm * finer
    image = np.full((round(page.height * per_mm) * finer, round(page.width * per_mm) * finer),
                    255, dtype=np.uint8)
    for x, y, w, h in page.boxes:
        x0, y0, x1, y1 = (round(v * scale) for v in (x, y, x + w, y + h))
        image[y0:y1, x0:x1] = 0
    return cv2.resize(image, None, fx=1 / finer, fy=1 / finer, interpolation=cv2.INTER_AREA)


def seen(image: GrayImage, dictionary: str = 'DICT_4X4_50') -> tuple[list[int], Array]:
    """
    Return the ids found, and the first marker's width and height, px.

    The black border is measured by its ink, along the middles of its upper and left cells.
    """
    found = detect(image, dictionary)
    left, top = np.rint(found.corners[0].min(axis=0)).astype(int)
    right, bottom = np.rint(found.corners[0].max(axis=0)).astype(int)
    half_cell = (right - left) // (2 * marker_cells(dictionary))
    ink = 1.0 - image[top - 4:bottom + 5, left - 4:right + 5] / 255.0
    return found.ids.tolist(), np.array([ink[4 + half_cell].sum(), ink[:, 4 + half_cell].sum()])


def test_the_pdf_is_to_scale_and_asks_viewers_not_to_scale(tmp_path: Path) -> None:
    assert main([*ISSUE, '--output', str(tmp_path / 'marker.pdf')]) == 0
    pdf = (tmp_path / 'marker.pdf').read_bytes()
    (page,) = pages_of(pdf)
    assert (page.width, page.height) == pytest.approx(PAGES['A3'], abs=1e-4)
    image = rasterize(page)
    ids, size = seen(image)
    assert ids == [0]
    np.testing.assert_allclose(size / 4.0, 160.0, atol=0.1)
    # Upright: the first corner is the top left one.
    assert np.argmin(detect(image, 'DICT_4X4_50').corners[0].sum(axis=1)) == 0
    widths = [w for _, _, w, _ in page.boxes]
    assert max(widths) == pytest.approx(160.0, abs=1e-4)
    assert any(w == pytest.approx(100.0, abs=1e-4) for w in widths)  # the ruler
    catalog = objects_of(pdf)[1]
    assert b'/Version /1.6' in catalog and b'/PrintScaling /None' in catalog


@pytest.mark.parametrize('dictionary', [
    'DICT_4X4_50', 'DICT_6X6_250', 'DICT_7X7_1000', 'DICT_ARUCO_ORIGINAL'])
def test_a_marker_of_every_dictionary_is_detected_when_cut_out(dictionary: str) -> None:
    marker_id = dictionary_size(dictionary) - 1
    image = rasterize(draw(dictionary, layout(dictionary, [marker_id], [0.05])), 5)
    # 5 px/mm: cut inside the corner marks of 0.2 mm and lay it on something dark.
    quiet = 250.0 * max(1.0 / marker_cells(dictionary), 0.16)
    outer, border = int(250.0 + 2.0 * quiet), int(quiet) - 4
    left, top = (image.shape[1] - outer) // 2, np.flatnonzero(np.any(image < 128, axis=1))[0] + 1
    cut = image[top + 2:top + outer - 2, left + 2:left + outer - 2]
    assert cut[:border].min() == 255 and cut[:, :border].min() == 255
    assert cut[-border:].min() == 255 and cut[:, -border:].min() == 255
    ids, size = seen(np.pad(cut, 60, constant_values=40), dictionary)
    assert ids == [marker_id]
    np.testing.assert_allclose(size, 250.0, atol=0.1)


@pytest.mark.parametrize(('sides', 'page'), [
    ([0.01], 'A4'), ([0.149], 'A4'), ([0.15], 'A3'), ([0.25], 'A2'), ([0.12, 0.04], 'A4'),
    ([0.3, 0.06], 'A2'), ([0.06, 0.14, 0.05], 'A3')])
def test_the_page_is_the_smallest_on_which_printers_print_all(
        sides: list[float], page: str) -> None:
    drawing = draw('DICT_4X4_50', layout('DICT_4X4_50', [*range(len(sides))], sides))
    assert (drawing.name, drawing.width, drawing.height) == (page, *PAGES[page])
    for x, y, w, h in drawing.boxes:
        assert min(x, y) > 4.99 and x + w < drawing.width - 4.99 and y + h < drawing.height - 4.99
    for (x0, y0, w0, h0), (x1, y1, w1, h1) in combinations(drawing.boxes, 2):
        assert (min(x0 + w0, x1 + w1) < max(x0, x1) + 1e-9
                or min(y0 + h0, y1 + h1) < max(y0, y1) + 1e-9)
    for x, y, *_ in drawing.texts:
        assert x >= 5.0 and y < drawing.height - 5.0


@pytest.mark.ros
def test_two_runs_write_same_bytes_with_any_matplotlib_setting(tmp_path: Path) -> None:
    first, second = tmp_path / 'a.pdf', tmp_path / 'b.pdf'
    assert main([*ISSUE, '--output', str(first)]) == 0
    rc = tmp_path / 'matplotlibrc'
    rc.write_text('savefig.bbox: tight\nfigure.dpi: 77\nfont.size: 20\nfont.family: serif\n')
    subprocess.run(
        [sys.executable, '-m', 'flock_desk.marker', *ISSUE, '--output', str(second)],
        check=True, capture_output=True,
        env={**os.environ, 'MATPLOTLIBRC': str(rc), 'PYTHONHASHSEED': '7'})
    assert first.read_bytes() == second.read_bytes()


def test_what_it_prints_is_a_neighbors_file(tmp_path: Path,
                                            capsys: pytest.CaptureFixture[str]) -> None:
    main(['--id', '7', '--dictionary', 'DICT_6X6_250', '--size', '0.123', '--output',
          str(tmp_path / 'm.pdf')])
    document = yaml.safe_load(capsys.readouterr().out)
    shipped = yaml.safe_load(resource('config/neighbors.yaml').read_text(encoding='utf-8'))
    (entry,), (example,) = document['neighbors'], shipped['neighbors']
    assert entry == {**example, 'marker_id': 7, 'side_length': 0.123}
    assert neighbors.parse(document).dictionary == 'DICT_6X6_250'


def test_the_panel_holds_the_markers_where_the_entry_says(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ids, sizes = [7, 3, 4], [0.05, 0.2, 0.06]
    assert main(['--panel', '--id', *map(str, ids), '--size', *map(str, sizes), '--output',
                 str(tmp_path / 'm.pdf')]) == 0
    (leader,) = neighbors.parse(yaml.safe_load(capsys.readouterr().out)).neighbors
    assert {m.marker_id: m.side_length for m in leader.markers} == dict(zip(ids, sizes))
    page = draw('DICT_4X4_50', layout('DICT_4X4_50', ids, sizes))
    found = detect(rasterize(page, 2, 4), 'DICT_4X4_50')
    at = {number: corners.mean(axis=0) / 2e3 + 0.25e-3 for number, corners in zip(
        found.ids.tolist(), found.corners)}
    for one, other in combinations(leader.markers, 2):
        right, down = at[other.marker_id] - at[one.marker_id]
        moved = other.T_body_marker.translation - one.T_body_marker.translation
        # Seen from behind, the leader's left is on the left; up is up.
        np.testing.assert_allclose(moved, [0.0, -right, -down], atol=6e-4)  # a pixel is 0.5 mm
    smallest = min(leader.markers, key=lambda marker: marker.side_length)
    np.testing.assert_allclose(smallest.T_body_marker.translation, [-0.2, 0.0, 0.0])


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--dictionary', 'DICT_3X3_50'], "dictionary = 'DICT_3X3_50': must be one of DICT_4X4_100"),
    (['--id', '50'], r'marker_id = 50: DICT_4X4_50 has 0 to 49'),
    (['--id', '2', '2'], r'--id = \[2, 2\]: must name each marker once'),
    (['--size', '160'], r'--size = 160\.0: must be a number in \[0\.01, 2\] m'),
    (['--size', 'nan'], '--size = nan'), (['--size', '1'], 'must fit A2'),
    (['--output', 'marker.docx'], r'--output = marker\.docx: must end in \.pdf'),
    (['--output', '/nowhere/m.pdf'], '/nowhere/m.pdf: No such file or directory'),
    (['--panel', '--id', '1', '2', '3', '--size', '0.3', '0.1'], 'of a panel one for each'),
    (['--size', '0.3', '0.1'], 'must be one side')])
def test_bad_options_end_in_one_line_and_exit_code_2(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
        arguments: list[str], message: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*ISSUE, *arguments]) == 2
    output = capsys.readouterr()
    assert output.err.startswith('error: ') and output.err.count('\n') == 1 and not output.out
    assert re.search(message, output.err)
    assert not list(tmp_path.iterdir())


def test_without_options_it_is_the_marker_of_the_page(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(ISSUE) == 0
    expected = capsys.readouterr().out, (tmp_path / 'marker.pdf').read_bytes()
    for arguments in ([], ['--output', 'marker.pdf']):
        assert main(arguments) == 0
        assert (capsys.readouterr().out, (tmp_path / 'marker.pdf').read_bytes()) == expected


def test_apriltags_are_printed_with_the_way_up_of_others(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for dictionary, noted in (('DICT_APRILTAG_36h11', True), ('DICT_4X4_50', False)):
        assert main(['--dictionary', dictionary, '--output', str(tmp_path / 'marker.pdf')]) == 0
        assert (APRILTAG_NOTE in capsys.readouterr().err) is noted


@pytest.mark.parametrize(('dictionary', 'pixels'), [
    ('DICT_4X4_50', 400), ('DICT_APRILTAG_36h11', 200)])
def test_a_texture_is_detected_upright(tmp_path: Path, dictionary: str, pixels: int) -> None:
    path = tmp_path / 'tag.png'
    assert main(['--id', '3', '--dictionary', dictionary, '--output', str(path),
                 '--pixels', str(pixels)]) == 0
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (pixels, pixels) and set(np.unique(image)) == {0, 255}
    found = detect(np.pad(image, 50, constant_values=255), dictionary)
    assert found.ids.tolist() == [3]
    cell = pixels / (marker_cells(dictionary) + 2)
    np.testing.assert_allclose(found.corners[0][0], [49.5 + cell] * 2, atol=1.5)


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--output', 'x.png', '--pixels', '100'], '8 cells'),
    (['--output', 'x.png', '--pixels', '0'], '8 cells'),
    (['--output', 'x.png', '--id', '0', '1'], 'a .png has one marker'),
    (['--output', 'x.png', '--id', '50'], '--id = 50'),
    (['--output', 'x.pdf', '--pixels', '80'], '--pixels = 80: only')])
def test_a_texture_that_cannot_be_is_refused(
        arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert message in capsys.readouterr().err

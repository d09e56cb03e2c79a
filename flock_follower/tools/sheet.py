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

"""Pages of black boxes and text in millimetres, written to scale as PDF, SVG or PNG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.sax.saxutils import escape
import zlib

import cv2
import numpy as np

from flock_follower.ranges import Range

POINTS = 72.0 / 25.4  # PDF's unit, in a millimetre
MAX_PIXELS = 100_000_000
RESOLUTIONS = Range(50, 2400, whole=True)

#: Left, top, width, height, mm, from the page's top-left corner.
Box = tuple[float, float, float, float]


class Text(NamedTuple):
    """A line of text: left end and baseline, mm from the page's top-left corner; its size, mm."""

    x: float
    y: float
    size: float
    text: str


@dataclass(frozen=True)
class Sheet:
    """
    One page, mm.

    The boxes may touch but not overlap: all are filled as a single path, in which edges that two
    of them share do not show, where boxes filled one by one leave hairlines on a screen.
    """

    width: float
    height: float
    boxes: tuple[Box, ...]
    texts: tuple[Text, ...]


def pdf(sheets: Sequence[Sheet], title: str) -> bytes:
    """
    Return a PDF 1.6 of one page per sheet, uncompressed, without a date.

    It asks viewers to print without scaling, which otherwise is what makes a print wrong.
    """
    pages = [f'{4 + 2 * n} 0 R' for n in range(len(sheets))]
    objects = [
        b'<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>',
        f'<< /Type /Pages /Count {len(sheets)} /Kids [{" ".join(pages)}] >>'.encode(),
        b'<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>']
    for n, sheet in enumerate(sheets):
        content = _pdf_content(sheet)
        box = f'0 0 {_points(sheet.width)} {_points(sheet.height)}'
        objects += [
            f'<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Contents {5 + 2 * n} 0 R '
            '/Resources << /Font << /F 3 0 R >> >> >>'.encode(),
            b'<< /Length %d >>\nstream\n%s\nendstream' % (len(content), content)]
    objects.append(f'<< /Title ({_pdf_string(title)}) >>'.encode())
    # The comment's bytes above 127 tell programs that copy the file that it is not text.
    out = bytearray(b'%PDF-1.6\n%\xe2\xe3\xcf\xd3\n')
    offsets = []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(out))
        out += b'%d 0 obj\n%s\nendobj\n' % (number, body)
    table = len(out)
    out += b'xref\n0 %d\n0000000000 65535 f \n' % (len(objects) + 1)
    out += b''.join(b'%010d 00000 n \n' % offset for offset in offsets)
    out += (b'trailer\n<< /Size %d /Root 1 0 R /Info %d 0 R >>\nstartxref\n%d\n%%%%EOF\n'
            % (len(objects) + 1, len(objects), table))
    return bytes(out)


def _pdf_content(sheet: Sheet) -> bytes:
    # PDF's origin is the bottom left corner.
    lines = [f'{_points(x)} {_points(sheet.height - y - h)} {_points(w)} {_points(h)} re'
             for x, y, w, h in sheet.boxes]
    lines.append('f')
    lines += [f'BT /F {_points(t.size)} Tf {_points(t.x)} {_points(sheet.height - t.y)} Td '
              f'({_pdf_string(t.text)}) Tj ET' for t in sheet.texts]
    return '\n'.join(lines).encode('ascii')


def _points(mm: float) -> str:
    return f'{mm * POINTS:.5f}'


def _pdf_string(text: str) -> str:
    return text.replace('\\', '\\\\').replace('(', '\\(').replace(')', '\\)')


def svg(sheet: Sheet) -> bytes:
    """Return an SVG whose user unit is the millimetre."""
    path = ''.join(f'M{x:.5f} {y:.5f}h{w:.5f}v{h:.5f}h{-w:.5f}z' for x, y, w, h in sheet.boxes)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{sheet.width:g}mm" '
        f'height="{sheet.height:g}mm" viewBox="0 0 {sheet.width:g} {sheet.height:g}">',
        '<rect width="100%" height="100%" fill="white"/>', f'<path d="{path}"/>',
        *(f'<text x="{t.x:.3f}" y="{t.y:.3f}" font-size="{t.size:g}" '
          f'font-family="Helvetica, Arial, sans-serif">{escape(t.text)}</text>'
          for t in sheet.texts), '</svg>', '']
    return '\n'.join(lines).encode('ascii')


def png(sheet: Sheet, dpi: int) -> bytes:
    """
    Return a grey PNG that knows its resolution; edges between pixels are blended, not moved.

    :raises ValueError: where the resolution, or the image it leads to, is out of range.
    """
    RESOLUTIONS.check('dpi', dpi)
    scale = dpi / 25.4
    width, height = round(sheet.width * scale), round(sheet.height * scale)
    if width * height > MAX_PIXELS:
        limit = int(dpi * (MAX_PIXELS / (width * height))**0.5)
        raise ValueError(f'dpi = {dpi}: an image of {width}x{height} px; at most {limit} dpi for '
                         'this page')
    image: Any = np.full((height, width), 255, dtype=np.uint8)
    for x, y, w, h in sheet.boxes:
        column, across = _coverage(x * scale, w * scale, width)
        row, down = _coverage(y * scale, h * scale, height)
        # Truncated: what several boxes cover of one pixel must not add up to more than 255.
        image[row:row + len(down), column:column + len(across)] -= (
            255.0 * np.outer(down, across)).astype(np.uint8)
    for text in sheet.texts:
        capitals = 0.72 * text.size * scale  # 21 px in this font at scale 1
        cv2.putText(image, text.text, (round(text.x * scale), round(text.y * scale)),
                    cv2.FONT_HERSHEY_SIMPLEX, capitals / 21.0, (0,),
                    max(1, round(capitals / 12.0)), cv2.LINE_AA)
    encoded = cv2.imencode('.png', image)[1].tobytes()
    per_metre = round(dpi / 0.0254).to_bytes(4, 'big')
    resolution = b'pHYs' + per_metre + per_metre + b'\x01'
    after_header = 8 + 25  # signature and IHDR
    return b''.join([
        encoded[:after_header], (9).to_bytes(4, 'big'), resolution,
        zlib.crc32(resolution).to_bytes(4, 'big'), encoded[after_header:]])


def _coverage(start: float, length: float, size: int) -> tuple[int, Any]:
    """Return the first pixel that a span, px, touches, and how much of each from there on."""
    first, last = max(int(start), 0), min(int(np.ceil(start + length)), size)
    pixels = np.arange(first, last)
    return first, np.clip(np.minimum(pixels + 1, start + length) - np.maximum(pixels, start),
                          0.0, 1.0)

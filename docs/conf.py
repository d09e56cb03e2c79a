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

"""Configuration of the site that ``make site`` builds with Sphinx from the pages."""

from pathlib import Path
import re
import shutil
import subprocess

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx
from sphinx.errors import SphinxError

project = 'flock_follower'
author = 'The flock_follower developers'
copyright = f'2026, {author}'
extensions = ['myst_parser']
root_doc = 'docs/index'
include_patterns = ['README.md', 'CONTRIBUTING.md', 'SECURITY.md', 'docs/*.md',
                    'config/PARAMETERS.md', 'benchmarks/RESULTS.md', 'bags/README.md',
                    'examples/README.md', 'requirements/README.md']
html_theme = 'furo'
html_static_path = ['static']
html_css_files = ['print.css']
myst_heading_anchors = 3
BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')


def setup(app: Sphinx) -> None:
    """Show diagrams as text: they are Mermaid, which the hosting of the repository draws."""
    app.add_lexer('mermaid', TextLexer)
    app.connect('build-finished', print_card)


def print_card(app: Sphinx, failure: Exception | None) -> None:
    """
    Print the field card as PDF beside its page.

    :raises SphinxError: if it does not fit on one page.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if failure is not None:
        return
    if browser is None:
        print(f'field_card.pdf: not printed, it needs one of {", ".join(BROWSERS)}')
        return
    page = Path(app.outdir) / 'docs' / 'field_card.html'
    pdf = page.with_suffix('.pdf')
    subprocess.run([browser, '--headless', '--no-sandbox', '--disable-gpu',
                    '--no-pdf-header-footer', f'--print-to-pdf={pdf}', page.as_uri()],
                   check=True, capture_output=True, timeout=300)
    pages = len(re.findall(rb'/Type\s*/Page\b', pdf.read_bytes()))
    if pages != 1:
        raise SphinxError(f'{pdf}: {pages} pages, must be one')
    print(pdf)

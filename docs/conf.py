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

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

project = 'flock_follower'
author = 'The flock_follower developers'
copyright = f'2026, {author}'
extensions = ['myst_parser']
root_doc = 'docs/index'
include_patterns = ['README.md', 'CONTRIBUTING.md', 'SECURITY.md', 'docs/*.md',
                    'config/PARAMETERS.md', 'benchmarks/RESULTS.md', 'bags/README.md',
                    'examples/README.md', 'requirements/README.md']
html_theme = 'furo'
myst_heading_anchors = 3


def setup(app: Sphinx) -> None:
    """Show diagrams as text: they are Mermaid, which the hosting of the repository draws."""
    app.add_lexer('mermaid', TextLexer)

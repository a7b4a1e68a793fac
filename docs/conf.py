# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The site of these pages: sphinx-build -W docs site."""

from pathlib import Path
import re
import sys

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

project = 'odocal_ros'
author = 'odocal_ros maintainers'
copyright = '2026, odocal_ros maintainers, Apache-2.0'      # noqa: A001 Sphinx's name
version = release = re.search(r"^__version__ = '(.+)'$", (
    ROOT / 'odocal_ros' / '__init__.py').read_text(encoding='utf-8'), re.MULTILINE).group(1)

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'sphinx.ext.mathjax']
myst_enable_extensions = ['dollarmath', 'amsmath']
myst_heading_anchors = 3
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'
napoleon_google_docstring = False
# else -- becomes a dash, in options too
smartquotes = False
html_theme = 'furo'
html_title = f'odocal_ros {release}'
exclude_patterns = ['_build', 'site']
# pages that GitHub shows too name files beside docs/ by path: no pages of the site
suppress_warnings = ['myst.xref_missing']

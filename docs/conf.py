# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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

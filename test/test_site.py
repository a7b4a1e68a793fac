# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The pages as a site: it builds without a warning, and all pages are in it."""

from pathlib import Path
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parent.parent


def test_the_site_builds_without_a_warning(tmp_path):
    for name in ('sphinx', 'myst_parser', 'furo'):
        pytest.importorskip(name, reason='no Sphinx here: pip install odocal_ros[docs]')
    done = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '-q', '-d', tmp_path / 'doctrees', ROOT / 'docs',
         tmp_path / 'site'], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    pages = {p.relative_to(ROOT / 'docs').with_suffix('') for p in (ROOT / 'docs').rglob('*.md')}
    assert pages == {p.relative_to(tmp_path / 'site').with_suffix('') for p in (
        tmp_path / 'site').rglob('*.html') if p.stem not in ('search', 'genindex', 'py-modindex')}
    assert 'calibrate_bag' in (tmp_path / 'site' / 'api.html').read_text()

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The linters of ament, if installed, and the documentation built as a site."""

from importlib import import_module
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parent.parent
CODE = [str(ROOT / name) for name in (
    'odocal_ros', 'examples', 'launch', 'tools', 'setup.py', 'reproductions/odocal_reproductions',
    'reproductions/setup.py')]


def linter(name):
    reason = f'NO {name} HERE: apt install ros-jazzy-{name.replace("_", "-")}'
    pytest.importorskip(name, reason=reason)
    return import_module(f'{name}.main')


def test_flake8():
    profile = str(Path(__file__).with_name('ament_flake8.ini'))
    code, errors = linter('ament_flake8').main_with_errors(argv=['--config', profile, *CODE])
    assert code == 0, '\n'.join(errors)


def test_pep257(capsys):
    assert linter('ament_pep257').main(argv=CODE) == 0, capsys.readouterr()


def test_copyright(capsys):
    assert linter('ament_copyright').main(argv=CODE) == 0, capsys.readouterr()


def test_xmllint(capsys):
    main = linter('ament_xmllint').main
    if shutil.which('xmllint') is None:
        pytest.skip('NO xmllint HERE: apt install libxml2-utils')
    files = [str(path) for path in (ROOT / 'package.xml', ROOT / 'reproductions' / 'package.xml',
                                    *(ROOT / 'launch').glob('*.xml'))]
    code, said = main(argv=files), capsys.readouterr()
    if 'failed to load' in said.err and 'package_format3' in said.err:
        pytest.skip('NO NETWORK: the schema of package.xml is at download.ros.org')
    assert code == 0, said


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

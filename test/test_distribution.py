# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sdist and wheel are complete; files for conda and containers name all requirements."""

import email
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import tarfile
import tomllib
from xml.etree import ElementTree
import zipfile

import pytest
import yaml

import odocal_ros

ROOT = Path(__file__).resolve().parent.parent
VERSION = odocal_ros.__version__
REPOSITORY = 'https://example.org/odocal_ros'
XML = ElementTree.parse(ROOT / 'package.xml').getroot()


def repository_files():
    listed = subprocess.run(['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip('NO GIT REPOSITORY HERE: nothing to compare the sdist with')
    return {name for name in listed.stdout.split('\0') if name and (ROOT / name).exists()}


def run(*words, cwd):
    done = subprocess.run([sys.executable, *map(str, words)], cwd=cwd, capture_output=True,
                          text=True)
    if 'No matching distribution found for setuptools' in done.stderr:
        pytest.skip('NO PACKAGE INDEX HERE: pip could not fetch setuptools to build with')
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope='module')
def distributions(tmp_path_factory):
    """Build an sdist of the files in git, and a wheel of that sdist; return both."""
    pytest.importorskip('setuptools', reason='NO SETUPTOOLS HERE: no sdist can be built')
    work = tmp_path_factory.mktemp('distribution')
    for name in repository_files():
        target = work / 'source' / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((ROOT / name).read_bytes())
        target.chmod((ROOT / name).stat().st_mode)
    run('setup.py', '-q', 'sdist', '--dist-dir', work, cwd=work / 'source')
    sdist = work / f'odocal_ros-{VERSION}.tar.gz'
    with tarfile.open(sdist) as archive:
        archive.extractall(work, filter='data')
    run('-m', 'pip', 'wheel', '-q', '--no-deps', '--disable-pip-version-check', '-w', work,
        work / f'odocal_ros-{VERSION}', cwd=work)
    return sdist, work / f'odocal_ros-{VERSION}-py3-none-any.whl'


def test_the_sdist_contains_the_files_of_the_repository(distributions):
    with tarfile.open(distributions[0]) as archive:
        held = {m.name.partition('/')[2] for m in archive.getmembers() if m.isfile()}
    made = {name for name in held if '.egg-info/' in name} | {'PKG-INFO', 'setup.cfg'}
    assert held - made == repository_files() - {'setup.cfg'}


def test_the_wheel_contains_the_package_and_its_files(distributions):
    with zipfile.ZipFile(distributions[1]) as wheel:
        held = set(wheel.namelist())
        about = email.message_from_bytes(wheel.read(f'odocal_ros-{VERSION}.dist-info/METADATA'))
        entries = wheel.read(f'odocal_ros-{VERSION}.dist-info/entry_points.txt').decode()
    package = {name for name in repository_files() if name.startswith('odocal_ros/')}
    assert {name for name in held if name.startswith('odocal_ros/')} == package
    share = f'odocal_ros-{VERSION}.data/data/share/odocal_ros/'
    assert {name.removeprefix(share) for name in held if name.startswith(share)} == {
        'package.xml', *(name for name in repository_files()
                         if name.startswith(('config/', 'launch/')))}
    assert set(re.findall(r'^(\w+) = odocal_ros', entries, re.MULTILINE)) >= {
        'calibrator', 'drive_pattern', 'odocal', 'odometry'}
    assert {'fleet', 'kilted', 'ros', 'tables', 'watch'} <= set(about.get_all('Provides-Extra'))
    assert about['Description-Content-Type'] == 'text/markdown'


def index_page():
    """Return the function of setup.py, which runs setup when it is imported."""
    text = (ROOT / 'setup.py').read_text().partition('def index_page')
    names = {'re': re, 'VERSION': VERSION}
    exec(text[1] + text[2].partition('\n\n\n')[0], names)
    return names['index_page']


def test_links_of_the_readme_resolve_on_an_index_page():
    text = '![A picture](docs/a.png)\n\nRead [node.md](docs/node.md) or [x](https://a.b/c).'
    assert index_page()(text, REPOSITORY) == (
        f'![A picture]({REPOSITORY}/raw/{VERSION}/docs/a.png)\n\n'
        f'Read [node.md]({REPOSITORY}/blob/{VERSION}/docs/node.md) or [x](https://a.b/c).')
    assert index_page()(text, '') == 'Read node.md or [x](https://a.b/c).'
    readme = (ROOT / 'README.md').read_text()
    for repository in (REPOSITORY, ''):
        page = index_page()(readme, repository)
        assert not re.findall(r'\]\((?!https?:)', page)
        assert page.count('![') == (readme.count('![') if repository else 0)


def test_an_index_renders_the_readme():
    markdown = pytest.importorskip('readme_renderer.markdown', reason='no readme_renderer here')
    html = markdown.render(index_page()((ROOT / 'README.md').read_text(), REPOSITORY))
    assert f'src="{REPOSITORY}/raw/{VERSION}/docs/pictures/' in html


def required():
    """Return the packages that setup.py requires, as conda names them."""
    block = (ROOT / 'setup.py').read_text().partition('install_requires=[')[2].partition(']')[0]
    names = {name.lower() for name in re.findall(r"'([A-Za-z0-9]+)", block)}
    return {{'matplotlib': 'matplotlib-base'}.get(name, name) for name in names}


def test_conda_files_name_what_setup_requires():
    recipe = yaml.safe_load((ROOT / 'conda' / 'recipe.yaml').read_text())
    needed = {line.split()[0] for line in recipe['requirements']['run']}
    keys = {e.text for e in XML.findall('exec_depend')}
    ros = {f'ros-jazzy-{key.replace("_", "-")}' for key in keys if not key.startswith('python3-')}
    optional = {'rosbags'}       # on PyPI only
    assert needed == required() - optional | ros | {'python', 'rich'}
    assert recipe['context']['version'] == VERSION
    pixi = tomllib.loads((ROOT / 'pixi.toml').read_text())
    assert set(pixi['dependencies']) >= required() - optional
    assert set(pixi['pypi-dependencies']) >= optional
    assert pixi['workspace']['version'] == VERSION
    assert set(pixi['environments']['default']) <= set(pixi['feature'])


def test_the_container_uses_files_that_exist():
    text = (ROOT / 'Dockerfile').read_text()
    targets = re.findall(r'^FROM \S+ AS (\w+)$', text, re.MULTILINE)
    assert targets == ['offline', 'ros']
    container = json.loads((ROOT / '.devcontainer' / 'devcontainer.json').read_text())
    folder = ROOT / '.devcontainer'
    assert (folder / container['build']['dockerfile']).samefile(ROOT / 'Dockerfile')
    assert container['build']['target'] in targets
    assert os.access(ROOT / 'tools' / 'test', os.X_OK)

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The package as installed by pip and colcon: declared requirements and commands."""

import ast
from functools import cache
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import uuid
from xml.etree import ElementTree

import pytest
import yaml

import odocal_ros
from odocal_ros.safe_io import licence

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parent.parent
PARTS = ('package.xml', 'setup.py', 'setup.cfg', 'pyproject.toml', 'README.md', 'LICENSE',
         'resource', 'config', 'launch', 'odocal_ros')
XML = ElementTree.parse(ROOT / 'package.xml').getroot()
# import name: its names in package.xml and setup.py
KEYS = {name: (f'python3-{name}', name) for name in (
    'numpy', 'jinja2', 'matplotlib', 'pyproj', 'rich', 'scipy', 'tqdm')} | {
        'yaml': ('python3-yaml', 'PyYAML'), 'rosbags': ('rosbags', 'rosbags')}
EXTRA = {'rich': 'watch'}     # import name: the extra of setup.py that installs it
TABLES = {'pandas', 'pyarrow'}      # extra tables: an error states what to install
# of the extra for fleets, by pip only: not needed on the computer of a vehicle
FLEET = {'dask', 'distributed', 'fsspec'} | TABLES
WITH_DISTRIBUTED = {'psutil'}
# an error states how to install them: rosdep has no key of the first, not everywhere of rich
BY_PIP = {'rosbags', 'rich', 'rerun'}
WITH_ROSBAGS = {'lz4', 'backports', 'compression'}  # decompressors that rosbags itself requires


@cache
def imported():
    """Return the names of all foreign packages that the package and its launch files import."""
    names = set()
    for path in [*(ROOT / 'odocal_ros').rglob('*.py'), *(ROOT / 'launch').rglob('*.py')]:
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(node.module.split('.')[0])
    return names - set(sys.stdlib_module_names) - {'odocal_ros'} - WITH_ROSBAGS - TABLES


def test_all_files_have_the_same_version():
    version = odocal_ros.__version__
    assert XML.findtext('version') == version
    changes = (ROOT / 'CHANGELOG.rst').read_text()
    assert re.search(r'^(\d+\.\d+\.\d+) \(', changes, re.MULTILINE).group(1) == version
    second = ROOT / 'reproductions'
    assert ElementTree.parse(second / 'package.xml').findtext('version') == version
    assert f"__version__ = '{version}'" in (
        second / 'odocal_reproductions' / '__init__.py').read_text()
    cited = yaml.safe_load((ROOT / 'CITATION.cff').read_text())
    assert cited['version'] == version


def test_each_source_file_has_a_copyright_and_a_licence():
    header, = licence.SPDX.file_headers
    text = header.format(copyright='Copyright 2026 odocal_ros maintainers')
    head = '\n'.join(f'# {line}' for line in text.splitlines())
    assert (ROOT / 'setup.py').read_text().startswith(f'{head}\n\n')
    assert f'{licence.__name__}:SPDX' in (ROOT / 'setup.py').read_text()
    folders = ('odocal_ros', 'reproductions', 'test', 'tools', 'benchmarks', 'examples', 'launch',
               'docs')
    files = [path for folder in folders for path in (ROOT / folder).rglob('*.py')]
    assert len(files) > 500
    assert [path for path in files if path.stat().st_size
            and head not in path.read_text(encoding='utf-8')[:1000]] == []


def test_the_changelog_has_the_format_of_bloom():
    changelog = pytest.importorskip('catkin_pkg.changelog', reason='no catkin_pkg here')
    found = changelog.get_changelog_from_path(str(ROOT), 'odocal_ros')
    newest, date, content = next(found.foreach_version())
    assert newest == odocal_ros.__version__
    assert date is not None
    assert len(content[0].bullets) > 10


def test_package_xml_names_all_imported_packages():
    declared = {e.text for e in XML.findall('exec_depend')}
    wanted = {KEYS[name][0] if name in KEYS else name
              for name in imported() - FLEET - WITH_DISTRIBUTED - BY_PIP}
    assert len(wanted) > 10
    assert wanted <= declared
    assert XML.attrib['format'] == '3'
    assert XML.findtext('export/build_type') == 'ament_python'


def test_the_quality_declaration_lists_each_dependency_with_its_check():
    page = (ROOT / 'QUALITY_DECLARATION.md').read_text()
    table = page.partition('| key | Debian')[2].partition('\n\n')[0]
    rows = [line.split('|') for line in table.splitlines()[2:]]
    listed = [key for row in rows for key in re.findall(r'`(\w[\w-]*)`', row[1])]
    assert sorted(listed) == sorted(e.text for kind in ('depend', 'exec_depend', 'test_depend')
                                  for e in XML.findall(kind))
    assert all(row[2].strip() and row[3].strip() for row in rows)


def test_setup_requires_all_imported_packages_except_ros():
    setup = (ROOT / 'setup.py').read_text()
    block = setup.partition('install_requires=[')[2].partition(']')[0]
    required = set(re.findall(r"'([A-Za-z0-9]+)", block))
    foreign = imported() & set(KEYS) - set(EXTRA)
    assert required == {KEYS[name][1] for name in foreign}
    assert {name for name in TABLES if f"'{name}" in setup.partition("'tables': [")[2].partition(
        ']')[0]} == TABLES
    listed = setup.partition('FLEET = [')[2].partition(']')[0]
    # Dask imports it, to make the keys of local workers
    assert set(re.findall(r"'([a-z]+)", listed)) - {'cryptography'} == FLEET
    assert imported() | TABLES >= FLEET
    for name, extra in EXTRA.items():
        assert f"'{KEYS[name][1]}" in setup.partition(f"'{extra}': [")[2].partition(']')[0]


def copy_of_the_package(target: Path) -> Path:
    target.mkdir(parents=True)
    for part in PARTS:
        source = ROOT / part
        if source.is_dir():
            shutil.copytree(source, target / part,
                            ignore=shutil.ignore_patterns('__pycache__', '*.egg-info'))
        else:
            shutil.copy(source, target / part)
    return target


def clean_environment(**more) -> dict[str, str]:
    """Return the environment without variables of this interpreter or checkout."""
    drop = ('PYTHONPATH', 'PYTHONHOME', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH')
    return {k: v for k, v in os.environ.items()
            if k not in drop and not k.startswith(('_ROS_', 'COLCON_'))} | more


def run(*command, **more):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.mark.parametrize('editable', [False, True], ids=['plain', 'editable'])
def test_pip_puts_both_commands_on_the_path(tmp_path, editable):
    source = copy_of_the_package(tmp_path / 'source')
    run(sys.executable, '-m', 'venv', '--without-pip', tmp_path / 'venv', env=clean_environment())
    bin_ = tmp_path / 'venv' / 'bin'
    install = subprocess.run(
        [sys.executable, '-m', 'pip', '--python', bin_ / 'python', 'install', '--no-deps',
         '--disable-pip-version-check', *(['--editable'] if editable else []), str(source)],
        capture_output=True, text=True, env=clean_environment(), cwd=tmp_path)
    if 'No matching distribution found for setuptools' in install.stderr:
        pytest.skip('NO PACKAGE INDEX HERE: pip could not fetch setuptools to build with')
    assert install.returncode == 0, install.stderr
    assert (bin_ / 'calibrator').exists()
    share = tmp_path / 'venv' / 'share'
    assert (share / 'odocal_ros' / 'package.xml').exists() or editable
    env = clean_environment()
    assert 'replay' in run(bin_ / 'odocal', '--help', env=env, cwd=tmp_path).stdout
    version = run(bin_ / 'odocal', '--version', env=env, cwd=tmp_path).stdout
    assert version.strip() == f'odocal_ros {odocal_ros.__version__}'
    for command in ('calibrator', 'odometry'):
        done = subprocess.run([bin_ / command], capture_output=True, text=True, env=env)
        assert done.returncode == 2
        assert done.stderr.startswith(f'{command}: a live node needs ROS 2 (Python module ')
        assert done.stderr.count('\n') == 1


@pytest.fixture(scope='module')
def installed(tmp_path_factory):
    """Build the package with colcon and return its install folder."""
    colcon = shutil.which('colcon', path=str(Path(sys.executable).parent))
    if colcon is None:
        pytest.skip('NO COLCON beside this Python: pip install colcon-common-extensions')
    work = tmp_path_factory.mktemp('colcon')
    copy_of_the_package(work / 'src' / 'odocal_ros')
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ['PATH']])
    run(colcon, '--log-base', 'log', 'build', cwd=work, env=clean_environment(PATH=path))
    return work / 'install' / 'odocal_ros'


def environment_of(installed) -> dict[str, str]:
    site, = installed.glob('lib/python3*/site-packages')
    return clean_environment(PYTHONPATH=str(site))


def test_colcon_installs_the_commands_for_ros2_run(installed):
    assert {p.name for p in (installed / 'lib' / 'odocal_ros').iterdir()} == {
        'calibrator', 'drive_pattern', 'odocal', 'odometry'}
    share = installed / 'share'
    assert (share / 'ament_index' / 'resource_index' / 'packages' / 'odocal_ros').exists()
    assert (share / 'odocal_ros' / 'package.xml').exists()
    assert (share / 'odocal_ros' / 'config' / 'calibrator.yaml').exists()
    assert (share / 'odocal_ros' / 'launch' / 'calibrator.launch.py').exists()
    out = run(installed / 'lib' / 'odocal_ros' / 'odocal', '--help',
              env=environment_of(installed), cwd=installed).stdout
    assert 'replay' in out


def test_the_node_installed_by_colcon_starts_and_ends(installed):
    rclpy = pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')
    from std_srvs.srv import Trigger
    space = f'package_{uuid.uuid4().hex}'
    node = subprocess.Popen(
        [installed / 'lib' / 'odocal_ros' / 'calibrator', '--ros-args', '-r', f'__ns:=/{space}',
         '--params-file', installed / 'share' / 'odocal_ros' / 'config' / 'calibrator.yaml'],
        env=environment_of(installed), cwd=installed, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True)
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        client = rclpy.create_node('looks', context=context)
        service = client.create_client(Trigger, f'/{space}/calibrator/start_leg')
        answers = service.wait_for_service(timeout_sec=30)
    finally:
        rclpy.shutdown(context=context)
        node.send_signal(signal.SIGINT)
        output, _ = node.communicate(timeout=30)
    assert answers, output
    assert node.returncode == 0, output
    assert 'Traceback' not in output

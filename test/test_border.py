"""Who may import whom: the border is a folder, and this test."""

import ast
from pathlib import Path
import subprocess
import sys

import pytest

import odocal_ros

PACKAGE = Path(odocal_ros.__file__).parent
HEAVY = ('rclpy', 'rosbags', 'yaml', 'matplotlib', 'scipy', 'pyproj', 'tqdm')
ROS = {'rclpy', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs',
       'rcl_interfaces', 'rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs'}
# what a folder may use of the package besides what everybody may
COMMON = {'samples', 'config', 'errors', 'reasons'}
MAY_USE = {'nav': {'nav'}, 'calib': {'nav', 'calib', 'leg', 'grades'}}
NEVER = {'live': {'offline', 'sim'}, 'offline': {'live'}, 'sim': {'live', 'calib', 'pipeline'},
         'output': {'live', 'offline', 'bagio'}, 'bagio': {'live', 'offline', 'pipeline', 'calib'},
         'messages': {'live', 'offline', 'pipeline', 'nav', 'calib', 'sim', 'output'},
         'pipeline': {'live', 'offline', 'bagio', 'output', 'messages', 'sim'},
         'paper': {'live', 'offline', 'bagio', 'output', 'messages'},
         'align': {'live', 'offline', 'bagio', 'output', 'messages', 'sim', 'paper', 'pipeline'},
         'leg_run': {'live', 'offline', 'bagio', 'output', 'messages', 'sim', 'paper'},
         'apply': {'live', 'offline', 'bagio', 'output', 'messages', 'sim', 'paper', 'pipeline'},
         'screen': {'live', 'offline', 'bagio', 'output', 'messages', 'sim', 'paper', 'pipeline'}}


def _modules():
    return sorted(PACKAGE.rglob('*.py'))


def _part(path):
    """Return the folder of the package, or the module that lies directly in it."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix('.py')


def _imports(path):
    """Yield the full name of all that a module imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def _own_parts(path):
    """Return the parts of the package that a module imports."""
    names = (name.split('.') for name in _imports(path))
    return {name[1] for name in names if name[0] == 'odocal_ros' and len(name) > 1
            and not name[1].startswith('_')}


@pytest.mark.parametrize('module', [
    'odocal_ros.pipeline.calibrate', 'odocal_ros.calib.two_point', 'odocal_ros.nav.strapdown',
    'odocal_ros.data.leg', 'odocal_ros.messages.decode', 'odocal_ros.settings.config_file', 'odocal_ros.output.files',
    'odocal_ros.output.summary', 'odocal_ros.bagio.read', 'odocal_ros.offline.replay',
    'odocal_ros.apply.odometry'])
def test_imports_at_the_top_stay_light(module):
    probe = f'import {module}, sys; print([m for m in {HEAVY} if m in sys.modules])'
    assert subprocess.check_output([sys.executable, '-c', probe], text=True).strip() == '[]'


def test_help_and_usage_errors_import_not_even_numpy():
    for argv in (['--help'], ['replay'], ['--version']):
        probe = (f'import sys; from odocal_ros.offline.cli import main\n'
                 f'try: main({argv})\nexcept SystemExit: pass\n'
                 f'print([m for m in {("numpy", *HEAVY)} if m in sys.modules])')
        out = subprocess.check_output([sys.executable, '-c', probe], text=True,
                                      stderr=subprocess.DEVNULL)
        assert out.strip().splitlines()[-1] == '[]', argv


def test_ros_is_imported_in_live_only():
    users = {_part(p) for p in _modules() for name in _imports(p) if name.split('.')[0] in ROS}
    assert users == {'live'}


def test_rosbags_is_imported_in_bagio_only():
    users = {_part(p) for p in _modules() for name in _imports(p)
             if name.split('.')[0] == 'rosbags'}
    assert users == {'bagio'}


@pytest.mark.parametrize('part', sorted(MAY_USE))
def test_the_inner_parts_use_only_what_lies_further_in(part):
    used = {(p.name, own) for p in _modules() if _part(p) == part for own in _own_parts(p)}
    assert used, f'nothing in {part} was looked at'
    assert {(name, own) for name, own in used if own not in MAY_USE[part] | COMMON} == set()


@pytest.mark.parametrize('part', sorted(NEVER))
def test_parts_that_must_not_see_each_other_do_not(part):
    looked_at = [p for p in _modules() if _part(p) == part]
    assert looked_at
    assert {(p.name, own) for p in looked_at for own in _own_parts(p) & NEVER[part]} == set()


def test_the_pure_parts_ask_no_clock_and_open_nothing():
    pure = [p for p in _modules() if _part(p) in (
        'nav', 'calib', 'pipeline', 'align', 'screen', 'row_screen', 'apply', 'parts', 'automatic',
        'odometer_steps')]
    assert len(pure) > 10
    for path in pure:
        tree = ast.parse(path.read_text(encoding='utf-8'))
        called = {node.func.id for node in ast.walk(tree)
                  if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert not called & {'print', 'open', 'input'}, path
        outside = {name.split('.')[0] for name in _imports(path)}
        assert not outside & {'time', 'datetime', 'logging', 'random', 'os', 'pathlib'}, path

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
# the rooms in the order of the data, and what each uses of those above it; all: errors, reasons
ROOMS = {
    'outside': '', 'data': '',
    'settings': 'outside',
    'messages': 'data settings',
    'bagio': 'messages outside',
    'nav': 'data',
    'screening': 'data nav settings',
    'calib': 'data nav screening settings',
    'patent': 'nav',
    'pipeline': 'calib data nav patent screening settings',
    'plan': 'calib data nav screening settings',
    'foresee': 'calib data nav pipeline plan screening settings',
    'apply': 'calib data nav settings',
    'sim': 'data nav settings',
    'paper': 'calib nav pipeline settings sim',
    'output': 'calib nav outside paper patent pipeline settings',
    'live': 'apply bagio calib data foresee messages output outside pipeline settings',
    'offline': 'bagio calib data messages nav output outside paper patent pipeline plan '
               'screening settings sim'}
COMMON = {'errors', 'reasons'}


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
    'odocal_ros.data.leg', 'odocal_ros.messages.decode', 'odocal_ros.settings.config_file',
    'odocal_ros.output.files', 'odocal_ros.output.summary', 'odocal_ros.bagio.read',
    'odocal_ros.offline.replay', 'odocal_ros.apply.odometry'])
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


@pytest.mark.parametrize('room', ROOMS)
def test_a_room_uses_what_the_table_says(room):
    used = {own for p in _modules() if _part(p) == room for own in _own_parts(p)}
    assert used - COMMON - {room} == set(ROOMS[room].split())


def test_the_rooms_stand_in_order_and_nothing_else_lies_beside_them():
    order = list(ROOMS)
    for room, used in ROOMS.items():      # so that there is no way back
        assert all(order.index(other) < order.index(room) for other in used.split()), room
    assert {_part(p) for p in _modules()} == set(ROOMS) | COMMON | {'__init__'}
    for common in COMMON:
        assert not _own_parts(PACKAGE / f'{common}.py')


def test_the_pure_parts_ask_no_clock_and_open_nothing():
    pure = [p for p in _modules() if _part(p) in (
        'nav', 'screening', 'calib', 'patent', 'pipeline', 'plan', 'apply')]
    assert len(pure) > 10
    for path in pure:
        tree = ast.parse(path.read_text(encoding='utf-8'))
        called = {node.func.id for node in ast.walk(tree)
                  if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert not called & {'print', 'open', 'input'}, path
        outside = {name.split('.')[0] for name in _imports(path)}
        assert not outside & {'time', 'datetime', 'logging', 'random', 'os', 'pathlib'}, path

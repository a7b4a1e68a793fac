# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Imports between packages: the allowed ones, and the order of the packages."""

import ast
from functools import cache
from pathlib import Path
import subprocess
import sys

import pytest

import odocal_ros
from odocal_ros import estimator
from odocal_ros.offline.cli import COMMANDS

pytestmark = pytest.mark.core
PACKAGE = Path(odocal_ros.__file__).parent
HEAVY = ('rclpy', 'rosbags', 'yaml', 'matplotlib', 'scipy', 'pyproj', 'tqdm')
ROS = {'rclpy', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs',
       'rcl_interfaces', 'rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs'}
# packages in the order of the data, and those above that each uses; all: errors, reasons
PACKAGES = {
    'safe_io': '', 'data': '',
    'settings': 'data safe_io',
    'nav': 'data settings',
    'messages': 'data nav settings',
    'bagio': 'data messages safe_io',
    'screening': 'data nav settings',
    'calib': 'data nav screening settings',
    'estimator': 'calib data nav screening settings',
    'pipeline': 'calib data estimator nav screening settings',
    'forecast': 'calib data estimator nav pipeline screening settings',
    'pattern': 'settings',
    'apply': 'calib data nav screening settings',
    'sim': 'data nav settings',
    'output': 'calib data estimator nav safe_io pipeline settings',
    'live': 'apply bagio calib data forecast messages output safe_io pattern pipeline settings',
    'library': 'bagio calib data estimator forecast messages nav output safe_io pipeline '
               'screening settings sim',
    'offline': 'bagio calib data forecast library messages nav output safe_io pipeline '
               'screening settings sim',
    'fleet': 'bagio calib library nav offline safe_io output pipeline settings'}
COMMON = {'errors', 'reasons'}


def _modules():
    return sorted(PACKAGE.rglob('*.py'))


def _package_of(path):
    """Return the package of a module, or its own name if it is in none."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix('.py')


@cache
def _imports(path):
    """Return the full name of all that a module imports, inside functions too."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            names += [f'{node.module}.{alias.name}' for alias in node.names]
    return names


def _imported_packages(path):
    names = (name.split('.') for name in _imports(path))
    return {name[1] for name in names if name[0] == 'odocal_ros' and len(name) > 1
            and not name[1].startswith('_')}


def test_imports_at_the_top_stay_light():
    modules = ('pipeline.calibrate', 'calib.two_point', 'nav.strapdown', 'data.leg',
               'messages.decode', 'settings.config_file', 'output.files', 'output.summary',
               'bagio.read', 'offline.replay', 'apply.odometry', 'library.calibrate_bag')
    probe = ('import importlib, sys\n'
             f'for name in {modules}:\n'
             "    importlib.import_module(f'odocal_ros.{name}')\n"
             f'    print([(name, m) for m in {HEAVY} if m in sys.modules])\n')
    found = subprocess.check_output([sys.executable, '-c', probe], text=True).split('\n')
    assert found == ['[]'] * len(modules) + ['']


def test_a_method_that_does_not_run_is_not_imported():
    probe = ('import odocal_ros.library.calibrate_bag, odocal_ros.pipeline.calibrate, '
             'odocal_ros.output.files, odocal_ros.output.stored, '
             'odocal_ros.library.find_legs, sys\n'
             "packages = ('odocal_ros.estimator', 'odocal_ros.calib.wheel_search', "
             "'odocal_ros.calib.wheels.')\n"
             'print([m for m in sys.modules if m.startswith(packages)'
             " and m != 'odocal_ros.calib.slip'])")
    assert subprocess.check_output([sys.executable, '-c', probe], text=True).strip() == '[]'


def test_help_and_usage_errors_import_not_even_numpy():
    commands = [[], ['--help'], ['--version'], ['nothing'], ['replay'], ['inspect'], ['compare'],
                *([command, option] for command in COMMANDS for option in ('--help', '--nothing'))]
    probe = (f'import sys; from odocal_ros.offline.cli import main\n'
             f'for argv in {commands}:\n'
             f'    try: main(argv)\n    except SystemExit: pass\n'
             f'    found = [m for m in {("numpy", *HEAVY)} if m in sys.modules]\n'
             f'    assert not found, (argv, found)\n')
    subprocess.run([sys.executable, '-c', probe], stdout=subprocess.DEVNULL, check=True)


def test_ros_rosbags_and_reproductions_are_imported_only_where_allowed():
    users = {_package_of(p) for p in _modules() for name in _imports(p)
             if name.split('.')[0] in ROS}
    assert users == {'live'}
    assert not {name for path in _modules() for name in _imports(path)
                if name.startswith('odocal_reproductions')}
    users = {_package_of(p) for p in _modules() for name in _imports(p)
             if name.split('.')[0] == 'rosbags'}
    assert users == {'bagio'}


def test_dask_is_imported_in_fleet_only_and_never_at_the_top():
    users = {_package_of(p) for p in _modules() for name in _imports(p)
             if name.split('.')[0] in ('dask', 'distributed', 'fsspec')}
    assert users == {'fleet'}
    probe = ('import odocal_ros.fleet.command, odocal_ros.fleet.fleet_results, '
             'odocal_ros.fleet.bag_jobs, sys; '
             "heavy = ('dask', 'distributed', 'fsspec', 'pandas', 'pyarrow'); "
             'print([m for m in heavy if m in sys.modules])')
    assert subprocess.check_output([sys.executable, '-c', probe], text=True).strip() == '[]'


@pytest.mark.parametrize('package', PACKAGES)
def test_a_package_uses_only_those_in_the_table(package):
    used = {other for p in _modules() if _package_of(p) == package
            for other in _imported_packages(p)}
    assert used - COMMON - {package} == set(PACKAGES[package].split())


def test_live_and_forecast_use_only_public_names_of_the_estimator():
    public = {f'odocal_ros.estimator.{name}' for name in estimator.__all__}
    # forecasts of planned drives
    planned = ('ideal_samples', 'planned_indoor', 'planned_methods')
    used = {name for path in _modules() if _package_of(path) in ('live', 'forecast')
             and path.stem not in planned
             for name in _imports(path) if name.startswith('odocal_ros.estimator')}
    assert used
    assert used <= public


def test_the_table_has_all_packages_in_order():
    order = list(PACKAGES)
    for package, used in PACKAGES.items():      # no circular imports
        assert all(order.index(other) < order.index(package) for other in used.split()), package
    found = {_package_of(p) for p in _modules()}
    assert found == set(PACKAGES) | COMMON | {'__init__', '__main__'}
    for common in COMMON:
        assert not _imported_packages(PACKAGE / f'{common}.py')


def test_pure_packages_use_no_clock_and_no_file():
    pure = [p for p in _modules() if _package_of(p) in (
        'nav', 'screening', 'calib', 'estimator', 'pipeline', 'forecast', 'apply')
            and p.stem != 'leg_so_far']      # it measures how long its own passes take
    assert len(pure) > 10
    for path in pure:
        tree = ast.parse(path.read_text(encoding='utf-8'))
        called = {node.func.id for node in ast.walk(tree)
                  if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert not called & {'print', 'open', 'input'}, path
        outside = {name.split('.')[0] for name in _imports(path)}
        assert not outside & {'time', 'datetime', 'logging', 'random', 'os', 'pathlib'}, path


def test_each_package_has_a_core_test():
    marked = [path for path in Path(__file__).parent.rglob('test_*.py')
              if 'pytest.mark.core' in path.read_text(encoding='utf-8')]
    assert set(PACKAGES) - set().union(*map(_imported_packages, marked)) == set()

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The public names and their arguments do not change."""

import inspect
import subprocess
import sys

import pytest

import odocal_ros
from odocal_ros.library.calibration import Calibration

pytestmark = pytest.mark.core
SIGNATURES = {
    'calibrate_bag': '(path, topics=None, config=None, legs=None, *, holdout=False, '
                     'listener=None)',
    'read_bag': '(path, topics=None, config=None, *, listener=None)',
    'simulate': "(scenario='town', out=None, *, storage='mcap', compression='none', force=False, "
                'heading_sigma=None, progress=None, **options)',
    'plan': '(*, distance=None, speed=None, turns=None, standstill=None, acceleration=None, '
            'scenario=None, duration=None, gpx=None, bag=None, topics=None, config=None, '
            '**errors)',
    'compare': '(*calibrations)'}
METHODS = {
    'to_dict': '(self)', 'to_frame': '(self)', 'residuals': '(self)', 'trajectory': '(self)',
    'states': '(self)', 'plot_track': '(self, ax, leg=1)',
    'plot_residuals': '(self, ax, leg=1)', 'export': '(self, *files)'}
DATA = {'result', 'config', 'inputs', 'notes', 'created', 'verdict', 'reasons', 'values', 'sigmas'}


def untyped(function) -> str:
    """Return a signature without its annotations, which may change."""
    found = inspect.signature(function)
    bare = [p.replace(annotation=p.empty) for p in found.parameters.values()]
    return str(found.replace(parameters=bare, return_annotation=found.empty))


def test_public_names_and_arguments_are_unchanged():
    assert set(odocal_ros.__all__) == {*SIGNATURES, 'Calibration', 'Comparison', 'Config',
                                       'OdocalError', 'Planned', 'Recording'}
    assert {name: untyped(getattr(odocal_ros, name)) for name in SIGNATURES} == SIGNATURES
    assert {name: untyped(getattr(Calibration, name)) for name in METHODS} == METHODS
    assert untyped(Calibration.save).startswith('(self, folder, force=False')
    assert {*dir(Calibration), *Calibration.__dataclass_fields__} >= DATA
    assert set(dir(odocal_ros)) >= set(odocal_ros.__all__)


def test_public_names_are_documented_and_differ_from_modules():
    for name in SIGNATURES:
        assert 'Raises' in getattr(odocal_ros, name).__doc__, name
    from test_border import PACKAGE
    packages = {p.name for p in PACKAGE.iterdir()} | {p.stem for p in PACKAGE.glob('*.py')}
    assert not packages & set(odocal_ros.__all__)
    with pytest.raises(AttributeError, match='calibrate_bags'):
        _ = odocal_ros.calibrate_bags


def test_importing_the_package_does_not_import_numpy():
    probe = 'import odocal_ros, sys; print("numpy" in sys.modules, odocal_ros.Config.__name__)'
    assert subprocess.check_output([sys.executable, '-c', probe],
                                   text=True).split() == ['False', 'Config']

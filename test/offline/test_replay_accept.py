# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal replay --accept, and calibrations compared with the truth: exit codes and texts."""

import json

from drives import drive
import pytest
import yaml

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.offline import against_truth
from odocal_ros.offline.against_truth import rows
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.core
DEG = 0.017453292519943295


def calibration(scale=0.0213, ratio=1.065, yaw_deg=1.0, sigma=1e-4):
    """Return the part of calibration.json that is compared."""
    def entry(value, unit):
        return {'value': value, 'sigma': None if value is None else sigma, 'unit': unit}
    return {'result': {'scale_factor': entry(scale, 'm/pulse'), 'scale_ratio': entry(ratio, '1'),
                       'yaw_mounting_angle': entry(yaw_deg and yaw_deg * DEG, 'rad'),
                       'pitch_mounting_angle': entry(None, 'rad')}}


SIMULATED = {'scale': {'value': 0.0213, 'ratio': 1.065}, 'yaw_mounting_deg': {'value': 1.0},
             'pitch_mounting_deg': {'value': 0.4}}
REAL = {'scale': {'value': 1.0084, 'sigma': 6e-4, 'accept': [1.006, 1.011]},
        'yaw_mounting_deg': {'value': 0.95, 'sigma': 0.2, 'accept': [0, 2]}}


@pytest.fixture
def run(tmp_path, capsys):
    """Return a function that writes both files, texts or content, and runs the command on them."""
    def command(*contents):
        paths = tmp_path / 'c.json', tmp_path / 't.yaml'
        for path, content, dump in zip(paths, contents, (json.dumps, yaml.safe_dump), strict=True):
            if content is not None:
                path.write_text(content if isinstance(content, str) else dump(content))
        return against_truth.main([*map(str, paths)]), *capsys.readouterr()
    return command


def test_a_real_drive_is_compared_by_the_scale_ratio_within_accept():
    scale, yaw = rows(calibration(ratio=1.0109, yaw_deg=1.9), REAL)
    assert scale.agrees       # 4.1 sigmas, but within the limits of the reference
    assert yaw.agrees
    assert not rows(calibration(ratio=1.0111), REAL)[0].agrees
    assert not rows(calibration(ratio=1.008, yaw_deg=2.1), REAL)[1].agrees


@pytest.mark.parametrize(('scale', 'code'), [(0.02169, 0), (0.02171, 1), (0.02089, 1)])
def test_four_sigmas_are_the_limit(run, scale, code):
    found, out, _ = run(calibration(scale=scale), SIMULATED)
    assert found == code
    assert ('DOES NOT AGREE' in out) == bool(code)


def test_the_table_shows_values_with_sigmas(run):
    code, out, err = run(calibration(), SIMULATED)
    assert (code, err) == (0, '')
    assert '0.02130 ± 0.00010' in out
    assert '1.0000 ± 0.0057' in out
    assert 'not determined' in out


@pytest.mark.parametrize(('content', 'truth', 'match'), [
    (calibration(scale=None), SIMULATED, 'no scale factor to compare'),
    (calibration(), {}, 'no scale factor to compare'),
    ([], SIMULATED, 'wrong file'),
    ({'config': {}}, SIMULATED, 'wrong file'),
    (calibration(), [1], 'wrong file'),
    ('{', SIMULATED, 'c.json: '),
    (calibration(), 'a: [', 't.yaml: '),
    (None, SIMULATED, 'cannot be read')])
def test_unusable_files_give_one_line_and_exit_code_2(run, content, truth, match):
    code, out, err = run(content, truth)
    assert (code, out) == (2, '')
    assert match in err
    assert err.count('\n') == 1


def test_two_files_are_required(capsys):
    assert against_truth.main([]) == 2
    assert 'required: two files' in capsys.readouterr().err


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    return write_bag(tmp_path_factory.mktemp('accept') / 'drive', drive_topics(made)), made


@pytest.mark.parametrize(('low', 'high', 'options', 'code', 'decision'), [
    (-1e-3, 1e-3, [], 0, 'PASS'),
    (1e-3, 3e-3, [], 1, 'FAIL'),
    (-1e-6, 1e-6, [], 1, 'UNDECIDED'),
    (-1e-3, 1e-3, ['--strict'], 1, 'UNDECIDED')])
def test_exit_code_and_a_json_line_give_the_decision(bag, low, high, options, code, decision,
                                                     tmp_path, capsys):
    path, made = bag
    true = made.truth.scale_ratio
    argv = ['replay', str(path), '--method', 'two_point', '--set', 'vehicle=bus 7', '--set',
            f'odometer.nominal_scale={made.options.nominal_scale!r}', '--set',
            'output.formats=[legs]', '--output', str(tmp_path / 'out'), '--accept',
            f'scale_ratio={true + low!r}:{true + high!r}', *options]
    assert main([*argv, '--quiet']) == code
    answer = json.loads(capsys.readouterr().out)       # this line alone
    assert (answer['vehicle'], answer['decision']) == ('bus 7', decision)
    held = answer['values']['scale_ratio']
    assert abs(held['value'] - true) < 4 * held['sigma']
    stored = json.loads((tmp_path / 'out' / 'calibration.json').read_text())
    assert stored['acceptance']['decision'] == decision
    if options:      # its heading is not known: a caution
        assert 'YAW_NOT_SEPARABLE' in answer['why']
        assert main([*argv, '--force']) == code
        lines = capsys.readouterr().out.splitlines()
        assert json.loads(lines[-1]) == answer
        assert decision in lines


def test_strict_without_accept_exits_with_1_for_a_caution(bag, tmp_path):
    argv = ['replay', str(bag[0]), '--method', 'two_point', '--quiet', '--output', str(tmp_path),
            '--set', 'output.formats=[legs]']
    assert main(argv) == 0
    assert main([*argv, '--force', '--strict']) == 1

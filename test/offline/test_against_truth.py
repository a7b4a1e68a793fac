# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A calibration beside its truth: who wins, and what is said."""

import json

import pytest
import yaml

from odocal_ros.offline.against_truth import main, rows

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
    """Return a function that writes both files and runs the command on them."""
    def command(content, truth):
        (tmp_path / 'c.json').write_text(json.dumps(content))
        (tmp_path / 't.yaml').write_text(yaml.safe_dump(truth))
        code = main([str(tmp_path / 'c.json'), str(tmp_path / 't.yaml')])
        return code, *capsys.readouterr()
    return command


def test_a_simulated_truth_is_compared_by_the_factor():
    scale, yaw, pitch = rows(calibration(scale=0.0214), SIMULATED)
    assert scale.sigmas_off == pytest.approx(1.0, rel=1e-9)
    assert yaw.sigmas_off == pytest.approx(0.0, abs=1e-9)
    assert pitch.value is None
    assert pitch.agrees


def test_a_real_truth_is_compared_by_the_ratio_inside_accept():
    scale, yaw = rows(calibration(ratio=1.0109, yaw_deg=1.9), REAL)
    assert scale.agrees       # 4.1 sigmas off, yet inside what the reference itself allows
    assert yaw.agrees
    assert not rows(calibration(ratio=1.0111), REAL)[0].agrees
    assert not rows(calibration(ratio=1.008, yaw_deg=2.1), REAL)[1].agrees


@pytest.mark.parametrize(('scale', 'code'), [(0.02169, 0), (0.02171, 1), (0.02089, 1)])
def test_four_sigmas_are_the_limit(run, scale, code):
    found, out, _ = run(calibration(scale=scale), SIMULATED)
    assert found == code
    assert ('DOES NOT AGREE' in out) == bool(code)


def test_the_table_reads_well(run):
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
    (calibration(), [1], 'wrong file')])
def test_what_cannot_be_compared_is_said(run, content, truth, match):
    code, out, err = run(content, truth)
    assert (code, out) == (2, '')
    assert match in err
    assert err.count('\n') == 1


def test_files_that_cannot_be_read(tmp_path, capsys):
    assert main([]) == 2
    assert 'required: two files' in capsys.readouterr().err
    assert main([str(tmp_path / 'no.json'), str(tmp_path / 'no.yaml')]) == 2
    assert 'cannot be read' in capsys.readouterr().err
    (tmp_path / 'a.json').write_text('{')
    assert main([str(tmp_path / 'a.json'), str(tmp_path / 'no.yaml')]) == 2
    (tmp_path / 'a.json').write_text(json.dumps(calibration()))
    (tmp_path / 'b.yaml').write_text('a: [')
    assert main([str(tmp_path / 'a.json'), str(tmp_path / 'b.yaml')]) == 2
    assert capsys.readouterr().err.count('\n') == 2

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal compare: changes relative to sigmas, and one line for an invalid calibration."""

import copy
import json
import math
from pathlib import Path

import pytest

from odocal_ros.library.compare import CAUSES
from odocal_ros.offline.cli import main
from odocal_ros.output.stored import read_stored
from odocal_ros.safe_io.limits import LimitReached

pytestmark = pytest.mark.core
ENTRY = {'value': 0.02, 'sigma': 3e-6, 'unit': 'm/pulse', 'method': 'two_point'}
YAW = {'value': 0.01, 'sigma': 0.004, 'unit': 'rad', 'method': 'two_point'}
START = 10**18


def content(scale=0.02, sigma=3e-6, yaw=0.01, verdict='accepted', start=START, **more):
    """Return the parts of calibration.json that are read."""
    result = {'scale_factor': ENTRY | {'value': scale, 'sigma': sigma},
              'scale_ratio': {'value': scale / 0.019, 'sigma': sigma / 0.019, 'unit': '1',
                              'method': 'two_point'},
              'yaw_mounting_angle': YAW | {'value': yaw},
              'pitch_mounting_angle': {'value': None, 'sigma': None, 'unit': 'rad',
                                       'method': None},
              'imu_rotation': {'quaternion_xyzw': None, 'rpy': None}}
    budget = {'fix_start': {'yaw_mounting_angle': 0.0024, 'scale_factor': 3e-6, 'shared': False},
              'initial_heading': {'yaw_mounting_angle': 0.0032, 'shared': True}}
    return {'schema': 1, 'created': '2026-01-02T03:04:05+00:00', 'verdict': verdict,
            'reasons': [{'code': 'GYRO_SIGN'}] if verdict == 'rejected' else [],
            'result': result, 'methods': {'two_point': {'budget': budget}},
            'legs': [{'start_ns': start, 'stop_ns': start + 10**11}], 'inputs': [],
            'config': {'imu.mounting_rpy': [0.0, 0.0, 0.0]}} | more


@pytest.fixture
def compare(tmp_path, capsys):
    """Return a function that writes contents and compares them: code, stdout, stderr."""
    def run(*contents, options=()):
        paths = []
        for i, one in enumerate(contents):
            path = tmp_path / f'{"abcdef"[i]}.json'
            path.write_text(one if isinstance(one, str) else json.dumps(one))
            paths.append(str(path))
        code = main(['compare', *paths, *options])
        out = capsys.readouterr()
        return code, out.out, out.err
    return run


def changes(compare, *contents):
    code, out, _ = compare(*contents, options=['--json'])
    whole = json.loads(out)
    return code, whole, {c['parameter']: c['values'] for c in whole['changes']}


def test_a_change_is_measured_in_sigmas_of_the_difference(compare):
    # 0.4 % of 0.02 is 80e-6; sigmas 3 and 4 make 5: 16 sigma
    code, whole, found = changes(compare, content(), content(0.02008, 4e-6, start=2 * START))
    assert code == 1
    assert whole['changed'] is True
    first, second = found['scale_factor']
    assert first['to_first'] is first['to_previous'] is None
    assert second['to_first'] == second['to_previous']
    assert second['to_first']['change'] == pytest.approx(80e-6)
    assert second['to_first']['sigma'] == pytest.approx(5e-6)
    assert second['to_first']['sigmas'] == pytest.approx(16.0)
    assert whole['sentence'].startswith('scale factor changed by +0.4 % (16.0 sigma) since ')
    assert whole['sentence'].endswith(CAUSES['scale'])


def test_a_yaw_change_across_180_deg_is_the_smaller_angle(compare):
    _, _, found = changes(compare, content(yaw=math.pi - 1e-4),
                          content(yaw=1e-4 - math.pi, start=2 * START))
    assert found['yaw_mounting_angle'][1]['to_first']['change'] == pytest.approx(2e-4)


@pytest.mark.parametrize(('scale', 'delay', 'words'), [
    (0.0202, 0.0, 'tyre pressure'), (0.03, 0.0, 'another vehicle'),
    (0.020002, 0.0, '+0.01 % (+0.5 sigma)'),        # 2e-6 of 0.02
    (0.02 - 2e-10, 0.0, '+0 % (+0.0 sigma)'),
    (0.02, 0.1, 'fix delay changed by +0.1 s'),
    (0.02, 0.1, 'a driver, bus or receiver has other settings')])
def test_a_change_is_reported_with_its_likely_cause(compare, scale, delay, words):
    def late(value, **more):
        one = content(**more)
        one['result']['gnss_delay'] = {'value': value, 'sigma': 1e-3, 'unit': 's',
                                       'method': 'smoother'}
        return one
    code, out, _ = compare(late(0.0), late(delay, scale=scale, start=2 * START))
    assert code == (scale > 0.0201 or delay > 0.0)
    assert words in out
    assert ('tyre pressure' in out) == (scale == 0.0202)


@pytest.mark.parametrize(('sigmas', 'code'), [(2.9, 0), (3.1, 1), (-2.9, 0), (-3.1, 1)])
def test_three_sigma_is_the_limit(compare, sigmas, code):
    other = content(0.02 + sigmas * 5e-6, 4e-6, start=2 * START)
    found = compare(content(), other)
    assert found[0] == code
    assert ('no change beyond 3 sigma' in found[1]) == (code == 0)


def test_changes_since_the_first_and_since_the_previous_are_separate(compare):
    # a slow drift: each step 2.4 sigma, both together 4.7
    steps = [content(0.02 + i * 10e-6, start=(i + 1) * START) for i in range(3)]
    code, _, found = changes(compare, *steps)
    third = found['scale_factor'][2]
    assert third['to_first']['change'] == pytest.approx(20e-6)
    assert third['to_previous']['change'] == pytest.approx(10e-6)
    assert third['to_first']['since'].endswith('a.json')
    assert third['to_previous']['since'].endswith('b.json')
    assert code == 1
    assert compare(*steps[:2])[0] == 0


def test_sigmas_without_shared_errors_are_reported_but_not_used(compare):
    # sigma 0.004 each, 0.0032 of it due to the heading: own 0.0024, difference 0.0034
    code, whole, found = changes(compare, content(), content(yaw=0.022, start=2 * START))
    change = found['yaw_mounting_angle'][1]['to_first']
    assert change['sigmas'] == pytest.approx(0.012 / (0.004 * 2**0.5))
    assert change['sigmas_if_shared_cancels'] == pytest.approx(0.012 / (0.0024 * 2**0.5))
    assert code == 0
    assert found['scale_factor'][1]['to_first']['sigmas_if_shared_cancels'] is None
    old = content()
    old['methods']['two_point']['budget']['initial_heading']['shared'] = False
    change = changes(compare, old, content(yaw=0.022, start=2 * START))[2]['yaw_mounting_angle']
    assert change[1]['to_first']['sigmas_if_shared_cancels'] is None
    text = compare(content(), content(yaw=0.022, start=2 * START))[1]
    assert 'yaw mounting is 3.5 sigma if' in text


def test_a_rejected_calibration_is_shown_but_not_compared(compare):
    bad = content(0.03, verdict='rejected', start=2 * START)
    code, whole, found = changes(compare, content(), bad, content(start=3 * START))
    assert code == 0
    assert found['scale_factor'][1]['to_first']['sigmas'] > 1000
    assert found['scale_factor'][2]['to_previous']['since'].endswith('a.json')
    assert 'rejected (GYRO_SIGN)' in whole['notes'][0]
    code, out, _ = compare(content(), bad)
    assert code == 1
    assert 'nothing to compare' in out


def test_gyro_biases_and_yaws_of_other_nominal_mountings_are_not_compared(compare):
    first = content()
    turned = content(yaw=0.5, start=2 * START, config={'imu.mounting_rpy': [0.0, 0.0, 1.0]})
    for bias, one in ((1e-3, first), (2e-3, turned)):
        one['result']['gyro_bias_z'] = {'value': bias, 'sigma': 1e-6, 'unit': 'rad/s',
                                        'method': 'two_point'}
    code, whole, found = changes(compare, first, turned)
    assert code == 0
    assert set(found) == {'scale_factor'}
    assert 'imu.mounting_rpy differs' in whole['notes'][0]


def test_two_calibrations_of_the_same_drive_are_reported(compare):
    assert 'the same drive' in compare(content(), content())[1]
    assert 'the same drive' not in compare(content(), content(start=2 * START))[1]


def test_a_zero_or_unknown_sigma_gives_no_number_of_sigmas(compare):
    for sigma in (0.0, None):
        pair = [content(start=START), content(0.021, start=2 * START)]
        for one in pair:
            one['result'].pop('yaw_mounting_angle')
            one['result']['scale_factor']['sigma'] = sigma
        code, whole, found = changes(compare, *pair)
        assert found['scale_factor'][1]['to_first']['sigmas'] is None
        assert code == 1
        assert 'no sigma is known' in whole['sentence']


def test_every_compared_name_has_a_cause():
    from odocal_ros.library.compare import NOT_COMPARED
    names = ['scale_factor', 'scale_factor_left', 'scale_factor_right', 'track_width',
             'yaw_mounting_angle', 'pitch_mounting_angle', 'odometer_delay', 'gnss_delay',
             *(f'{what}_lever_arm_{a}' for what in ('odometer', 'antenna') for a in 'xyz')]
    for name in names:        # all estimates but those that are not compared
        assert name not in NOT_COMPARED
        assert [key for key in CAUSES if key in name.split('_')], name


def broken(path, value):
    """Return a content with one entry changed, or removed if value is ``...``."""
    one = copy.deepcopy(content())
    *keys, last = path
    place = one
    for key in keys:
        place = place[key]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return one


@pytest.mark.parametrize(('bad', 'word'), [
    ('', 'not a calibration.json'), ('{', 'not a calibration.json'), ('[]', 'not an object'),
    ('[' * 100_000, 'not a calibration.json'), ('{"schema": NaN}', 'NaN is not a number'),
    (broken(['schema'], 2), 'schema is 2'), (broken(['schema'], True), 'schema is True'),
    (broken(['schema'], ...), 'schema is None'), (broken(['verdict'], 'fine'), 'verdict'),
    (broken(['result'], ...), 'result'), (broken(['legs'], {}), 'legs'),
    (broken(['result', 'scale_factor'], 0.02), 'scale_factor lacks'),
    (broken(['result', 'scale_factor', 'sigma'], ...), 'scale_factor lacks'),
    (broken(['result', 'scale_factor', 'value'], '0.02'), 'value is not a finite number'),
    (broken(['result', 'scale_factor', 'value'], True), 'value is not a finite number'),
    (broken(['result', 'scale_factor', 'value'], 10**400), 'value is not a finite number'),
    (broken(['result', 'scale_factor', 'value'], -0.02), 'not positive'),
    (broken(['result', 'scale_factor', 'sigma'], -1.0), 'negative'),
    (json.dumps(content()).replace('3e-06', '1e999'), 'sigma is not a finite number'),
    (broken(['result', 'scale_factor', 'unit'], 3), 'unit'),
    (broken(['result', 'scale_factor', 'unit'], 'm/rad'), 'is in m/rad, in ')])
def test_an_invalid_calibration_gives_one_line_and_exit_code_2(compare, bad, word):
    code, out, err = compare(content(), bad)
    assert code == 2
    assert out == ''
    assert err.count('\n') == 1
    assert word in err
    assert 'b.json' in err


def test_a_device_is_read_only_up_to_the_limit():
    with pytest.raises(LimitReached, match='/dev/zero: the text exceeds the limit'):
        read_stored(Path('/dev/zero'))


@pytest.mark.parametrize(('path', 'value'), [
    (['methods', 'two_point', 'budget'], 5), (['methods'], {}),
    (['methods', 'two_point', 'budget', 'initial_heading'], []),
    (['methods', 'two_point', 'budget', 'initial_heading', 'yaw_mounting_angle'], None),
    (['legs'], [3]), (['inputs'], [None]), (['result', 'scale_factor', 'method'], ['x'])])
def test_optional_entries_may_be_missing(compare, path, value):
    assert compare(content(), broken(path, value))[0] == 0


def test_missing_files_and_a_single_file_are_refused(tmp_path, capsys):
    assert main(['compare', str(tmp_path / 'a'), str(tmp_path / 'b')]) == 2
    assert 'No such file' in capsys.readouterr().err
    assert main(['compare', str(tmp_path), str(tmp_path)]) == 2
    assert f'{tmp_path}: there is no calibration.json in it' in capsys.readouterr().err
    (tmp_path / 'calibration.json').write_text(json.dumps(content()))
    assert main(['compare', str(tmp_path)]) == 2
    assert 'two or more' in capsys.readouterr().err
    assert main(['compare', str(tmp_path), str(tmp_path)]) == 0      # a folder
    (tmp_path / 'raw').write_bytes(b'\xff\xfe')
    assert main(['compare', str(tmp_path), str(tmp_path / 'raw')]) == 2
    assert capsys.readouterr().err.count('\n') == 1

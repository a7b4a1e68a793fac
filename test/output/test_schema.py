# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""calibration.json: its schema, its content, the written files, and the verdicts of methods."""

from dataclasses import replace
import json
from pathlib import Path
import re

from calibration_parts import CREATED
from drives import drive, settings
import numpy as np
import pytest

from odocal_ros import __version__
from odocal_ros.errors import BadUsage
from odocal_ros.offline.cli import main
from odocal_ros.output import files, report_tables
from odocal_ros.output.files import as_json, write_results
from odocal_ros.output.report import report_html
from odocal_ros.output.stored import read_stored
from odocal_ros.output.summary import screen
from odocal_ros.output.tables import leg_verdicts, shown_verdict
from odocal_ros.output.value_text import accept_line, join_same_reasons
from odocal_ros.pipeline.acceptance import accept
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, SETTINGS, with_settings

pytestmark = pytest.mark.core
ROOT = Path(__file__).resolve().parents[2]
SCHEMA = json.loads((ROOT / 'config' / 'calibration-1.schema.json').read_text())
EARLIER = sorted(Path(__file__).parent.glob('calibration_*.json'))
INPUTS = [{'bag': 'drive', 'sha256': 'ab' * 32, 'topics': {'imu': '/imu/data'}}]


@pytest.fixture
def validator():
    jsonschema = pytest.importorskip('jsonschema', reason='no jsonschema here')
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    return jsonschema.Draft202012Validator(SCHEMA)


def content(legs, config):
    return json.loads(json.dumps(as_json(combine(legs, config), config, [], 'now')))


def test_written_results_conform_to_the_schema(validator):
    made = drive(scenario='straight', duration=200.0)
    config = settings(made)
    good = calibrate(made.leg(), config)
    validator.validate(content([good], config))
    failed = drive(scenario='straight', duration=200.0, fix_rate=0.01)
    validator.validate(content([calibrate(failed.leg(), Config())], Config()))


@pytest.mark.parametrize('path', EARLIER, ids=lambda path: path.stem)
def test_results_of_earlier_releases_are_read(path, validator, capsys):
    stored = json.loads(path.read_text())
    version = '.'.join(re.findall(r'\d+', path.stem))
    assert stored['software'] == f'odocal_ros {version}'
    validator.validate(stored)
    found = read_stored(path)
    assert found.value('scale_factor') == stored['result']['scale_factor']['value']
    assert main(['compare', str(path), str(path)]) == 0
    assert 'scale factor' in capsys.readouterr().out


@pytest.mark.parametrize('spoil', [
    lambda c: c.update(schema=2), lambda c: c.update(verdict='good'),
    lambda c: c['result'].pop('scale_factor'),
    lambda c: c['result']['yaw_mounting_angle'].update(unit='deg'),
    lambda c: c['legs'][0].pop('start_ns'), lambda c: c['reasons'][0].update(code='odd one')])
def test_the_schema_rejects_invalid_content(spoil, validator):
    stored = json.loads(EARLIER[0].read_text())
    spoil(stored)
    assert not validator.is_valid(stored)


def test_json_has_the_fixed_shape(good):
    content = as_json(good, Config(), INPUTS, CREATED)
    assert list(content) == ['schema', 'software', 'created', 'vehicle', 'verdict', 'reasons',
                             'result', 'methods', 'legs', 'check', 'inputs', 'config']
    assert content['schema'] == 1
    assert content['software'] == f'odocal_ros {__version__}'
    assert content['verdict'] == 'accepted'
    assert content['reasons'][1] == {
        'code': 'PITCH_NOT_DETERMINED', 'text': 'the heights of the fixes are too inaccurate',
        'remedy': 'Use positions with height: ellipsoidal height of a receiver, or z.'}
    assert content['result']['scale_factor'] == {
        'value': 0.05, 'sigma': 1.2e-6, 'unit': 'm/pulse', 'method': 'two_point'}
    assert content['result']['imu_rotation'] == {
        'quaternion_xyzw': [0.0, 0.0, -0.0087, 0.99996], 'rpy': [0.0, 0.0, -0.0174533]}
    assert content['inputs'] == INPUTS
    assert list(content['config']) == list(SETTINGS)


def test_json_of_a_method_and_a_leg(good):
    content = as_json(good, Config(), INPUTS, CREATED)
    method = content['methods']['two_point']
    assert method['verdict'] == 'accepted'
    assert method['correlation'] == {'scale_factor,yaw_mounting_angle': 0.25}
    assert method['budget']['fixes']['scale_factor'] == 1e-6
    assert method['estimates']['yaw_mounting_angle'] == {
        'value': -0.0174533, 'sigma': 5e-5, 'unit': 'rad'}
    assert 'f' not in method
    leg, = content['legs']
    assert leg['methods'] == content['methods']
    assert {k: leg[k] for k in ('bag', 'start', 'stop', 'distance', 'duration', 'imu_samples',
                                'pulses', 'fixes', 'rejected_fixes', 'verdict')} == {
        'bag': 'drive', 'start': 1_533_200_000.5, 'stop': 1_533_200_600.5, 'distance': 11200.3,
        'duration': 600.0, 'imu_samples': 120_000, 'pulses': 30_000, 'fixes': 3000,
        'rejected_fixes': 4, 'verdict': 'accepted'}
    assert leg['reasons'][0]['code'] == 'TOPIC_GAP'
    assert content['check']['after'] == {'rms': 0.1, 'max': 0.3, 'mean': 0.09, 'end': 0.02,
                                         'percent_of_distance': 1.8e-4}


def test_json_has_null_instead_of_nan_for_unknown_values(good, nothing, rejected):
    content = as_json(good, Config(), [], CREATED)
    assert content['result']['pitch_mounting_angle']['value'] is None
    assert content['methods']['two_point']['odd'] is None
    assert content['config']['imu.nominal_yaw'] is None
    json.dumps(content, allow_nan=False)
    empty = as_json(nothing, Config(), [], CREATED)
    assert empty['verdict'] == 'rejected'
    assert empty['result']['scale_factor'] == {'value': None, 'sigma': None, 'unit': None,
                                               'method': None}
    assert empty['check'] == {'before': None, 'after': None, 'per_distance': []}
    json.dumps(empty, allow_nan=False)
    assert files.plain({'a': np.arange(2), 'b': (np.float64(1.5), np.int64(2), np.inf)}) == {
        'a': [0, 1], 'b': [1.5, 2, None]}
    kept = as_json(rejected, Config(), [], CREATED)         # a rejected result has its values
    assert kept['verdict'] == 'rejected'
    assert kept['result']['scale_factor']['value'] == 0.05


def test_write_returns_the_written_files(good, tmp_path):
    written = write_results(good, Config(), tmp_path / 'deep' / 'out', INPUTS, CREATED)
    assert written[0].name == 'calibration.json'
    assert sorted(written) == sorted((tmp_path / 'deep' / 'out').iterdir())
    assert json.loads(written[0].read_text()) == as_json(good, Config(), INPUTS, CREATED)


def test_a_folder_never_has_files_of_two_calibrations(good, nothing, tmp_path):
    (tmp_path / 'mine.txt').write_text('keep')
    write_results(good, Config(), tmp_path, INPUTS, CREATED)
    assert (tmp_path / 'imu_transform.urdf').exists()
    write_results(nothing, Config(), tmp_path, INPUTS, CREATED, force=True)
    assert {p.name for p in tmp_path.iterdir()} == {
        'calibration.json', 'calibration.yaml', 'report.html', 'mine.txt'}


def test_only_configured_formats_are_written_and_a_bad_folder_is_refused(good, tmp_path):
    config = with_settings(Config(), {'output.formats': ()})
    written = write_results(good, config, tmp_path, INPUTS, CREATED)
    assert [p.name for p in written] == ['calibration.json']
    (tmp_path / 'file').write_text('')
    with pytest.raises(BadUsage, match='results cannot be written'):
        write_results(good, Config(), tmp_path / 'file' / 'out', INPUTS, CREATED)


DEAD = Reason(Code.WHEEL_DEAD, 'the left wheel does not count')
SLIP = Reason(Code.WHEEL_SLIP, 'a wheel spun')
FAR = Reason(Code.SCALE_FAR_FROM_NOMINAL, 'far off')


def later(leg, hours, **changes):
    shift = hours * 3600 * 10**9
    return replace(leg, start_ns=leg.start_ns + shift, stop_ns=leg.stop_ns + shift, **changes)


@pytest.mark.parametrize(('of_method', 'of_legs', 'shown'), [
    ((), [()], 'accepted'),
    ((), [(DEAD,)], 'rejected (leg)'),
    ((FAR,), [(DEAD,)], 'rejected (leg)'),
    ((DEAD,), [(DEAD,)], 'rejected'),
    ((), [(SLIP,)], 'caution (leg)'),
    ((FAR,), [(SLIP,)], 'caution'),
    ((), [(DEAD,), ()], 'accepted'),            # only the good leg is used
    ((), [(DEAD,), (SLIP,)], 'caution (legs)'),
    ((), [(DEAD,), (DEAD,)], 'rejected (legs)')])
def test_the_verdict_of_a_method_is_not_better_than_its_legs(good, of_method, of_legs, shown):
    method = replace(good.methods['two_point'], reasons=of_method)
    legs = tuple(later(good.legs[0], k, reasons=reasons) for k, reasons in enumerate(of_legs))
    assert shown_verdict(method, legs) == shown


def test_screen_and_report_show_the_verdict_of_the_legs(good):
    method = good.methods['two_point']
    methods = {'two_point': method, 'smoother': replace(method, name='smoother')}
    leg = replace(good.legs[0], reasons=(DEAD,), methods=methods)
    calibration = replace(good, reasons=(DEAD,), methods=methods, legs=(leg,))
    text = screen(calibration)
    rows = [line for line in text.splitlines() if line.startswith(('  two_point', '  smoother'))]
    assert [row.endswith('rejected (leg)') for row in rows] == [True, True]
    assert '0.0500000 ± 0.0000012' in rows[0]
    assert report_tables.method_table(methods, (leg,))['verdicts'] == ['rejected (leg)'] * 2
    both = replace(calibration, legs=(leg, later(leg, 1, reasons=())))
    page = report_html(both, Config(), as_json(both, Config(), [], CREATED))
    assert page.count('<td>rejected (leg)</td>') == 2      # in the table of the first leg


def test_a_drive_given_twice_is_not_used_and_its_data_do_not_count(good):
    leg = good.legs[0]
    legs = (leg, replace(leg, reasons=(SLIP,), bag='copy'))
    assert shown_verdict(good.methods['two_point'], legs) == 'accepted'
    assert leg_verdicts(legs) == ['accepted', 'not used']
    text = screen(replace(good, legs=legs))
    first, second = (line for line in text.splitlines() if '08-02 08:53:20' in line)
    assert first.endswith('accepted')
    assert second.endswith('not used')
    assert '\n  leg 1: drive; leg 2: copy\n' in text


def test_one_bag_is_not_named_and_long_names_keep_the_width(good):
    assert 'drive' not in screen(good)
    names = ['rosbag2_of_a_very_long_drive_2026_11_22-02_11', 'rosbag2_of_a_long_drive_2026_11_23']
    text = screen(replace(good, legs=tuple(later(good.legs[0], k, bag=names[k % 2])
                                           for k in range(3))))
    assert max(map(len, text.splitlines())) <= 98
    assert f'legs 1 and 3: {names[0]}; leg 2:' in text


def test_the_same_reason_of_several_legs_is_shown_once():
    slip, dead = Code.WHEEL_SLIP, Code.WHEEL_DEAD
    reasons = (Reason(slip, 'leg 1: it spun'), Reason(slip, 'leg 3: it spun'),
               Reason(slip, 'leg 2: it slid'), Reason(slip, 'it spun'),
               Reason(dead, 'leg 2: it spun'), Reason(slip, 'leg 4: it spun'))
    assert [(r.code, r.text) for r in join_same_reasons(reasons)] == [
        (slip, 'legs 1, 3 and 4: it spun'), (slip, 'leg 2: it slid'), (slip, 'it spun'),
        (dead, 'leg 2: it spun')]


def test_the_line_of_a_decision_names_each_reason_once(good):
    reasons = [Reason(Code.ODOMETER_STILL, 'one'), Reason(Code.NO_FIX, 'two'),
               Reason(Code.ODOMETER_STILL, 'three')]
    config = with_settings(Config(), {'accept.scale_ratio_min': 0.9})
    result = replace(good, reasons=tuple(reasons))
    line = json.loads(accept_line(result, accept(result, config), config))
    assert line['reasons'] == ['ODOMETER_STILL', 'NO_FIX']

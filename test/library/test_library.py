# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The library on a simulated drive: against its truth and the output of the commands."""

import json
import sys

import numpy as np
import pytest

from odocal_ros import (
    calibrate_bag,
    Calibration,
    compare,
    Config,
    OdocalError,
    plan,
    read_bag,
    simulate,
)
from odocal_ros.library.arguments import config_of
from odocal_ros.nav.rotations import matrix_from_quat, rpy_from_matrix
from odocal_ros.offline.cli import main
from odocal_ros.settings.config import with_settings
from odocal_ros.sim.motion import attitude

pytestmark = [pytest.mark.core, pytest.mark.slow]


def without_time(content):
    return {key: value for key, value in content.items() if key != 'created'}


def printed(capsys, *argv):
    assert main([*map(str, argv), '--json']) in (0, 1)
    return json.loads(capsys.readouterr().out)


def test_command_and_function_give_the_same_result(town, calibration, tmp_path, capsys):
    bag = town[1]
    reported = printed(
        capsys, 'replay', bag, '--config', bag.parent / 'calibrator.yaml', '--output',
        tmp_path / 'out')
    assert without_time(reported) == json.loads(json.dumps(without_time(calibration.to_dict())))
    calibration.save(tmp_path / 'saved')
    saved, out = ({p.name for p in (tmp_path / name).iterdir()} for name in ('saved', 'out'))
    assert saved == out


def test_values_agree_with_the_true_ones(town, calibration):
    truth = town[0].truth
    for name, true in (('scale_factor', truth.scale), ('yaw_mounting_angle', truth.yaw),
                       ('pitch_mounting_angle', truth.pitch)):
        assert abs(calibration.values[name] - true) < 4 * calibration.sigmas[name], name
    assert calibration.verdict.value == 'accepted'
    assert 'PARAMETER_NOT_DETERMINED' in {reason.code.name for reason in calibration.reasons}
    assert str(calibration).startswith('ACCEPTED')


def test_trajectory_agrees_with_the_true_motion(town, calibration):
    """Errors of a smoothed track are smaller than those of its fixes of 1.5 m."""
    drive, found = town[0], calibration.trajectory()
    state = drive.motion.at((found['stamp_ns'] - drive.options.start_ns) * 1e-9)
    metres = 6.37e6 * np.hypot(np.deg2rad(found['latitude_deg']) - state.latitude, np.cos(
        state.latitude) * (np.deg2rad(found['longitude_deg']) - state.longitude))
    assert metres.max() < 1.5
    C_nv = matrix_from_quat(np.stack([found[q] for q in ('qx', 'qy', 'qz', 'qw')], -1))
    off = rpy_from_matrix(np.swapaxes(attitude(state), 1, 2) @ C_nv)
    assert np.rad2deg(np.abs(off)).max() < 0.5
    whole = (drive.truth.stop_ns - drive.truth.start_ns) * 1e-9
    assert len(found['t_s']) == pytest.approx(whole, rel=0.1)
    assert set(found['leg']) == {1}


def test_biases_agree_with_the_true_ones(town, calibration):
    found = calibration.states()
    for i, axis in enumerate('xyz'):
        sigma = calibration.sigmas[f'gyro_bias_{axis}']
        first = found[f'gyro_bias_{axis}'][0]
        assert abs(first - town[0].truth.gyro_bias[i]) < 5 * sigma, axis
        assert first == calibration.values[f'gyro_bias_{axis}']
        assert found[f'gyro_bias_{axis}_sigma'][0] == pytest.approx(sigma, rel=1e-12)
        force, sigma = (found[f'accelerometer_bias_{axis}{end}'][0] for end in ('', '_sigma'))
        assert abs(force - town[0].truth.accel_bias[i]) < 5 * sigma, axis
    assert np.abs(found['roll']).max() < np.deg2rad(1.0)      # the road is level


def test_values_of_a_rejected_drive_are_none(town, tmp_path):
    """With an IMU that is rotated by 90 deg no leg is computed, so no method gives a value."""
    turned = calibrate_bag(town[1], config={'imu.mounting_rpy': (0.0, 0.0, np.pi / 2)})
    assert turned.verdict.value == 'rejected'
    assert not turned.result.estimates
    for name in ('scale_factor', 'scale_ratio', 'yaw_mounting_angle', 'pitch_mounting_angle'):
        assert turned.values[name] is turned.sigmas[name] is None
    assert set(turned.values) <= set(turned.to_dict()['result'])


def of(found, sensor, component):
    """Return the rows of one component of a sensor."""
    rows = (found['sensor'] == sensor) & (found['component'] == component)
    return {name: column[rows] for name, column in found.items()}


def test_residuals_of_the_track_agree_with_the_result_also_without_a_fit(calibration, town):
    found, check = calibration.residuals(), calibration.to_dict()['check']
    for name, sensor in (('after', 'track'), ('before', 'track_before')):
        along, left = (of(found, sensor, component) for component in ('along', 'left'))
        off = np.hypot(along['value'], left['value'])
        assert np.sqrt((off**2).mean()) == pytest.approx(check[name]['rms'], rel=0.02)
        assert len(off) == calibration.result.legs[0].evidence.fixes
        assert np.all(np.diff(along['distance_m']) >= 0)
    found = calibrate_bag(town[1], config={'method': 'two_point'}, legs='0:').residuals()
    assert set(found['sensor']) == {'track', 'track_before'}


def test_residuals_of_each_sensor_have_stamp_sigma_and_unit(calibration):
    """The same number per second; residuals are noise, of which the fit removes a part."""
    found, seconds = calibration.residuals(), len(calibration.states()['t_s']) - 1
    residuals = calibration.result.legs[0].methods['smoother'].details['residuals']
    for sensor, unit, rows in (('fix', 'm', residuals['fixes']), ('odometer', 'm', seconds),
                               ('gyro', 'rad/s', seconds), ('accelerometer', 'm/s^2', seconds)):
        components = sorted(set(found['component'][found['sensor'] == sensor]))
        assert len(components) == 3, sensor
        for component in components:
            one = of(found, sensor, component)
            assert set(one['unit']) == {unit}
            assert len(one['stamp_ns']) == rows
            assert np.all(np.diff(one['stamp_ns']) > 0)
            # the sigma of counts is that of a single rounded one; they are averaged
            least = 0.01 if sensor == 'odometer' else 0.05
            assert least < np.sqrt(((one['value'] / one['sigma'])**2).mean()) < 1.1
    one = of(found, 'gyro', 'z')
    np.testing.assert_array_equal(one['stamp_ns'], calibration.states()['stamp_ns'][1:])


def test_fixes_that_end_in_the_middle_of_a_bag_are_stated(tmp_path):
    simulate('town', tmp_path / 'half', duration=200.0, imu_rate=50.0, odometer_rate=20.0,
             outages=((100.0, 300.0),))
    half = {'path': tmp_path / 'half', 'config': {'method': 'two_point'}}
    texts = [reason.text for reason in calibrate_bag(**half).reasons]
    (text,) = (text for text in texts if 'before the last topic' in text)
    assert text.startswith('fix ends')
    # a leg given by the user is used as given
    assert not [r for r in calibrate_bag(**half, legs='0:90').reasons
                if 'before the last topic' in r.text]


def test_a_table_has_a_row_for_each_value_and_an_error_without_pandas(calibration, monkeypatch):
    pytest.importorskip('pandas', reason='no pandas here: pip install pandas pyarrow')
    table = calibration.to_frame()
    assert table['value'].dropna().to_dict() == {
        name: value for name, value in calibration.values.items() if value is not None}
    assert table.loc['scale_factor', 'unit'] == 'm/pulse'
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(OdocalError, match=r'pip install pandas pyarrow'):
        calibration.to_frame()


def test_figures_show_the_leg(calibration):
    from matplotlib.figure import Figure
    ax, lower = Figure().subplots(2)
    assert calibration.plot_track(ax) is ax
    lines = {line.get_label(): line.get_xydata() for line in ax.get_lines()}
    track = calibration.result.legs[0].evidence.track_n
    for end in (0, -1):      # in metres from the start
        np.testing.assert_allclose(lines['as calibrated'][end], (track[end] - track[0])[:2])
    calibration.plot_residuals(lower)
    drawn = next(line for line in lower.get_lines() if line.get_label() == 'across')
    left = of(calibration.residuals(), 'track', 'left')['value']
    assert np.abs(drawn.get_ydata()).max() == np.abs(left).max()
    with pytest.raises(OdocalError, match='legs 1 to 1'):
        calibration.plot_track(ax, leg=2)


def test_a_result_without_a_track_is_reported(calibration):
    from dataclasses import replace
    empty = Calibration(replace(calibration.result, legs=()))
    for series in (empty.trajectory, empty.states, empty.residuals):
        with pytest.raises(OdocalError, match='no leg has'):
            series()


def test_samples_of_a_bag_equal_the_messages(town):
    drive, bag = town
    found = read_bag(bag)
    np.testing.assert_array_equal(found.samples('imu').w_i, drive.imu.w_i)
    np.testing.assert_array_equal(found.samples('odometer').value, drive.odometer.value)
    assert found.topics == {'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/fix'}
    leg, = found.legs((100.0, 160.0))
    assert leg.stop_ns - leg.start_ns == 60 * 10**9
    assert found.spans([]) == [(found.legs()[0].start_ns, found.legs()[0].stop_ns)]


def test_settings_are_accepted_in_each_form(town):
    path = town[1].parent / 'calibrator.yaml'
    names = {'imu.grade': 'tactical', 'leg.standstill': 3.0}
    # as text: since Python 3.13 dataclasses with a NaN are unequal
    assert repr(config_of(names)) == repr(with_settings(Config(), names)) == repr(
        config_of(config_of(names)))
    assert config_of(path).odometer.nominal_scale == town[0].options.nominal_scale
    assert config_of(names, {'leg.standstill': 5.0, 'leg.preroll': 7.0}).leg.preroll == 7.0
    assert config_of(names, {'leg.standstill': 5.0}).leg.standstill == 3.0
    with pytest.raises(OdocalError, match='leg.standstill'):
        config_of({'leg.standstil': 3.0})


@pytest.mark.parametrize(('legs', 'seconds'), [
    ('10:70', [60]), (['10:70', '80:90'], [60, 10]), ((10, 70), [60]), ([(10, 70.5)], [60.5])])
def test_legs_are_accepted_in_each_form(town, legs, seconds):
    from odocal_ros.library.arguments import legs_of
    found = [(leg.stop_ns - leg.start_ns) * 1e-9 for leg in legs_of(legs)]
    assert found == pytest.approx(seconds)


@pytest.mark.parametrize('legs', [[5.0], [(1, 2, 3)], '70:10', ['a:b']])
def test_invalid_legs_are_refused(town, legs):
    with pytest.raises(OdocalError, match='leg'):
        calibrate_bag(town[1], legs=legs)


def test_notes_of_the_reader_are_in_the_result(town):
    bag = town[1]
    found = calibrate_bag([bag, bag], config={'method': 'two_point'}, legs='0:')
    assert found.notes == (f'{bag} is given twice; it is read once',)
    assert len(found.result.legs) == 1


def test_a_plan_equals_the_output_of_the_command(capsys):
    reported = printed(
        capsys, 'plan', '--distance', 500, '--speed', 10, '--turns', 2, '--imu-grade',
        'tactical', '--fix-sigma', 1, '--set', 'method=two_point')
    found = plan(distance=500, speed=10, turns=2, fix=1.0, config={
        'imu.grade': 'tactical', 'method': 'two_point'})
    assert reported == json.loads(json.dumps(found.to_dict()))
    assert found.sigma('scale_factor') == reported['estimates']['scale_factor']['sigma']
    with pytest.raises(OdocalError, match='one drive'):
        plan(speed=10)


def test_a_comparison_equals_the_output_of_the_command(calibration, tmp_path, capsys):
    calibration.save(tmp_path / 'a')
    calibration.save(tmp_path / 'b')
    reported = printed(capsys, 'compare', tmp_path / 'a', tmp_path / 'b')
    assert compare(tmp_path / 'a', tmp_path / 'b').to_dict() == reported
    same = compare(calibration, tmp_path / 'b')
    assert same.changed is False
    assert [change.parameter for change in same.changes][:1] == ['scale_factor']
    assert all(entry.to_first is None or entry.to_first.change == 0
               for change in same.changes for entry in change.entries)


def test_an_unknown_option_is_refused_by_name():
    with pytest.raises(OdocalError, match='durations'):
        simulate('town', durations=3.0)


@pytest.mark.parametrize('odd', [
    (b'\xff',), ('\0',), (3.5,), (None,), ([],), ('x' * 5000,), ('{bag}', 3), ('{bag}', None, 3),
    ('{bag}', None, '\0'), ('{bag}', None, None, 3), ('{bag}', {'imu_2': '/x'}),
    ('{bag}', {3: '/x'})])
def test_invalid_arguments_are_usage_errors(odd, tmp_path):
    from odocal_ros.errors import BadUsage
    from odocal_ros.library.calibrate_bag import calibrate_bag
    args = [str(tmp_path) if one == '{bag}' else one for one in odd]
    with pytest.raises(BadUsage):
        calibrate_bag(*args)

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal replay from a real bag to files, on simulated drives with known truth."""

from dataclasses import replace
import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
import yaml

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.calib.choice import leg_estimates
from odocal_ros.data.leg import LegRecorder
from odocal_ros.offline.cli import main
from odocal_ros.output import files
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.config_file import parse_set
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
LOW = {'imu_rate': 50.0, 'odometer_rate': 20.0}
QUICK = ('--method', 'two_point')      # for tests of the command, not of the result


@pytest.fixture(scope='module')
def drive():
    """Simulate a straight drive whose heading the operator knows to 0.05 deg."""
    return simulate(SimOptions(scenario='straight', duration=300.0, imu_grade='tactical', **LOW))


@pytest.fixture(scope='module')
def bag(drive, tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('replay') / 'drive', drive_topics(drive))


def known(drive):
    """Return the settings of an operator who knows grade and heading."""
    return ['--set', f'odometer.nominal_scale={drive.options.nominal_scale!r}',
            '--set', 'imu.grade=tactical',
            '--set', f'alignment.heading={drive.truth.heading!r}',
            '--set', 'alignment.heading_sigma=0.001']


def replay(*argv, files='params'):
    """Replay with few output files; the report takes half of the time of a replay."""
    return main(['replay', '--set', f'output.formats=[{files}]', *map(str, argv)])


def test_the_two_point_method_imports_no_unused_package(bag, tmp_path):
    """Neither scipy nor the message types of rosbags, which take longer than a short bag."""
    probe = ('import sys; from odocal_ros.offline.cli import main\n'
             f'main(["replay", {str(bag)!r}, "--method", "two_point", "--quiet", "--output", '
             f'{str(tmp_path / "out")!r}, "--set", "output.formats=[params, transform]"])\n'
             'print([m for m in ("scipy", "rosbags", "matplotlib", "tqdm") if m in sys.modules])')
    out = subprocess.check_output([sys.executable, '-c', probe], text=True)
    assert out.strip() == '[]'
    assert (tmp_path / 'out' / 'calibration.yaml').exists()


def test_the_verdict_is_printed_before_the_report(drive, bag, tmp_path, monkeypatch, capsys):
    warnings = []
    given = files.report_or_error_page
    monkeypatch.setattr(files, 'report_or_error_page',
                        lambda *args: warnings.append(capsys.readouterr().out) or given(*args))
    assert replay(bag, *known(drive), '--method', 'two_point', '--output', tmp_path / 'out',
                  '--set', 'output.formats=[params, report]') == 0
    assert 'scale factor' in warnings[0]
    assert 'written' not in warnings[0]
    assert 'written: ' in capsys.readouterr().out


def test_a_closed_output_pipe_does_not_prevent_the_files(drive, bag, tmp_path):
    command = [sys.executable, '-m', 'odocal_ros.offline.cli', 'replay', str(bag), '--method',
               'two_point', '--output', str(tmp_path / 'out'), *known(drive)]
    read_end, pipe = os.pipe()
    os.close(read_end)
    assert subprocess.run(command, stdout=pipe, check=False).returncode == 0
    os.close(pipe)
    assert (tmp_path / 'out' / 'report.html').exists()


def test_replay_of_a_bag_equals_the_pipeline_on_the_samples(drive, bag, tmp_path, capsys):
    """CDR and blocks of the bag change no bit, except for the degrees of a NavSatFix."""
    start, stop = drive.truth.start_ns, drive.truth.stop_ns

    def decimal(stamp):
        return f'{stamp // 10**9}.{stamp % 10**9:09d}'

    assert replay(bag, *known(drive), '--leg', f'{decimal(start)}:{decimal(stop)}', '--json',
                  '--output', tmp_path / 'out') == 0
    printed = json.loads(capsys.readouterr().out)
    recorder = LegRecorder()
    for slot in ('imu', 'odometer'):
        recorder.feed(slot, getattr(drive, slot))
    latitude, longitude = (np.rad2deg(x) * (math.pi / 180)
                           for x in (drive.fix.latitude, drive.fix.longitude))
    recorder.feed('fix', replace(drive.fix, latitude=latitude, longitude=longitude))
    recorder.form = drive.form
    config = with_settings(Config(), dict(parse_set(s) for s in known(drive)[1::2]))
    result = calibrate(recorder.close(start, stop, config.leg.preroll), config)
    for name, estimate in leg_estimates(result).items():
        assert printed['result'][name]['value'] == estimate.value
        assert printed['result'][name]['sigma'] == estimate.sigma


def test_holdout_checks_the_part_that_is_not_fitted(drive, bag, tmp_path, capsys):
    assert replay(bag, *known(drive), '--holdout', '--json', '--output', tmp_path / 'out') == 0
    printed = json.loads(capsys.readouterr().out)
    replay(bag, *known(drive), *QUICK, '--holdout', '--output', tmp_path / 'again')
    assert 'last fifth' in capsys.readouterr().out
    whole = drive.truth.distance
    assert printed['check']['after']['rms'] < printed['check']['before']['rms']
    # K0 is wrong by 6 %, the mounting by 1 deg: after a fifth of the path the error is 6 % of it
    off = abs(1 / drive.truth.scale_ratio - 1) + abs(drive.truth.yaw)
    assert printed['check']['before']['end'] < off * whole / 5 + 20


def test_an_existing_result_is_not_replaced_without_force(bag, tmp_path, capsys):
    assert replay(bag, *QUICK, '--output', tmp_path, '--quiet') == 0
    assert capsys.readouterr() == ('', '')
    before = (tmp_path / 'calibration.json').read_text()
    assert replay(bag, *QUICK, '--output', tmp_path, '--quiet') == 2
    assert '--force' in capsys.readouterr().err
    assert (tmp_path / 'calibration.json').read_text() == before
    assert replay(bag, *QUICK, '--output', tmp_path, '--quiet', '--force') == 0


def test_set_takes_precedence_over_the_config_file(bag, tmp_path, capsys):
    config = tmp_path / 'calibrator.yaml'
    config.write_text('/**/calibrator:\n  ros__parameters:\n    leg:\n      min_distance: 9000\n'
                      '    imu: {grade: tactical}\n')
    assert replay(bag, *QUICK, '--config', config, '--output', tmp_path / 'a', '--json') == 1
    printed = json.loads(capsys.readouterr().out)
    assert 'LEG_TOO_SHORT' in {r['code'] for r in printed['reasons']}
    assert printed['config']['leg.min_distance'] == 9000.0
    assert replay(bag, *QUICK, '--config', config, '--set', 'leg.min_distance=200', '--output',
                  tmp_path / 'b', '--quiet') == 0


# real drives ------------------------------------------------------------------------------------

def accept(data_dir, name):
    truth = yaml.safe_load((data_dir / name / 'truth.yaml').read_text())
    return *truth['scale']['accept'], truth['odometer']['k0_m_per_pulse'], truth['scale']


REAR = (1.0092 + 1.0096) / 2        # README of the drive: the rear wheels, used of the four


@pytest.mark.parametrize(('imu', 'odometer'), [
    ('/imu/data', '/odometer/pulses_derived'), ('/imu/data_flu', '/odometer/pulses_derived'),
    ('/imu/data_flu', '/vehicle/twist'), ('/imu/data_flu', '/wheel_states')])
def test_rav4_scale_is_within_accept_and_yaw_is_unknown(imu, odometer, data_dir, tmp_path, capsys):
    low, high, k0, truth = accept(data_dir, 'comma2k19_rav4')
    nominal = k0 if 'pulses' in odometer else 1.0
    assert replay(data_dir / 'comma2k19_rav4/bag', '--imu-topic', imu, '--odometer-topic',
                  odometer, '--fix-topic', '/fix', '--set', f'odometer.nominal_scale={nominal}',
                  '--json', '--output', tmp_path / 'out') == 0
    result = json.loads(capsys.readouterr().out)['result']
    ratio = result['scale_ratio']
    assert low <= ratio['value'] <= high
    true = REAR if odometer == '/wheel_states' else truth['value']
    assert abs(ratio['value'] - true) < 2 * math.hypot(ratio['sigma'], truth['sigma'])
    assert result['yaw_mounting_angle']['value'] is None


def test_two_point_rejects_the_husky_loop_and_its_straight_parts_meet_accept(
        data_dir, tmp_path, capsys):
    low, high, k0, _ = accept(data_dir, 'husky_parking_lot')
    common = [data_dir / 'husky_parking_lot/bag', '--imu-topic', '/imu/data_flu',
              '--odometer-topic', '/odometer/pulses_derived', '--set',
              f'odometer.nominal_scale={k0}', '--json']
    by_ends = [*common, '--method', 'two_point']
    assert replay(*by_ends, '--output', tmp_path / 'loop') == 1
    printed = json.loads(capsys.readouterr().out)
    reasons = {r['code']: r for r in printed['reasons']}
    assert 'straight' in reasons['CHORD_TOO_SHORT']['remedy']
    assert printed['result']['scale_factor']['value'] is None
    for leg in STRAIGHT:
        replay(*by_ends, '--leg', leg, '--set', 'leg.min_distance=30', '--output',
               tmp_path / leg.replace(':', '_'))
        scale = json.loads(capsys.readouterr().out)['result']['scale_ratio']
        edges = scale['value'] + np.array([-1.96, 1.96]) * scale['sigma']
        assert edges[0] <= high, leg
        assert edges[1] >= low, leg
    # all fixes of the loop determine the scale, not only its end points
    assert replay(*common, '--output', tmp_path / 'whole') == 0
    found = json.loads(capsys.readouterr().out)['result']
    assert low <= found['scale_ratio']['value'] <= high
    assert found['scale_ratio']['sigma'] < 0.02
    assert found['yaw_mounting_angle']['value'] is None


# by the gyro, heading stays within 10 deg there
STRAIGHT = ('12:138', '192:228', '262:304')

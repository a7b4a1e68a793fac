# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal simulate: a bag, its truth and its settings, or one error line."""

import math

import pytest
import yaml

from odocal_ros.offline import cli
from odocal_ros.sim.scenarios import SimOptions, simulate

SHORT = ['--scenario', 'town', '--duration', '140', '--imu-rate', '50']


def odocal(*arguments):
    return cli.main(['simulate', *map(str, arguments)])


def files(folder):
    return sorted(p.name for p in folder.iterdir())


def load(path):
    return yaml.safe_load(path.read_text())


def again(options):
    return simulate(SimOptions(**{k: tuple(v) if isinstance(v, list) else v
                                  for k, v in options.items()}))


def settings_of(folder):
    return load(folder / 'calibrator.yaml')['/**/calibrator']['ros__parameters']


def test_simulate_writes_a_bag_its_truth_and_its_settings(tmp_path, capsys):
    out = tmp_path / 'one' / 'drive'
    assert odocal(*SHORT, '--out', out, '--seed', 7) == 0
    assert files(out.parent) == ['calibrator.yaml', 'drive', 'truth.yaml']
    assert files(out) == ['drive.mcap', 'metadata.yaml']
    drive = simulate(SimOptions(scenario='town', duration=140.0, imu_rate=50.0, seed=7,
                                start_ns=SimOptions.start_ns + 6 * 86_400 * 10**9))   # day 7
    truth = load(out.parent / 'truth.yaml')
    assert truth['bag'] == 'drive'
    assert truth['scale'] == {'value': 0.0213, 'ratio': 0.0213 / 0.02, 'unit': 'm/pulse',
                              'nominal': 0.02, 'wheels': [0.0213]}
    assert truth['yaw_mounting_deg']['value'] == pytest.approx(1.0)
    assert truth['pitch_mounting_deg']['value'] == pytest.approx(0.4)
    assert truth['heading']['deg'] == pytest.approx(44.0, abs=1e-6)
    assert truth['distance']['value'] == drive.truth.distance
    assert truth['marks'] == {'start_ns': drive.truth.start_ns, 'stop_ns': drive.truth.stop_ns}
    assert truth['options']['seed'] == 7
    printed = capsys.readouterr()
    assert printed.err == ''                   # no terminal, no bar
    assert printed.out.count('\n') == 1
    n = len(drive.imu.stamp_ns) + len(drive.odometer.stamp_ns) + len(drive.fix.stamp_ns)
    assert f'{n} messages' in printed.out
    assert f'odocal replay {out} --config {out.parent / "calibrator.yaml"}' in printed.out


def test_the_settings_are_settings_of_the_node(tmp_path):
    """Each name and value passes the checks of the pipeline."""
    from odocal_ros.settings.config import Config, flat, SETTINGS, with_settings
    assert odocal(*SHORT, '--out', tmp_path / 'drive', '--two-wheels', '--imu-grade', 'tactical',
                  '--antenna-lever-arm', 1.2, 0, 1.5, '--known-heading-sigma-deg', 0.06,
                  '--mounting-rpy-deg', 180, 0, 0, '--quiet') == 0
    given = {f'{group}.{name}': value for group, values in settings_of(tmp_path).items()
             for name, value in values.items()}
    assert set(given) <= set(SETTINGS)
    config = flat(with_settings(Config(), given))
    assert config['odometer.nominal_scale'] == 0.02
    assert config['odometer.left'] == config['odometer.right'] == 'topic'
    assert config['imu.grade'] == 'tactical'
    assert config['gnss.lever_arm'] == (1.2, 0.0, 1.5)
    assert config['imu.mounting_rpy'] == pytest.approx((math.pi, 0, 0))
    assert config['alignment.heading_source'] == 'fixed'
    assert config['alignment.heading_sigma'] == pytest.approx(math.radians(0.06))
    truth = load(tmp_path / 'truth.yaml')['heading']['rad']
    error = config['alignment.heading'] - truth
    assert 0 < abs(error) < 5 * math.radians(0.06)     # 5 sigma


def test_perfect_sensors_have_the_best_grade(tmp_path):
    assert odocal(*SHORT, '--out', tmp_path / 'drive', '--imu-grade', 'perfect',
                  '--fix-sigma', 0, '--quiet') == 0
    groups = settings_of(tmp_path)
    assert groups['imu']['grade'] == 'navigation'
    assert 'alignment' not in groups


@pytest.mark.parametrize(('options', 'topics', 'command'), [
    ([], {'/imu/data', '/odometer', '/fix'}, ''),
    (['--odometer', 'speed'], {'/imu/data', '/odometer', '/fix'}, ''),
    (['--odometer', 'angle'], {'/imu/data', '/joint_states', '/fix'}, ''),
    (['--two-wheels'], {'/imu/data', '/odometer/left', '/odometer/right', '/fix'},
     '--odometer-topic /odometer/left --odometer-right-topic /odometer/right'),
    (['--heading-sigma-deg', '0.2'], {'/imu/data', '/odometer', '/fix', '/heading'},
     '--imu-topic /imu/data --heading-topic /heading')])
def test_the_replay_command_names_ambiguous_topics(tmp_path, capsys, options, topics, command):
    from rosbags.highlevel import AnyReader
    assert odocal(*SHORT, '--out', tmp_path / 'drive', *options) == 0
    assert command in capsys.readouterr().out
    with AnyReader([tmp_path / 'drive']) as reader:
        assert {c.topic for c in reader.connections} == topics


def test_existing_files_are_not_replaced_without_force(tmp_path, capsys):
    out = tmp_path / 'drive'
    assert odocal(*SHORT, '--out', out, '--quiet') == 0
    first = (tmp_path / 'truth.yaml').read_text()
    assert odocal(*SHORT, '--out', out, '--seed', 2) == 2
    assert 'truth.yaml already exists; give --force' in capsys.readouterr().err
    # another bag has its own truth file and does not change this one
    for _ in range(2):
        assert odocal(*SHORT, '--out', tmp_path / 'other', '--seed', 2, '--force') == 0
    assert 'truth in ' + str(tmp_path / 'other.truth.yaml') in capsys.readouterr().out
    assert load(tmp_path / 'other.truth.yaml')['bag'] == 'other'
    assert (tmp_path / 'truth.yaml').read_text() == first
    (tmp_path / 'truth.yaml').unlink()
    (tmp_path / 'calibrator.yaml').unlink()
    assert odocal(*SHORT, '--out', out, '--seed', 2) == 2
    assert 'drive already exists; give --force' in capsys.readouterr().err
    assert not (tmp_path / 'truth.yaml').exists()
    assert odocal(*SHORT, '--out', out, '--seed', 2, '--force', '--quiet') == 0
    assert (tmp_path / 'truth.yaml').read_text() != first
    assert load(tmp_path / 'truth.yaml')['seed'] == 2


def test_force_does_not_replace_settings_of_the_operator(tmp_path, capsys):
    (tmp_path / 'calibrator.yaml').write_text('mine: true\n')
    assert odocal(*SHORT, '--out', tmp_path / 'drive', '--force') == 2
    assert 'was not made by odocal simulate' in capsys.readouterr().err
    assert files(tmp_path) == ['calibrator.yaml']


@pytest.mark.parametrize(('wrong_options', 'printed'), [
    (['--scenario', 'moon'], '--scenario moon: required: one of paper'),
    (['--reference', 'sonar'], '--reference sonar: required: one of fix, pose'),
    (['--imu-rate', 'fast'], "invalid float value: 'fast'"),
    (['--outage', '5'], '5: required: A:B, two numbers of seconds'),
    (['--known-heading-sigma-deg', '-1'], '--known-heading-sigma-deg -1: required: 0 to 180'),
    (['--storage', 'tape'], '--storage tape: required: one of mcap'),
    (['--frobnicate'], 'unrecognized arguments: --frobnicate (see odocal simulate --help)'),
    (['--fix-nois', 'rtk', '--sede', '2'], 'unrecognized arguments: --sede; did you mean --seed?'),
    (['--real', 'squad=1'], 'no such parameter; similar: squat'),
    (['--real', 'squat'], 'required: finite numbers'),
    (['--vehicle', 'real', '--odometer', 'speed'], 'has its own odometer'),
    (['--vehicle', 'clean', '--effect', 'squat'], 'omit one of them'),
    (['--vehicle', 'real', '--imu-grade', 'navigation'], 'required: one of consumer')])
def test_wrong_usage_gives_one_line_and_exit_code_2(tmp_path, capsys, wrong_options, printed):
    assert odocal(*SHORT, '--out', tmp_path / 'drive', *wrong_options) == 2
    output = capsys.readouterr()
    assert output.out == ''
    assert output.err.count('\n') == 1
    assert printed in output.err
    assert files(tmp_path) == []


def test_a_terminal_shows_a_progress_bar_that_is_erased(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr('sys.stderr.isatty', lambda: True, raising=False)
    assert odocal(*SHORT, '--out', tmp_path / 'drive') == 0
    bar = capsys.readouterr().err
    assert '100 %' in bar
    assert bar.split('\r')[-1].strip() == ''


def test_a_random_vehicle_is_drawn_and_given_values_take_precedence(tmp_path):
    out = tmp_path / 'drive'
    assert odocal(*SHORT, '--out', out, '--vehicle', 'real', '--seed', 5, '--yaw-deg', 2,
                  '--roll-deg', 0, '--outage', '50:60', '--real', 'vibration=0.25', '--quiet') == 0
    truth = load(tmp_path / 'truth.yaml')
    assert truth['yaw_mounting_housing_deg']['value'] == pytest.approx(2)
    assert truth['yaw_mounting_deg']['value'] != truth['yaw_mounting_housing_deg']['value']
    real = truth['options']['real']
    assert real['vibration'] == 0.25
    assert real['squat'] > 0
    drive = again(truth['options'])
    assert drive.options.outages[0] == [50.0, 60.0]
    assert math.degrees(drive.truth.yaw) == truth['yaw_mounting_deg']['value']
    assert drive.truth.distance == truth['distance']['value']
    assert settings_of(tmp_path)['gnss']['lever_arm'] == pytest.approx([a + b for a, b in zip(
        truth['options']['antenna_lever_arm'], real['antenna_arm_error'], strict=True)])


def test_a_single_effect_or_value_is_simulated_alone(tmp_path):
    from odocal_ros.sim.real_effects import RealEffects
    for name, words in (('effect', ['--effect', 'squat']), ('figure', ['--real', 'squat=0.002'])):
        assert odocal(*SHORT, '--out', tmp_path / name / 'drive', *words, '--quiet') == 0
        real = RealEffects(**load(tmp_path / name / 'truth.yaml')['options']['real'])
        assert real.squat > 0
        assert real.vibration == 0
        assert (real.body_roll > 0) == (name == 'effect')

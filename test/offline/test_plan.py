# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal plan: its output compared with the prediction, and bad input."""

import math
from pathlib import Path
import re
import shlex

import numpy as np
from plan_output import gpx, NAMES, plan_of, refused, TWO_POINT
import pytest

from odocal_ros.forecast.planned_drive import add_stop_and_start
from odocal_ros.forecast.planned_methods import plan_methods, predict_smoother
from odocal_ros.forecast.predict import predict, Sigmas
from odocal_ros.library import drive_sources
from odocal_ros.offline.cli import main
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import motion_of, resolve, SimOptions

pytestmark = pytest.mark.slow
PAPER = ['plan', '--scenario', 'paper', '--imu-grade', 'navigation']
STRAIGHT = ['--distance', '1000', '--speed', '15', '--imu-grade', 'industrial']


def test_the_plan_of_the_paper_drive_agrees_with_closed_forms(capsys):
    answer = plan_of(capsys, *PAPER[1:], '--heading-sigma-deg', '0.06', '--fix-noise', 'white',
                     *TWO_POINT)
    assert answer['drive']['distance'] == pytest.approx(11_200, rel=1e-9)
    assert answer['drive']['standing'] == pytest.approx([300.0, 30.0])
    estimates = answer['methods']['two_point']['estimates']
    # white fixes at 5 Hz over 300 s and 30 s
    expected = 1.5 * math.sqrt(1 / 1500 + 1 / 150) / 11_200
    assert estimates['scale_factor']['sigma'] == pytest.approx(expected, rel=2e-3)
    budget = answer['methods']['two_point']['budget']
    assert math.degrees(budget['initial_heading']['yaw_mounting_angle']) == pytest.approx(0.06)
    assert math.degrees(budget['gyro_noise']['yaw_mounting_angle']) == pytest.approx(
        2.4e-4, abs=0.05e-4)
    for parameter in ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle'):
        whole = math.sqrt(sum(row[parameter]**2 for row in budget.values()))
        assert estimates[parameter]['sigma'] == pytest.approx(whole, rel=1e-9)


def test_suggested_changes_have_computed_sigmas(capsys):
    answer = plan_of(capsys, *PAPER[1:], '--heading-sigma-deg', '0.06', '--fix-noise', 'white',
                     *TWO_POINT)
    before = answer['methods']['two_point']['estimates']
    scale, yaw = (before[n]['sigma'] for n in ('scale_factor', 'yaw_mounting_angle'))
    changes = {c['text']: c for c in answer['changes']}
    longer = next(c for text, c in changes.items() if 'straight ahead' in text)
    assert longer['scale_factor'] == pytest.approx(scale / 2, rel=0.01)    # twice the path
    # white fix noise dominates the scale: RTK is 75 times better, the rest is below 0.04 ppm
    assert changes['RTK fixes (0.02 m)']['scale_factor'] == pytest.approx(scale / 75, rel=0.05)
    other = changes['a second leg in the other direction']
    # height: shared, small; heading: shared, dominant; the scale drifts between the legs
    first = math.hypot(scale, Config().verdict.scale_drift_per_day * math.sqrt(
        answer['drive']['duration'] / 86400))
    assert other['scale_factor'] == pytest.approx(scale * first / math.hypot(scale, first),
                                                  rel=1e-3)
    assert other['yaw_mounting_angle'] == pytest.approx(yaw, rel=1e-3)
    better = next(c for text, c in changes.items() if text.startswith('a heading with'))
    assert better['yaw_mounting_angle'] == pytest.approx(yaw / 2, rel=0.01)


def test_a_gyrocompass_heading_averages_down_over_legs(capsys):
    answer = plan_of(capsys, *PAPER[1:], *TWO_POINT)
    assert answer['sigmas']['heading_source'] == 'gyrocompass'
    assert list(answer['methods']) == ['two_point']
    yaw = answer['methods']['two_point']['estimates']['yaw_mounting_angle']['sigma']
    other = next(c for c in answer['changes'] if 'second leg' in c['text'])
    assert other['yaw_mounting_angle'] == pytest.approx(yaw / math.sqrt(2), rel=1e-3)


@pytest.mark.parametrize('drive', [['plan', *STRAIGHT], [*PAPER, *TWO_POINT]])
def test_improvements_are_sorted_by_gain_and_fit_on_the_screen(capsys, drive):
    assert main(drive) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 45
    assert max(map(len, lines)) < 120
    begin = lines.index('  largest improvements of the scale')
    end = lines.index('  largest improvements of the yaw')
    after = [float(line.split('->')[1].split()[0]) for line in lines[begin + 1:end]]
    assert len(after) > 2
    assert after == sorted(after)
    assert 'RTK' in lines[begin + 1]
    # a better IMU has smaller axis errors, too
    expected_word = 'heading' if 'method=two_point' in drive else 'stop and go'
    assert any(expected_word in line for line in lines[end + 1:end + 3])


def test_an_out_and_back_drive_needs_the_smoother(capsys):
    drive = ['--scenario', 'out_and_back', '--imu-grade', 'navigation']
    assert main(['plan', *drive, '--duration', '300']) == 0
    out = capsys.readouterr().out
    assert 'CHORD_TOO_SHORT' in out
    assert '(result: all values from smoother' in out
    answer = plan_of(capsys, *drive, *TWO_POINT)
    assert answer['methods']['two_point']['estimates']['scale_factor']['sigma'] is None
    assert answer['verdict'] == 'rejected'
    assert answer['estimates']['scale_factor'] == {'sigma': None, 'method': None}
    half = next(c for c in answer['changes'] if 'the farthest point' in c['text'])
    motion = motion_of(resolve(SimOptions(scenario='out_and_back')))
    t = np.arange(0.0, motion.duration, 0.1)
    moving = np.flatnonzero(np.abs(motion.speed(t)) > 1e-6)
    stop = t[moving[np.flatnonzero(np.diff(moving) > 100)[0]]]
    there = drive_sources.from_scenario('out_and_back', None).cut_at(
        stop - t[moving[0]] + 0.1, 30.0)
    expected = predict(there, Sigmas(config=with_settings(Config(), {'imu.grade': 'navigation'})))
    # both have a stop of 30 s, cut to a tenth of a second
    assert half['scale_factor'] == pytest.approx(expected.sigma('scale_factor'), rel=0.01)


def test_the_plan_of_the_smoother_equals_its_prediction(capsys):
    answer = plan_of(capsys, *STRAIGHT, '--fix-noise', 'white', '--pulse', '0.02', '--sway', '0.1',
                     '--slip-walk', '0.005')
    assert list(answer['methods']) == ['smoother', 'two_point']
    assert answer['verdict'] == 'accepted'      # the two-point method alone gives no yaw
    drive = drive_sources.from_figures(15.0, 1000.0, 30.0, 0, 1.0)
    sigmas = Sigmas(config=with_settings(Config(), {
        'imu.grade': 'industrial', 'gnss.correlation_time': 0.0}), quantum=0.02, sway=0.1,
        slip=0.005)
    expected = predict_smoother(drive, sigmas)
    for name in NAMES:
        sigma = expected.estimates[name].sigma
        assert answer['methods']['smoother']['estimates'][name]['sigma'] == sigma
        assert answer['estimates'][name] == {'sigma': sigma, 'method': 'smoother'}
    assert answer['methods']['smoother']['budget'] == expected.details['budget']
    assert (answer['sigmas']['sway'], answer['sigmas']['slip_walk']) == (0.1, 0.005)
    assert answer['methods']['two_point']['estimates']['yaw_mounting_angle']['sigma'] is None
    assert 'YAW_NOT_SEPARABLE' not in {r['code'] for r in answer['reasons']}
    changes = {c['text']: c for c in answer['changes']}
    stop = predict_smoother(add_stop_and_start(drive), sigmas)
    assert changes['one more stop and start']['yaw_mounting_angle'] == pytest.approx(
        stop.estimates['yaw_mounting_angle'].sigma, rel=1e-12)
    # own errors are halved in variance, errors shared by legs stay; two legs together determine
    # the imperfections slightly better, in the next digit
    other = changes['a second leg in the other direction']['yaw_mounting_angle']
    yaw = expected.estimates['yaw_mounting_angle'].sigma
    assert yaw / math.sqrt(2) * 0.999 <= other < yaw


def test_an_undetermined_yaw_is_reported_with_the_cause_and_the_remedy(tmp_path, capsys):
    # two minutes of uniform driving, marked in motion
    path = str(gpx(tmp_path / 'a.gpx', rest=0.0, corner=0.0, count=60))
    assert main(['plan', '--gpx', path, '--imu-grade', 'consumer']) == 0
    out = capsys.readouterr().out
    # the axes of the IMU are wrong by half a degree: without turns the pitch is not observable
    assert '(result: scale from smoother, yaw and pitch not determined' in out
    plain_text = ' '.join(out.split())
    assert 'YAW_NOT_DETERMINED: yaw mounting uncertainty is' in plain_text
    assert 'Drive with stops, starts and turns' in plain_text
    answer = plan_of(capsys, '--gpx', path, '--imu-grade', 'consumer')
    assert answer['estimates']['yaw_mounting_angle'] == {'sigma': None, 'method': None}
    changes = {c['text']: c['yaw_mounting_angle'] for c in answer['changes']}
    assert changes['5 min more, stop and go with turns'] < math.radians(0.05)
    lines = out.splitlines()
    begin = lines.index('  largest improvements of the yaw')
    assert 'not determined ->' in lines[begin + 1]


@pytest.mark.parametrize(('method', 'shown', 'by'), [
    ('auto', ['smoother', 'two_point'], 'smoother'), ('two_point', ['two_point'], 'two_point'),
    ('smoother', ['smoother', 'two_point'], 'smoother'),
    ('wheels', ['smoother', 'two_point'], 'smoother')])
def test_the_requested_methods_are_planned(method, shown, by):
    config = with_settings(Config(), {'method': method, 'alignment.heading_source': 'fixed',
                                      'alignment.heading_sigma': 0.002})
    drive = drive_sources.from_figures(15.0, 500.0, 10.0, 0, 1.0)
    plan = plan_methods(drive, Sigmas(config=config))
    assert list(plan.methods) == shown
    assert {plan.method_of(name) for name in NAMES[:2]} == {by}


@pytest.mark.core
@pytest.mark.parametrize('begin', ['# Plan a drive', '## Small robots'])
def test_the_page_shows_the_printed_output(begin, capsys):
    page = (Path(__file__).parents[2] / 'docs' / 'planning.md').read_text(encoding='utf-8')
    section = page.partition(begin)[2]
    command = next(line for line in section.splitlines() if line.startswith('odocal plan '))
    assert main(shlex.split(command)[1:]) == 0
    shown = section.partition('```text\n')[2].partition('```')[0].split()
    printed = capsys.readouterr().out.split()
    assert len(shown) == len(printed)
    for one, other in zip(shown, printed, strict=True):
        if re.fullmatch(r'[\d.]+%?', one):
            # another BLAS may round the last of two digits differently
            assert float(other.rstrip('%')) == pytest.approx(float(one.rstrip('%')), rel=0.06,
                                                             abs=1.1 if '%' in one else 0)
        else:
            assert one == other


@pytest.mark.parametrize(('argv', 'words'), [
    ([], 'give one drive'),
    (['--scenario', 'paper', '--distance', '5'], 'not --scenario and --distance'),
    (['--scenario', 'moon'], 'required: one of paper'),
    (['--scenario', 'paper', '--duration', '10'], 'too short'),
    (['--distance', '500'], '--distance requires --speed'),
    (['--distance', '500', '--speed', '0'], '--speed 0'),
    (['--distance', '0', '--speed', '10'], '--distance 0'),
    (['--distance', '1e9', '--speed', '10'], 'the limits are'),
    (['--distance', '500', '--speed', '10', '--standstill', '-1'], '--standstill -1'),
    (['--distance', '500', '--speed', '10', '--acceleration', '0'], '--acceleration 0'),
    (['--distance', '500', '--speed', '10', '--turns', '99'], '--turns 99'),
    (['--distance', '500', '--speed', '10', '--turns', '-1'], '--turns -1'),
    (['--scenario', 'paper', '--turns', '2'], '--turns requires --distance'),
    (['--scenario', 'paper', '--speed', '9'], '--speed requires --distance or --gpx'),
    (['--bag', 'a', '--speed', '9'], '--speed requires --distance or --gpx'),
    (['--bag', 'a', '--acceleration', '1'], '--acceleration requires --distance'),
    (['--scenario', 'paper', '--imu-topic', '/imu'], '--imu-topic requires --bag'),
    (['--gpx', 'a.gpx', '--duration', '2'], '--duration requires --scenario'),
    (['--scenario', 'paper', '--fix-sigma', '0'], 'fix sigma 0'),
    (['--scenario', 'paper', '--heading-sigma-deg', '0'], '--heading-sigma-deg 0'),
    (['--scenario', 'paper', '--imu-grade', 'best'], 'not one of consumer'),
    (['--scenario', 'paper', '--heading-source', 'stars'], 'not one of auto'),
    (['--scenario', 'paper', '--sway', '-1'], 'sway -1'),
    (['--scenario', 'paper', '--slip-walk', 'nan'], 'slip nan'),
    (['--scenario', 'paper', '--rtk', '--fix-sigma', '1'], 'exclude each other'),
    (['--scenario', 'paper', '--set', 'imu.gyro_nois=1'], 'imu.gyro_noise'),
    (['--distance', '4', '--speed', '2', '--standstill', '0', '--fix-rate', '0.1'],
     'less than one fix interval'),
    (['--gpx', '/nowhere/a.gpx'], 'cannot be read')])
def test_bad_input_gives_one_sentence(capsys, argv, words):
    assert words in refused(capsys, *argv)

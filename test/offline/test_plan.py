# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal plan: its answers against the prediction, its drives against their source, bad input."""

import json
import math
from pathlib import Path
import re
import shlex

import numpy as np
import pytest

from odocal_ros.forecast.planned_drive import add_stop_and_start
from odocal_ros.forecast.planned_methods import plan_methods, predict_smoother
from odocal_ros.forecast.predict import predict, Sigmas
from odocal_ros.library import planned_drives
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.offline.cli import main
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import motion_of, resolved, SimOptions

pytestmark = pytest.mark.slow
PAPER = ['plan', '--scenario', 'paper', '--imu-grade', 'navigation']
TWO_POINT = ['--set', 'method=two_point']
STRAIGHT = ['--distance', '1000', '--speed', '15', '--imu-grade', 'industrial']
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')


def plan_of(capsys, *argv):
    assert main(['plan', *argv, '--json']) == 0
    out, err = capsys.readouterr()
    assert err == ''
    return json.loads(out)


def refused(capsys, *argv):
    assert main(['plan', *argv]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.count('\n') == 1
    return err


def test_the_paper_drive_is_planned_as_it_is_predicted(capsys):
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


def test_changes_are_computed_not_told(capsys):
    answer = plan_of(capsys, *PAPER[1:], '--heading-sigma-deg', '0.06', '--fix-noise', 'white',
                     *TWO_POINT)
    before = answer['methods']['two_point']['estimates']
    scale, yaw = (before[n]['sigma'] for n in ('scale_factor', 'yaw_mounting_angle'))
    changes = {c['text']: c for c in answer['changes']}
    longer = next(c for text, c in changes.items() if 'straight ahead' in text)
    assert longer['scale_factor'] == pytest.approx(scale / 2, rel=0.01)    # twice the way
    # white fixes alone make the scale: RTK is 75 times better, the rest is below 0.04 ppm
    assert changes['RTK fixes (0.02 m)']['scale_factor'] == pytest.approx(scale / 75, rel=0.05)
    other = changes['a second leg in the other direction']
    # height is shared and small; the heading is shared and all; between both the scale walks
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
def test_the_screen_ranks_by_gain_and_fits(capsys, drive):
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
    # a better IMU has straighter axes too
    expected_word = 'heading' if 'method=two_point' in drive else 'stop and go'
    assert any(expected_word in line for line in lines[end + 1:end + 3])


def test_an_out_and_back_is_no_two_point_drive_but_the_smoothers(capsys):
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
    motion = motion_of(resolved(SimOptions(scenario='out_and_back')))
    t = np.arange(0.0, motion.duration, 0.1)
    moving = np.flatnonzero(np.abs(motion.speed(t)) > 1e-6)
    stop = t[moving[np.flatnonzero(np.diff(moving) > 100)[0]]]
    there = planned_drives.from_scenario('out_and_back', None).cut_at(
        stop - t[moving[0]] + 0.1, 30.0)
    expected = predict(there, Sigmas(config=with_settings(Config(), {'imu.grade': 'navigation'})))
    # the stop is 30 s here and there, cut to a tenth of a second
    assert half['scale_factor'] == pytest.approx(expected.sigma('scale_factor'), rel=0.01)


def test_the_smoother_gives_what_it_can_and_is_planned_as_it_is_predicted(capsys):
    answer = plan_of(capsys, *STRAIGHT, '--fix-noise', 'white', '--pulse', '0.02', '--sway', '0.1',
                     '--slip-walk', '0.005')
    assert list(answer['methods']) == ['smoother', 'two_point']
    assert answer['verdict'] == 'accepted'      # the two-point method alone gives no yaw
    drive = planned_drives.from_figures(15.0, 1000.0, 30.0, 0, 1.0)
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
    # own errors are halved in variance, those shared by legs stay; of what is imperfect two legs
    # together tell a little more, in the next digit
    other = changes['a second leg in the other direction']['yaw_mounting_angle']
    yaw = expected.estimates['yaw_mounting_angle'].sigma
    assert yaw / math.sqrt(2) * 0.999 <= other < yaw


def test_a_yaw_that_no_method_gives_says_why_and_what_would(tmp_path, capsys):
    # two minutes of even driving, marked in motion
    path = str(gpx(tmp_path / 'a.gpx', rest=0.0, corner=0.0, count=60))
    assert main(['plan', '--gpx', path, '--imu-grade', 'consumer']) == 0
    out = capsys.readouterr().out
    # an IMU whose axes are off by half a degree: without turns no pitch against the plane of them
    assert '(result: scale from smoother, yaw and pitch unknown' in out
    plain_text = ' '.join(out.split())
    assert 'YAW_NOT_DETERMINED: yaw mounting uncertainty is' in plain_text
    assert 'Drive with stops, starts and turns' in plain_text
    answer = plan_of(capsys, '--gpx', path, '--imu-grade', 'consumer')
    assert answer['estimates']['yaw_mounting_angle'] == {'sigma': None, 'method': None}
    changes = {c['text']: c['yaw_mounting_angle'] for c in answer['changes']}
    assert changes['5 min more, stop and go with turns'] < math.radians(0.05)
    lines = out.splitlines()
    begin = lines.index('  largest improvements of the yaw')
    assert 'unknown ->' in lines[begin + 1]


@pytest.mark.parametrize(('method', 'shown', 'by'), [
    ('auto', ['smoother', 'two_point'], 'smoother'), ('two_point', ['two_point'], 'two_point'),
    ('smoother', ['smoother', 'two_point'], 'smoother'),
    ('wheels', ['smoother', 'two_point'], 'smoother')])
def test_the_methods_asked_for_are_planned(method, shown, by):
    config = with_settings(Config(), {'method': method, 'alignment.heading_source': 'fixed',
                                      'alignment.heading_sigma': 0.002})
    drive = planned_drives.from_figures(15.0, 500.0, 10.0, 0, 1.0)
    plan = plan_methods(drive, Sigmas(config=config))
    assert list(plan.methods) == shown
    assert {plan.method_of(name) for name in NAMES[:2]} == {by}


@pytest.mark.core
@pytest.mark.parametrize('begin', ['# Plan a drive', '## Small robots'])
def test_the_page_shows_what_is_printed(begin, capsys):
    page = (Path(__file__).parents[2] / 'docs' / 'planning.md').read_text(encoding='utf-8')
    section = page.partition(begin)[2]
    command = next(line for line in section.splitlines() if line.startswith('odocal plan '))
    assert main(shlex.split(command)[1:]) == 0
    shown = section.partition('```text\n')[2].partition('```')[0].split()
    printed = capsys.readouterr().out.split()
    assert len(shown) == len(printed)
    for one, other in zip(shown, printed, strict=True):
        if re.fullmatch(r'[\d.]+%?', one):
            # another BLAS may round a last digit otherwise, of two
            assert float(other.rstrip('%')) == pytest.approx(float(one.rstrip('%')), rel=0.06,
                                                             abs=1.1 if '%' in one else 0)
        else:
            assert one == other


def test_a_drive_of_figures_has_those_figures():
    drive = planned_drives.from_figures(15.0, 3000.0, 20.0, 2, 1.0)
    assert drive.distance == pytest.approx(3000.0, rel=1e-6)
    assert drive.speed.max() == pytest.approx(15.0)
    # 2 * 15 s of ramp, 225 m of way in them
    assert drive.duration == pytest.approx(30 + (3000 - 225) / 15 + 20, abs=0.11)
    assert drive.standstills(2.0)[0][1] == pytest.approx(0.0, abs=0.11)
    assert np.ptp(drive.yaw) == pytest.approx(math.pi / 2, rel=0.02)
    assert drive.yaw[-1] == pytest.approx(drive.yaw[0], abs=1e-6)     # left, then right
    slow = planned_drives.from_figures(15.0, 100.0, 20.0, 0, 1.0)
    assert slow.speed.max() == pytest.approx(10.0)         # v^2 = a d: no more in 100 m
    assert slow.distance == pytest.approx(100.0, rel=1e-6)


def gpx(path, times=True, rest=30.0, count=200, corner=math.pi / 2):
    """Write a track: rest, east at 10 m/s with a point a second, left as far, rest."""
    t = np.concatenate([[0.0, rest / 2], rest + np.arange(2 * count + 1), [2 * count + 2 * rest]])
    t = t[np.diff(t, prepend=-1.0) > 0]
    path_length = np.clip(t - rest, 0, 2 * count) * 10.0
    first, second = np.minimum(path_length, count * 10.0), np.maximum(path_length - count * 10.0,
                                                                      0.0)
    east, north = first + second * math.cos(corner), second * math.sin(corner)
    return gpx_of(path, t, east, north, times)


def gpx_of(path, t, east, north, times=True):
    """Write a track through points, m."""
    origin = Origin(math.radians(48.0), math.radians(11.0), 500.0)
    geodetic = origin.to_geodetic(np.stack([east, north, np.zeros_like(east)], -1))
    points = []
    for (lat, lon, height), when in zip(geodetic, t, strict=True):
        stamp = f'<time>2026-01-01T00:{int(when) // 60:02d}:{when % 60:04.1f}Z</time>'
        points.append(f'<trkpt lat="{math.degrees(lat):.9f}" lon="{math.degrees(lon):.9f}">'
                      f'<ele>{height:.2f}</ele>{stamp if times else ""}</trkpt>')
    path.write_text('<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1">'
                    f'<trk><trkseg>{"".join(points)}</trkseg></trk></gpx>')
    return path


@pytest.mark.parametrize(('scenario', 'noise'), [('straight', 0.0), ('straight', 0.05),
                                                 ('town', 0.2)])
def test_the_jerks_of_a_gpx_tell_no_heading(tmp_path, scenario, noise):
    motion = motion_of(resolved(SimOptions(scenario=scenario)))
    t = np.arange(0.0, motion.duration, 0.05)
    step = motion.speed(t) * 0.05 * np.exp(1j * np.cumsum(motion.yaw_rate(t) * 0.05))
    place = np.cumsum(step)[::20]      # a point a second
    place = place + noise * np.random.default_rng(3).normal(size=(2, len(place))).T.copy().view(
        complex)[:, 0]
    sigmas = Sigmas()
    own, drawn = (predict_smoother(drive, sigmas).estimates for drive in (
        planned_drives.from_scenario(scenario, None),
        planned_drives.from_gpx(gpx_of(tmp_path / 'a.gpx', t[::20], place.real, place.imag))))
    # points 5 m apart hide how a start of 0.5 m/s^2 sets in, 4 s of it: of 25 s, a sixth, and
    # noise adds to it; steps of speed at each point would halve the sigma of the straight drive
    for name in NAMES[:2]:
        assert drawn[name].sigma > 0.75 * own[name].sigma


def test_a_gpx_track_is_driven_as_it_was(tmp_path, capsys):
    drive = planned_drives.from_gpx(gpx(tmp_path / 'a.gpx'))
    assert drive.distance == pytest.approx(4000.0, rel=2e-3)       # the corner is cut by a point
    assert np.median(drive.speed[drive.speed > 0]) == pytest.approx(10.0, rel=1e-3)
    rest = drive.standstills(2.0)
    # a point a second, and 2 s at each end for a start that no car makes from 0 to 10 m/s at once
    assert [b - a for a, b in rest] == pytest.approx([28.0, 28.0], abs=1.1)
    assert np.abs(np.diff(drive.speed) / np.diff(drive.t)).max() < 10.0 / 4.0 * 1.05
    assert drive.yaw[0] == pytest.approx(0.0, abs=1e-3)            # east
    assert drive.yaw[-1] == pytest.approx(math.pi / 2, abs=1e-3)   # north
    assert math.degrees(drive.latitude) == pytest.approx(48.0)
    answer = plan_of(capsys, '--gpx', str(tmp_path / 'a.gpx'), *TWO_POINT)
    assert answer['drive']['chord'] == pytest.approx(math.hypot(2000, 2000), rel=5e-3)


def test_a_gpx_route_without_times_needs_a_speed(tmp_path, capsys):
    path = str(gpx(tmp_path / 'a.gpx', times=False))
    assert 'no times; give --speed' in refused(capsys, '--gpx', path)
    answer = plan_of(capsys, '--gpx', path, '--speed', '20', *TWO_POINT)
    assert answer['drive']['duration'] == pytest.approx(200.0, rel=0.01)


@pytest.mark.parametrize(('text', 'words'), [
    (b'no xml at all', 'is not a GPX file'), (b'<gpx></gpx>', 'holds 0 track points'),
    (b'\xff\xfe\x00', 'is not a GPX file'), (b'', 'is not a GPX file'),
    (b'<gpx><trkpt lat="x" lon="1"/><trkpt lat="1" lon="1"/></gpx>', 'not readable'),
    (b'<gpx><trkpt lat="91" lon="1"/><trkpt lat="1" lon="1"/></gpx>', 'out of range'),
    (b'<gpx><trkpt lon="1"/><trkpt lat="1" lon="1"/></gpx>', 'out of range'),
    (b'<gpx><trkpt lat="1" lon="1"><time>now</time></trkpt><trkpt lat="1" lon="1"/></gpx>',
     'not readable'),
    (b'<gpx><trkpt lat="1" lon="1"><time>2026-01-01T00:00:00Z</time></trkpt>'
     b'<trkpt lat="1" lon="1"><time>2026-01-01T00:01:00Z</time></trkpt></gpx>', 'never moves')])
def test_a_gpx_that_cannot_be_used_is_refused(tmp_path, capsys, text, words):
    path = tmp_path / 'a.gpx'
    path.write_bytes(text)
    message = refused(capsys, '--gpx', str(path))
    assert words in message
    assert str(path) in message


def test_a_gpx_without_an_end_is_refused(capsys):
    assert 'exceeds the limit' in refused(capsys, '--gpx', '/dev/zero')


def test_a_bag_is_planned_by_its_own_drive_and_fixes(tmp_path, capsys):
    bag = tmp_path / 'drive'
    assert main(['simulate', '--scenario', 'straight', '--out', str(bag), '--duration', '200',
                 '--imu-rate', '50', '--fix-sigma', '0.5', '--fix-rate', '2', '--quiet']) == 0
    capsys.readouterr()
    answer = plan_of(capsys, '--bag', str(bag), '--imu-grade', 'industrial')
    assert answer['sigmas']['fix_sigma'] == pytest.approx(0.5, rel=1e-6)
    assert answer['sigmas']['fix_rate'] == pytest.approx(2.0, rel=1e-6)
    motion = motion_of(resolved(SimOptions(scenario='straight', duration=200.0)))
    assert answer['drive']['distance'] == pytest.approx(motion.distance, rel=0.01)
    assert answer['drive']['standing'] == pytest.approx([60.0, 60.0], abs=1.5)
    assert answer['sigmas']['pulse'] == pytest.approx(0.0213, rel=0.02)     # its own counts
    own = plan_of(capsys, '--bag', str(bag), '--pulse', '0.1', *TWO_POINT)
    assert own['sigmas']['pulse'] == 0.1
    assert str(tmp_path / 'none') in refused(capsys, '--bag', str(tmp_path / 'none'))
    (bag / 'journal.yaml').write_text(
        '/**/calibrator:\n  ros__parameters:\n    imu.grade: tactical\n'
        'odocal_journal:\n  ros__parameters:\n    leg_id: 1\n')
    assert plan_of(capsys, '--bag', str(bag))['sigmas']['imu_grade'] == 'tactical'
    given = plan_of(capsys, '--bag', str(bag), '--imu-grade', 'industrial')
    assert given['sigmas']['imu_grade'] == 'industrial'


def test_a_drive_too_short_for_its_speed_brakes_from_a_lower_one(capsys):
    assert main(['plan', '--distance', '10', '--speed', '30']) == 0
    assert '10.00 m in 36.3 s' in capsys.readouterr().out      # 30 s at each mark, 2 sqrt(10)


@pytest.mark.parametrize(('argv', 'words'), [
    ([], 'give one drive'),
    (['--scenario', 'paper', '--distance', '5'], 'not --scenario and --distance'),
    (['--scenario', 'moon'], 'required: one of paper'),
    (['--scenario', 'paper', '--duration', '10'], 'too short'),
    (['--distance', '500'], '--distance needs --speed'),
    (['--distance', '500', '--speed', '0'], '--speed 0'),
    (['--distance', '0', '--speed', '10'], '--distance 0'),
    (['--distance', '1e9', '--speed', '10'], 'the limits are'),
    (['--distance', '500', '--speed', '10', '--standstill', '-1'], '--standstill -1'),
    (['--distance', '500', '--speed', '10', '--acceleration', '0'], '--acceleration 0'),
    (['--distance', '500', '--speed', '10', '--turns', '99'], '--turns 99'),
    (['--distance', '500', '--speed', '10', '--turns', '-1'], '--turns -1'),
    (['--scenario', 'paper', '--turns', '2'], 'require --distance'),
    (['--gpx', 'a.gpx', '--duration', '2'], '--duration requires --scenario'),
    (['--scenario', 'paper', '--fix-sigma', '0'], 'fix sigma 0'),
    (['--scenario', 'paper', '--fix-rate', '0'], 'fix rate 0'),
    (['--scenario', 'paper', '--heading-sigma-deg', '0'], '--heading-sigma-deg 0'),
    (['--scenario', 'paper', '--imu-grade', 'best'], 'not one of consumer'),
    (['--scenario', 'paper', '--heading-source', 'stars'], 'not one of auto'),
    (['--scenario', 'paper', '--pulse', '-1'], 'size of a count -1'),
    (['--scenario', 'paper', '--sway', '-1'], 'sway -1'),
    (['--scenario', 'paper', '--slip-walk', 'nan'], 'slip nan'),
    (['--scenario', 'paper', '--rtk', '--fix-sigma', '1'], 'exclude each other'),
    (['--scenario', 'paper', '--set', 'imu.gyro_nois=1'], 'imu.gyro_noise'),
    (['--distance', '4', '--speed', '2', '--standstill', '0', '--fix-rate', '0.1'],
     'less than one fix interval'),
    (['--gpx', '/nowhere/a.gpx'], 'cannot be read')])
def test_bad_input_is_one_clear_sentence(capsys, argv, words):
    assert words in refused(capsys, *argv)

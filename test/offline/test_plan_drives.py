# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drives of odocal plan from figures, GPX tracks and bags, compared with their source."""

import math

import numpy as np
from plan_output import gpx, gpx_of, NAMES, plan_of, refused, TWO_POINT
import pytest

from odocal_ros.forecast.planned_methods import predict_smoother
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.library import drive_sources
from odocal_ros.offline.cli import main
from odocal_ros.sim.scenarios import motion_of, resolve, SimOptions

pytestmark = pytest.mark.slow


def test_a_drive_from_figures_has_these_figures():
    drive = drive_sources.from_figures(15.0, 3000.0, 20.0, 2, 1.0)
    assert drive.distance == pytest.approx(3000.0, rel=1e-6)
    assert drive.speed.max() == pytest.approx(15.0)
    # two ramps of 15 s, 225 m in total
    assert drive.duration == pytest.approx(30 + (3000 - 225) / 15 + 20, abs=0.11)
    assert drive.standstills(2.0)[0][1] == pytest.approx(0.0, abs=0.11)
    assert np.ptp(drive.yaw) == pytest.approx(math.pi / 2, rel=0.02)
    assert drive.yaw[-1] == pytest.approx(drive.yaw[0], abs=1e-6)     # left, then right
    slow = drive_sources.from_figures(15.0, 100.0, 20.0, 0, 1.0)
    assert slow.speed.max() == pytest.approx(10.0)         # v^2 = a d: no more in 100 m
    assert slow.distance == pytest.approx(100.0, rel=1e-6)


@pytest.mark.parametrize(('scenario', 'noise'), [('straight', 0.0), ('straight', 0.05),
                                                 ('town', 0.2)])
def test_speed_steps_of_a_gpx_track_do_not_reduce_the_sigmas(tmp_path, scenario, noise):
    motion = motion_of(resolve(SimOptions(scenario=scenario)))
    t = np.arange(0.0, motion.duration, 0.05)
    step = motion.speed(t) * 0.05 * np.exp(1j * np.cumsum(motion.yaw_rate(t) * 0.05))
    place = np.cumsum(step)[::20]      # a point a second
    place = place + noise * np.random.default_rng(3).normal(size=(2, len(place))).T.copy().view(
        complex)[:, 0]
    sigmas = Sigmas()
    planned, drawn = (predict_smoother(drive, sigmas).estimates for drive in (
        drive_sources.from_scenario(scenario, None),
        drive_sources.from_gpx(gpx_of(tmp_path / 'a.gpx', t[::20], place.real, place.imag))))
    # points 5 m apart hide the first 4 s of a start with 0.5 m/s^2, a sixth of its 25 s, and noise
    # adds to it; steps of speed at each point would halve the sigma of the straight drive
    for name in NAMES[:2]:
        assert drawn[name].sigma > 0.75 * planned[name].sigma


def test_a_gpx_track_gives_its_distance_speed_and_standstills(tmp_path, capsys):
    drive = drive_sources.from_gpx(gpx(tmp_path / 'a.gpx'))
    assert drive.distance == pytest.approx(4000.0, rel=2e-3)       # one point cuts the corner
    assert np.median(drive.speed[drive.speed > 0]) == pytest.approx(10.0, rel=1e-3)
    rest = drive.standstills(2.0)
    # one point per second, and a ramp of 2 s at each end: no car jumps from 0 to 10 m/s
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
def test_an_unusable_gpx_file_is_refused(tmp_path, capsys, text, words):
    path = tmp_path / 'a.gpx'
    path.write_bytes(text)
    message = refused(capsys, '--gpx', str(path))
    assert words in message
    assert str(path) in message


def test_an_endless_gpx_file_is_refused(capsys):
    assert 'exceeds the limit' in refused(capsys, '--gpx', '/dev/zero')


def test_the_plan_of_a_bag_uses_its_drive_and_fixes(tmp_path, capsys):
    bag = tmp_path / 'drive'
    assert main(['simulate', '--scenario', 'straight', '--out', str(bag), '--duration', '200',
                 '--imu-rate', '50', '--fix-sigma', '0.5', '--fix-rate', '2', '--quiet']) == 0
    capsys.readouterr()
    answer = plan_of(capsys, '--bag', str(bag), '--imu-grade', 'industrial')
    assert answer['sigmas']['fix_sigma'] == pytest.approx(0.5, rel=1e-6)
    assert answer['sigmas']['fix_rate'] == pytest.approx(2.0, rel=1e-6)
    motion = motion_of(resolve(SimOptions(scenario='straight', duration=200.0)))
    assert answer['drive']['distance'] == pytest.approx(motion.distance, rel=0.01)
    assert answer['drive']['standing'] == pytest.approx([60.0, 60.0], abs=1.5)
    assert answer['sigmas']['pulse'] == pytest.approx(0.0213, rel=0.02)     # its own counts
    plan = plan_of(capsys, '--bag', str(bag), '--pulse', '0.1', *TWO_POINT)
    assert plan['sigmas']['pulse'] == 0.1
    assert str(tmp_path / 'none') in refused(capsys, '--bag', str(tmp_path / 'none'))
    (bag / 'journal.yaml').write_text(
        '/**/calibrator:\n  ros__parameters:\n    imu.grade: tactical\n'
        '    projection.kind: leg\n'      # of an earlier version
        'odocal_journal:\n  ros__parameters:\n    leg_id: 1\n')
    assert plan_of(capsys, '--bag', str(bag))['sigmas']['imu_grade'] == 'tactical'
    given = plan_of(capsys, '--bag', str(bag), '--imu-grade', 'industrial')
    assert given['sigmas']['imu_grade'] == 'industrial'


def test_a_drive_too_short_for_its_speed_brakes_from_a_lower_speed(capsys):
    assert main(['plan', '--distance', '10', '--speed', '30']) == 0
    assert '10.00 m in 36.3 s' in capsys.readouterr().out      # 30 s at each mark, 2 sqrt(10)

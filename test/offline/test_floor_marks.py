# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two marks and a tape: squares both ways give the factor of each wheel and the track width."""

import json

import numpy as np
import pytest

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.errors import BadUsage
from odocal_ros.library.calibrate_bag import calibrate_bag
from odocal_ros.offline import cli
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
TIMES = (5.0, *(20.5 + 17.0 * k for k in range(8)))
POINTS = (0, 0, 4, 0, 4, 4, 0, 4, 0, 0, 4, 0, 4, -4, 0, -4, 0, 0)
TURNED = [c for x, y in np.reshape(POINTS, (-1, 2)) for c in (3.0 - y, x - 7.0)]


def robot(folder, **options):
    """Return a drive and its bag, without the topic of a reference."""
    made = simulate(SimOptions(scenario='square', **options))
    topics = [t for t in drive_topics(made) if t.name != made.reference.topic]
    return made, write_bag(folder / 'bag', topics)


def marks_config(made, **more):
    return {'odometer.nominal_scale': made.options.nominal_scale, 'odometer.left': 'topic',
            'odometer.right': 'topic', 'reference.points': [float(x) for x in POINTS],
            'reference.marks': list(TIMES)} | more


TOPICS = {'odometer': '/odometer/left', 'odometer_right': '/odometer/right'}


def test_marks_are_sufficient_without_an_imu(tmp_path):
    """Four steps between marks are compared with the wheels at first: fewer fit any path."""
    made, bag = robot(tmp_path, imu=False)
    found = calibrate_bag(bag, TOPICS, marks_config(made, **{'verdict.max_scale_sigma': 0.005}))
    assert found.verdict.value == 'accepted', found.reasons
    for name, true in (('scale_factor_left', made.truth.wheel_scales[0]),
                       ('scale_factor_right', made.truth.wheel_scales[1]),
                       ('track_width', made.options.track_width)):
        one = found.result.estimates[name]
        assert abs(one.value - true) < 3 * one.sigma < 3 * 4e-3 * true, name


def test_without_noise_wheels_and_width_are_those_of_the_closed_form(tmp_path):
    """
    Borenstein and Feng 1996, with the counts of each side and turn instead of end points.

    A side of length L with counts n has the factor L / n; a turn by 90 deg on the spot in which
    the wheels count n_l and n_r has the width (K_r n_r - K_l n_l) / (pi / 2).
    """
    made, bag = robot(tmp_path, imu_grade='perfect', wheel_difference=0.01, track_width=0.41)
    left, right = (w.value.astype(float) for w in made.wheels)
    t = (made.odometer.stamp_ns - made.options.start_ns) * 1e-9

    def counted(value, begin, end):
        return np.interp(end, t, value) - np.interp(begin, t, value)
    sides = [(a + 4.0, b) for a, b in zip(TIMES, TIMES[1:], strict=False)]
    K_l, K_r = (4.0 * 8 / sum(counted(w, *side) for side in sides) for w in (left, right))
    turns = [(b, b + 4.5) for b in TIMES[1:5]]
    width = sum(K_r * counted(right, *turn) - K_l * counted(left, *turn)
                for turn in turns) / (2 * np.pi)
    found = calibrate_bag(bag, TOPICS, marks_config(made, **{'imu.grade': 'navigation'})).values
    # a tenth of the sigma, to which the other unknowns have priors; the ratio has no such
    for name, true in (('scale_factor_left', K_l), ('scale_factor_right', K_r),
                       ('track_width', width)):
        assert found[name] == pytest.approx(true, rel=2e-4), name
    ratio = found['scale_factor_right'] / found['scale_factor_left']
    assert ratio == pytest.approx(K_r / K_l, rel=5e-6)
    # the closed form, of rounding by a count: 0.09 mm in 32 m, and in turns of 0.64 m
    assert pytest.approx(made.truth.wheel_scales, rel=1e-5) == (K_l, K_r)
    assert width == pytest.approx(0.41, rel=2e-4)


def test_marks_may_be_given_in_any_order_with_their_points(tmp_path):
    made, bag = robot(tmp_path)
    pairs = np.reshape(POINTS, (-1, 2))[np.arange(len(TIMES)) % (len(POINTS) // 2)]
    order = [4, 0, 8, 2, 6, 1, 5, 3, 7]
    plain, shuffled = (calibrate_bag(bag, TOPICS, marks_config(made, **more)) for more in (
        {}, {'reference.marks': [TIMES[k] for k in order],
             'reference.points': pairs[order].ravel().astype(float).tolist()}))
    assert shuffled.values == plain.values


def test_the_axes_of_the_points_are_free(tmp_path):
    made, bag = robot(tmp_path)
    plain, turned = (calibrate_bag(bag, TOPICS, marks_config(made, **{'reference.points': list(
        map(float, points))})) for points in (POINTS, TURNED))
    for name, value in plain.values.items():
        if name in ('scale_factor', 'track_width', 'yaw_mounting_angle'):
            assert abs(turned.values[name] - value) < 0.05 * plain.sigmas[name], name
            assert plain.sigmas[name] == pytest.approx(turned.sigmas[name], rel=0.02)


def test_replay_accepts_marks_as_options(tmp_path, capsys):
    out = tmp_path / 'square'
    assert cli.main(['simulate', '--scenario', 'square', '--out', str(out), '--quiet']) == 0
    marks = [word for t in TIMES for word in ('--mark', f'{t:g}')]
    points = f'reference.points=[{",".join(map(str, POINTS))}]'
    assert cli.main(['replay', str(out), '--config', str(tmp_path / 'calibrator.yaml'), '--set',
                     points, *marks, '--odometer-topic', '/odometer/left',
                     '--odometer-right-topic', '/odometer/right', '--output',
                     str(tmp_path / 'out')]) == 0
    printed = capsys.readouterr()
    assert 'position reference' not in printed.err
    written = json.loads((tmp_path / 'out' / 'calibration.json').read_text())
    codes = {r['code'] for r in written['legs'][0]['reasons']}
    assert 'LOCAL_FRAME' in codes
    assert not codes & {'WHEEL_REVERSED', 'WHEEL_DEAD', 'LEG_TOO_SHORT', 'MODEL_MISMATCH'}
    scale, width = (written['result'][name] for name in ('scale_factor', 'track_width'))
    assert abs(scale['value'] - 8.9e-5) < 3 * scale['sigma'] < 3 * 2e-3 * 8.9e-5
    assert abs(width['value'] - 0.3) < 3 * width['sigma'] < 3 * 3e-3 * 0.3


@pytest.mark.parametrize(('change', 'message'), [
    ({'reference.marks': [5.0, 14.0]}, '--mark 14: the wheels turn within 0.5 s of it'),
    ({'reference.marks': [5.0, 23.5]}, '--mark 23.5: the wheels turn'),      # on the spot
    ({'reference.marks': [5.0, 500.0]}, '--mark 500: the odometer has no data there'),
    ({'reference.points': [0.0, 0.0, 4.0]}, 'reference.points has 3 values; required with marks'),
    ({'reference.points': []}, 'reference.points has 0 values')])
def test_impossible_marks_are_refused(change, message, tmp_path):
    made, bag = robot(tmp_path, imu_rate=20.0)
    with pytest.raises(BadUsage, match=message):
        calibrate_bag(bag, TOPICS, marks_config(made) | change)


def test_marks_and_a_reference_topic_exclude_each_other(tmp_path):
    made = simulate(SimOptions(scenario='square', imu_rate=20.0))
    bag = write_bag(tmp_path / 'bag', drive_topics(made))
    with pytest.raises(BadUsage, match='--fix-topic /slam/pose: reference.marks is set'):
        calibrate_bag(bag, TOPICS | {'fix': '/slam/pose'}, marks_config(made))


def test_a_status_of_another_program_has_no_marks(tmp_path, monkeypatch):
    made, bag = robot(tmp_path, imu_rate=20.0)
    stored = [{'marks': '12:x,,7', 'leg_event': 'stopped'}, {}]
    monkeypatch.setattr('odocal_ros.library.read_bag.last_statuses', lambda bag: stored)
    with pytest.raises(BadUsage, match=r'no fix \(a topic of'):
        calibrate_bag(bag, TOPICS, marks_config(made) | {'reference.marks': []})

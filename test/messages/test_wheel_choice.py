# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Choice of wheels by the names of joints: real robots, and names without information."""

from dataclasses import replace

from drives import drive, reason_texts, settings
import pytest

from odocal_ros.messages.wheel_choice import select_wheels
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code

pytestmark = pytest.mark.slow
REAL = {
    'turtlebot3': (['wheel_left_joint', 'wheel_right_joint'],
                   ('wheel_left_joint', 'wheel_right_joint')),
    'create3, with wheel drops': (
        ['wheel_drop_left_joint', 'wheel_drop_right_joint', 'right_wheel_joint',
         'left_wheel_joint'], ('left_wheel_joint', 'right_wheel_joint')),
    'husky': (['front_left_wheel', 'front_right_wheel', 'rear_left_wheel', 'rear_right_wheel'],
              ('rear_left_wheel', 'rear_right_wheel')),
    'ackermann': (
        ['front_left_steering_joint', 'front_right_steering_joint', 'front_left_wheel_joint',
         'front_right_wheel_joint', 'rear_left_wheel_joint', 'rear_right_wheel_joint'],
        ('rear_left_wheel_joint', 'rear_right_wheel_joint')),
    'steered behind': (
        ['rear_left_steering', 'rear_right_steering', 'rear_left_wheel', 'rear_right_wheel',
         'front_left_wheel', 'front_right_wheel'], ('front_left_wheel', 'front_right_wheel')),
    'short hands': (['FL_wheel', 'FR_wheel', 'RL_wheel', 'RR_wheel'], ('RL_wheel', 'RR_wheel')),
    'spelt apart': (['wheel_f_l', 'wheel_f_r', 'wheel_b_l', 'wheel_b_r'],
                    ('wheel_b_l', 'wheel_b_r')),
    'mobile arm': (['l_wheel', 'r_wheel', 'left_gripper_finger', 'right_gripper_finger',
                    'shoulder_pan_joint', 'elbow'], ('l_wheel', 'r_wheel')),
    'tracks': (['leftTrack', 'rightTrack', 'flipper_left', 'flipper_right'],
               ('leftTrack', 'rightTrack')),
    'one word': (['leftwheel', 'rightwheel'], ('leftwheel', 'rightwheel')),
    'unlike stems': (['left_wheel', 'right_motor_wheel'], ('left_wheel', 'right_motor_wheel')),
    'a third one': (['wheel_left', 'wheel_right', 'wheel_rear'], ('wheel_left', 'wheel_right'))}


@pytest.mark.parametrize('robot', REAL)
def test_the_wheels_of_real_robots_are_found(robot):
    names, pair = REAL[robot]
    found = select_wheels(names, len(names))
    assert (found.keys, found.sides_known) == (pair, True)
    assert pair[0] in found.explanation


def test_all_wheels_of_several_axles_are_listed_and_a_long_list_is_shortened():
    names, _ = REAL['husky']
    assert select_wheels(names, 4).explanation.endswith(
        '; for all wheels set odometer.wheels to [front_left_wheel, front_right_wheel, '
        'rear_left_wheel, rear_right_wheel]')
    assert 'and 88 more' in select_wheels([f'j{k}' for k in range(100)], 100)


@pytest.mark.parametrize(('names', 'keys'), [
    (['joint'], ('joint',)),
    (['steering_joint', 'drive_joint'], ('drive_joint',)),
    (['front_wheel', 'rear_wheel'], ('rear_wheel',)),       # the front wheel of a bicycle steers
])
def test_a_single_wheel_is_found(names, keys):
    assert select_wheels(names, len(names)).keys == keys


@pytest.mark.parametrize('names', [['a', 'b'], ['motor_1', 'motor_2', 'mast'], []])
def test_two_wheels_of_unknown_sides_are_averaged(names):
    found = select_wheels(names, len(names) or 2)
    assert found.keys == tuple(names[:2] or '01')
    assert not found.sides_known
    assert 'the mean of' in found.explanation


@pytest.mark.parametrize(('names', 'count'), [
    (['wheel_1', 'wheel_2', 'wheel_3', 'wheel_4'], 4),
    (['left_wheel_1', 'right_wheel_1', 'left_wheel_2', 'right_wheel_2'], 4),
    (['left_wheel', 'l_wheel', 'right_wheel'], 3),
    (['shoulder', 'elbow', 'wrist'], 3), (['steering'], 1), (['a', 'a'], 2), ([], 4), ([], 0)])
def test_an_ambiguous_choice_gives_an_explanation(names, count):
    assert isinstance(select_wheels(names, count), str)


def test_the_mean_of_two_wheels_of_unknown_sides_is_calibrated_and_reported():
    made = drive(scenario='straight', duration=200.0, two_wheels=True, seed=3)
    leg = made.leg()
    blind = replace(leg, form=replace(leg.form, sides_known=False,
                                      selection_text='the mean is used'))
    config = settings(made, method='auto')
    result = calibrate(blind, config)
    assert 'scale_factor_left' not in result.methods['smoother'].estimates
    assert reason_texts(result)[Code.ODOMETER_CHOSEN] == 'the mean is used'
    both = calibrate(leg, config)
    assert both.methods['smoother'].estimates['scale_factor_left'].value is not None
    # the names give the sides, but a straight path cannot confirm them
    assert reason_texts(both)[Code.ODOMETER_CHOSEN].startswith('too few turns')
    assert result.methods['two_point'].estimates['scale_factor'].value == \
        both.methods['two_point'].estimates['scale_factor'].value


def test_a_dead_wheel_of_unknown_side_is_still_found():
    made = drive(scenario='straight', duration=200.0, two_wheels=True, seed=3)
    leg = made.leg()
    dead = replace(leg.odometer_right, value=leg.odometer_right.value * 0)
    form = replace(leg.form, sides_known=False)
    result = calibrate(replace(leg, odometer_right=dead, form=form), settings(made))
    assert Code.WHEEL_DEAD in reason_texts(result)

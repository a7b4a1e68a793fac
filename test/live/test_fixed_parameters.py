# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters that the start of the node, or the node itself, alone sets: refused with a remedy."""

import math

from rclpy.parameter import Parameter

from odocal_ros.live.params import fixed, refused, RESULTS
from odocal_ros.settings.config import Config
from odocal_ros.settings.node_configs import ApplyConfig


def of(**values):
    return [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]


def test_what_is_fixed_at_start_up_is_refused_with_the_way_to_set_it():
    text = refused(Config(), RESULTS, of(odometer__type='std_msgs/msg/Int64'))
    assert text == ('odometer.type is fixed at start-up: restart the node with '
                    '"--ros-args -p odometer.type:=VALUE"')
    assert not refused(Config(), RESULTS, of(odometer__type='auto', leg__min_speed=1.0,
                                             imu__lever_arm=[0.0, 0.0, 0.0]))
    assert 'imu.lever_arm is fixed' in refused(Config(), RESULTS,
                                               of(imu__lever_arm=[0.0, 0.0, 1.0]))


def test_a_result_is_refused_unless_it_is_the_one_in_force():
    """So ``ros2 param load`` of the file that the node wrote has nothing to refuse."""
    here = RESULTS | {'result.scale_factor': 0.05}
    assert not refused(Config(), here, of(result__scale_factor=0.05,
                                          result__yaw_mounting_angle=math.nan))
    text = refused(Config(), here, of(result__scale_factor=0.06))
    assert 'result.scale_factor is set by the node' in text
    assert '--params-file calibration.yaml' in text


def test_a_node_that_reads_its_settings_at_start_up_refuses_all_of_them():
    refuse = fixed(ApplyConfig)
    for values in ({'levelling': False}, {'publish__rate': 5.0}, {'result__valid': True}):
        answer = refuse(of(**values))
        assert not answer.successful, values
        assert 'is only read at start-up: restart the node with it' in answer.reason
    assert refuse(of(use_sim_time=True, leg__min_distance=5.0)).successful

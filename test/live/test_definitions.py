# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Message classes by names that anybody on the net may have chosen."""

import sys

import pytest

pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')

from odocal_ros.errors import BadConfig
from odocal_ros.live.definitions import message_class

pytestmark = pytest.mark.core


def test_a_type_is_imported():
    assert message_class('sensor_msgs/msg/Imu').__name__ == 'Imu'


@pytest.mark.parametrize('name', [
    'antigravity/msg/X', 'this/that/X', 'evil/msg/X', 'evil/run/X', '../msg/X', 'sensor_msgs/Imu',
    'sensor_msgs/msg/imu', 'sensor_msgs/msg/_Imu', 'sensor_msgs/msg/Imu\n', '', 'sys/msg/X',
    'os.path/msg/X', 'no_msgs/msg/Such'])
def test_nothing_else_is(name, tmp_path, monkeypatch):
    (tmp_path / 'evil').mkdir()
    (tmp_path / 'evil' / '__init__.py').write_text('import sys\nsys.evil = True\n')
    (tmp_path / 'evil' / 'run.py').write_text('X = 1\n')
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    with pytest.raises(BadConfig, match='cannot be imported here'):
        message_class(name)
    assert not hasattr(sys, 'evil')
    assert not {'antigravity', 'this', 'evil'} & (set(sys.modules) - before)

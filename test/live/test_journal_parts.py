# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the journal that need no node: settings, pre-roll, message definitions."""

import json
import math
import os
import sys

import pytest
import ros_bags
import ros_messages as make

from odocal_ros.bagio.mcap_write import pack
from odocal_ros.bagio.segments import JOURNAL_FILE
from odocal_ros.errors import BadConfig
from odocal_ros.library.read_bag import journal_notes
from odocal_ros.live import journal_writer
from odocal_ros.live.journal import journal_text
from odocal_ros.live.journal_writer import PreRoll
from odocal_ros.live.messages import _msg_types, definition_of, message_class
from odocal_ros.offline.cli import main
from odocal_ros.settings.config import Config, flat, with_settings

pytestmark = pytest.mark.core
SECOND = 10**9


def test_settings_are_read_back_from_the_journal_without_any_change(tmp_path):
    config = with_settings(Config(), {
        'odometer.left': 'on', 'odometer.right': '0', 'odometer.field': 'a "b" [1e3]',
        'output.directory': '/home/jörg/a: b', 'alignment.heading': 0.1 + 0.2,
        'odometer.nominal_scale': 1e-5, 'reference.start': (48.1, 11.5, 1e-7, 2),
        'odometer.signed': False, 'journal.max_bytes': 2**40, 'output.formats': ()})
    topics = {'imu': '/car/imu', 'odometer': '/car/joint states'}
    (tmp_path / JOURNAL_FILE).write_text(journal_text(config, 3, 5, topics), encoding='utf-8')
    found = journal_notes(tmp_path)
    assert found.topics == topics
    expected = flat(config)
    assert set(found.settings) == set(expected)
    for name, value in expected.items():
        got = found.settings[name]
        assert type(got) is type(value), name
        assert got == value or math.isnan(got) and math.isnan(value), name
    assert journal_notes(tmp_path / 'some.mcap').path == found.path    # its file, too
    assert journal_notes(tmp_path.parent) is None


def chunk(k, size=100_000):
    return pack(1, [k * SECOND], [os.urandom(size)])


def test_the_preroll_keeps_its_duration_and_all_static_transforms_up_to_a_size(monkeypatch):
    preroll = PreRoll()
    preroll.feed('fix_static', journal_writer.ALWAYS_NS, chunk(0, 100), 10 * SECOND)
    for k in range(100):
        preroll.feed('imu', k * SECOND, chunk(k, 100), 10 * SECOND)
        preroll.feed('fix', (k + 500) * SECOND, chunk(k, 100), 10 * SECOND)  # another clock
    starts = [c.start_ns // SECOND for c in preroll.chunks()]
    assert starts == sorted([0, *range(89, 100), *range(89, 100)])
    assert preroll.size == sum(c.size for c in preroll.chunks())
    preroll.clear()     # time jumped back; static transforms are not sent again
    static, = preroll.chunks()
    assert preroll.size == static.size
    monkeypatch.setattr(journal_writer, 'PREROLL_BYTES', 1_050_000)
    preroll = PreRoll()
    preroll.feed('fix', SECOND, chunk(1, 100), 600 * SECOND)
    for k in range(100):
        preroll.feed('imu', k * SECOND, chunk(k), 600 * SECOND)
    assert preroll.size <= 1_050_000
    assert sum(c.size > 1000 for c in preroll.chunks()) == 10      # the largest topic is cut
    assert sum(c.size < 1000 for c in preroll.chunks()) == 1


def test_replay_uses_the_topics_of_the_journal(tmp_path, capsys):
    rows = ros_bags.drive()
    twice = [('/spare/imu', *row[1:]) for row in rows if row[0] == '/imu/data']
    bag = ros_bags.write(tmp_path / 'leg', sorted(rows + twice, key=lambda row: row[1]))
    ask = ['replay', str(bag), '--output', str(tmp_path / 'out'), '--force']
    assert main(ask) == 2
    assert '2 topics can be the IMU' in capsys.readouterr().err
    topics = {'imu': '/imu/data', 'odometer': '/odometer', 'heading': '/not/in/it'}
    (bag / JOURNAL_FILE).write_text(journal_text(Config(), 1, 1, topics))
    assert main(ask) == 1      # too short a drive, but calibrated
    assert json.loads((tmp_path / 'out' / 'calibration.json').read_text())['inputs'][0][
        'topics'] == {'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/fix'}
    assert main([*ask, '--imu-topic', '/spare/imu']) == 1
    assert json.loads((tmp_path / 'out' / 'calibration.json').read_text())['inputs'][0][
        'topics']['imu'] == '/spare/imu'


@pytest.mark.parametrize(('about', 'base', 'text'), [
    ('double', 'float64', 'float64'), ('string<10>', 'string', 'string<=10'),
    ('sequence<string<8>, 4>', 'string', 'string<=8[<=4]'), ('octet[3]', 'byte', 'byte[3]'),
    ('sequence<pkg/Type>', 'pkg/Type', 'pkg/Type[]'), ('wstring', 'wstring', 'wstring'),
    ('sequence<boolean, 2>', 'bool', 'bool[<=2]'), ('pkg/Type[2]', 'pkg/Type', 'pkg/Type[2]')])
def test_fields_are_written_as_in_a_msg_file(about, base, text):
    assert _msg_types(about) == (base, text)


@pytest.mark.parametrize('msgtype', [
    'sensor_msgs/msg/Imu', 'sensor_msgs/msg/NavSatFix', 'sensor_msgs/msg/JointState',
    'nav_msgs/msg/Odometry', 'diagnostic_msgs/msg/DiagnosticArray',
    'std_msgs/msg/Int32MultiArray', 'std_msgs/msg/UInt64', 'sensor_msgs/msg/BatteryState',
    'geometry_msgs/msg/TwistWithCovarianceStamped', 'shape_msgs/msg/SolidPrimitive'])
def test_definitions_agree_with_the_message_types(msgtype):
    pytest.importorskip('rclpy')
    from rosbags.typesys import get_types_from_msg
    found = get_types_from_msg(definition_of(message_class(msgtype)), msgtype)
    known = make.store().fielddefs
    assert msgtype in found
    for name, (_, fields) in found.items():
        # a message class has no constants, and no byte depends on them
        assert fields == known[name][1], name


@pytest.mark.parametrize('name', [
    'antigravity/msg/X', 'this/that/X', 'evil/msg/X', 'evil/run/X', '../msg/X', 'sensor_msgs/Imu',
    'sensor_msgs/msg/imu', 'sensor_msgs/msg/_Imu', 'sensor_msgs/msg/Imu\n', '', 'sys/msg/X',
    'os.path/msg/X', 'no_msgs/msg/Such'])
def test_only_modules_of_message_packages_are_imported(name, tmp_path, monkeypatch):
    (tmp_path / 'evil').mkdir()
    (tmp_path / 'evil' / '__init__.py').write_text('import sys\nsys.evil = True\n')
    (tmp_path / 'evil' / 'run.py').write_text('X = 1\n')
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    with pytest.raises(BadConfig, match='cannot be imported here'):
        message_class(name)
    assert not hasattr(sys, 'evil')
    assert not {'antigravity', 'this', 'evil'} & (set(sys.modules) - before)

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal try: it uses the likeliest topics with a reason, and its command repeats the result."""

import argparse
from dataclasses import replace
import io
import json
import re
import shlex
import webbrowser

from drives import drive
import numpy as np
import pytest
import yaml

from odocal_ros.bagio.encode import counter, fix, imu
from odocal_ros.bagio.write import write_bag
from odocal_ros.offline import replay, try_bag
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow


@pytest.fixture
def bag(tmp_path, monkeypatch):
    """Write a drive with its counter on two topics; change to its folder."""
    monkeypatch.chdir(tmp_path)
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    write_bag(tmp_path / 'bag', [imu('/imu/data', made.imu), fix('/fix', made.fix),
                                 counter('/wheel/ticks', made.odometer),
                                 counter('/odometer', made.odometer)])
    return 'bag'


@pytest.fixture
def replay_calls(monkeypatch):
    """Return the options of the replay; it only writes an empty report."""
    found = []

    def run(args):
        found.append(args)
        folder = replay.output_folder(args.output, args.bags[0], args.force)
        folder.mkdir(exist_ok=True)
        (folder / 'calibration.json').touch()
        (folder / 'report.html').touch()
        return 0
    monkeypatch.setattr(replay, 'run', run)
    return found


class Terminal(io.StringIO):
    def isatty(self):
        return True


def at_a_terminal(monkeypatch, typed):
    monkeypatch.setattr('sys.stdin', Terminal(typed))
    monkeypatch.setattr('sys.stdout.isatty', lambda: True)


def content_of(folder):
    content = json.loads((folder / 'calibration.json').read_text())
    return {key: value for key, value in content.items() if key != 'created'}


def test_the_likeliest_topic_is_used_and_the_command_gives_the_same_result(bag, tmp_path, capsys):
    assert main(['try', bag, '--no-browser']) == 0
    out = capsys.readouterr().out
    assert 'odometer: /odometer, because it has the usual name; other candidates: /wheel/ticks ' \
        '(--odometer-topic)' in ' '.join(out.split())
    assert '  IMU: /imu/data\n  fix: /fix\n' in out
    assert 'error budget' not in out
    command = out.rpartition('to repeat this calibration:\n')[2].strip()
    assert re.match(r'odocal replay bag --odometer-topic /odometer .*--force$', command)
    first = content_of(tmp_path / 'odocal_bag')
    assert main(shlex.split(command)[1:]) == 0
    assert content_of(tmp_path / 'odocal_bag') == first


def test_the_user_selects_the_topic_at_a_terminal(bag, replay_calls, monkeypatch, capsys):
    at_a_terminal(monkeypatch, 'x\n3\n2\n')
    assert main(['try', bag, '--no-browser']) == 0
    out = capsys.readouterr().out
    assert '2 candidate topics for the odometer:\n  1  /odometer  std_msgs/msg/Int64, ' in out
    assert out.count('enter a number from 1 to 2') == 2
    assert 'odometer: /wheel/ticks, because you selected it' in out
    assert replay_calls[0].odometer_topic == '/wheel/ticks'
    at_a_terminal(monkeypatch, '\n')
    assert main(['try', bag, '--no-browser', '--force']) == 0
    assert replay_calls[1].odometer_topic == '/odometer'
    at_a_terminal(monkeypatch, '')      # closed stdin
    assert main(['try', bag, '--force']) == 130


def test_options_of_the_user_are_passed_to_the_replay(bag, tmp_path, capsys):
    assert main(['try', bag, '--no-browser', '--odometer-topic', '/wheel/ticks', '--leg', '5:195',
                 '--set', 'method=two_point', '--set', 'odometer.nominal_scale=0.02',
                 '--output', 'out']) in (0, 1)
    out = capsys.readouterr().out
    command = out.rpartition('to repeat this calibration:\n')[2]
    assert '--odometer-topic /wheel/ticks' in command
    assert command.count('--leg') == 1
    assert 'because' not in out
    content = content_of(tmp_path / 'out')
    assert content['config']['odometer.nominal_scale'] == 0.02
    assert content['legs'][0]['stop'] - content['legs'][0]['start'] == pytest.approx(190, abs=0.1)
    capsys.readouterr()
    assert main(['try', bag, '--output', 'out']) == 2
    assert 'already exists; give --force' in capsys.readouterr().err


def test_the_report_opens_where_there_is_a_display(bag, replay_calls, tmp_path, monkeypatch,
                                                   capsys):
    opened = []
    monkeypatch.setattr(webbrowser, 'open', lambda url: opened.append(url) or True)
    report = tmp_path / 'odocal_bag' / 'report.html'
    for name in ('DISPLAY', 'WAYLAND_DISPLAY', 'BROWSER'):
        monkeypatch.delenv(name, raising=False)
    assert main(['try', bag]) == 0
    assert f'no browser can be started; open {report}' in capsys.readouterr().out
    monkeypatch.setenv('DISPLAY', ':0')
    assert main(['try', bag, '--force', '--no-browser']) == 0
    assert not opened
    assert main(['try', bag, '--force']) == 0
    assert opened == [report.as_uri()]


def test_a_bag_without_odometer_and_fixes_shows_its_topics(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / 'bag', [imu('/imu/data', drive(scenario='straight', duration=200.0).imu)])
    assert main(['try', 'bag']) == 2
    out, err = capsys.readouterr()
    assert 'no topic for the odometer. Record pulses, joint angles' in err
    assert 'no topic for the fixes. Record sensor_msgs/NavSatFix' in err
    assert err.count('\n') == 1
    assert '/imu/data' in out
    assert 'NO_ODOMETER' not in out       # the error states it
    assert 'no odometer' not in out


def test_a_fix_topic_without_messages_is_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = drive(scenario='straight', duration=200.0)
    none = replace(made.fix, **{name: value[:0] for name, value in vars(made.fix).items()
                                if isinstance(value, np.ndarray)})
    write_bag(tmp_path / 'bag', [imu('/imu/data', made.imu), fix('/fix', none)])
    assert main(['try', 'bag']) == 2
    assert '/fix has no messages. Check the driver and the QoS' in capsys.readouterr().err
    assert main(['inspect', 'bag']) == 0
    text = capsys.readouterr().out
    assert 'NO_FIX: /fix has no messages. Check the driver' in text
    assert 'no fix: /fix has no messages in the bag' in ' '.join(text.split())


def test_the_rate_of_equal_stamps_is_unknown(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    fixes = drive(scenario='straight', duration=200.0).fix
    stamps = fixes.stamp_ns[0] + (np.arange(len(fixes.stamp_ns)) > 500)
    write_bag(tmp_path / 'bag', [fix('/fix', replace(fixes, stamp_ns=stamps, received_ns=stamps))])
    assert main(['try', 'bag']) == 2
    line = next(row for row in capsys.readouterr().out.splitlines() if 'NavSatFix' in row)
    assert 'unknown Hz' in line
    assert main(['inspect', 'bag', '--json']) == 0
    assert json.loads(capsys.readouterr().out)['topics'][0]['rate_hz'] is None


def test_options_of_the_user_replace_the_suggested_ones():
    command = "odocal replay bag --leg 1:2 --set 'imu.mounting_rpy=[0, 0, 1]' --leg 5:9"
    for leg, settings, kept in (
            (['3:4'], [], [('--set', 'imu.mounting_rpy=[0, 0, 1]')]),
            ([], [], [('--leg', '1:2'), ('--set', 'imu.mounting_rpy=[0, 0, 1]'),
                      ('--leg', '5:9')]),
            ([], ['imu.mounting_rpy=[0,0,0]'], [('--leg', '1:2'), ('--leg', '5:9')])):
        given = argparse.Namespace(leg=leg, settings=settings)
        assert try_bag._suggested_options(command, given) == kept


@pytest.mark.parametrize('name', ['comma2k19_rav4', 'husky_parking_lot'])
def test_the_scale_of_real_drives_is_within_accept(name, data_dir, tmp_path, capsys):
    """The limits are those of the reference; canedge_car_165 is omitted: it takes 45 s."""
    assert main(['try', str(data_dir / name / 'bag'), '--no-browser', '--output',
                 str(tmp_path / 'out')]) == 0
    assert 'imu.mounting_rpy=' in capsys.readouterr().out
    truth = yaml.safe_load((data_dir / name / 'truth.yaml').read_text())
    scale = content_of(tmp_path / 'out')['result']['scale_factor']['value']
    low, high = truth['scale']['accept']
    assert low <= scale / truth['odometer']['k0_m_per_pulse'] <= high

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Output of the node: console, ``odocal watch``, and topics to plot."""

import io
import math
import os
from pathlib import Path
import subprocess
import sys
import time
from types import SimpleNamespace

from bench import PATIENCE, ROOT, wait_for
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import pytest
from std_msgs.msg import Float64, String

from odocal_ros.live import node_commands as commands
from odocal_ros.live.console import Console
from odocal_ros.live.messages import LATCHED
from odocal_ros.live.node_commands import INSTALL_REMEDIES
from odocal_ros.live.session import Session, SessionView
from odocal_ros.live.topic_input import SEARCH_PERIOD_S
from odocal_ros.live.watch import StatusListener
from odocal_ros.offline.cli import main
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config


def test_hint_and_values_are_latched_in_standard_types(start, connect):
    start({'result.scale_factor': 0.02, 'result.scale_factor_sigma': 1e-5, 'result.valid': True})
    client, received = connect(), {}
    client.until(state='waiting')
    for name, kind in (('hint', String), ('scale_factor', Float64),
                       ('scale_factor_sigma', Float64), ('yaw_mounting_angle', Float64)):
        client.node.create_subscription(
            kind, f'/calibrator/{name}',
            lambda message, name=name: received.update({name: message.data}), LATCHED)
    wait_for(lambda: len(received) == 4, 'latched values')     # for a late subscriber
    assert received['hint'] == client.status['hint']
    assert (received['scale_factor'], received['scale_factor_sigma']) == (0.02, 1e-5)
    assert math.isnan(received['yaw_mounting_angle'])


def watch(*paths, **env):
    """Run odocal watch --once with these folders first in its path."""
    return subprocess.run(
        [sys.executable, '-m', 'odocal_ros.offline.cli', 'watch', '--once'], capture_output=True,
        text=True, timeout=PATIENCE, check=False,
        env=os.environ | {'PYTHONPATH': os.pathsep.join(map(str, paths))} | env)


def test_without_rich_an_error_names_the_package_to_install(tmp_path):
    (tmp_path / 'rich.py').write_text('raise ModuleNotFoundError("no", name="rich")\n')
    ended = watch(tmp_path, ROOT)
    assert (ended.returncode, ended.stdout) == (2, '')
    assert ended.stderr == (
        f'odocal: odocal watch needs the package rich: {INSTALL_REMEDIES["rich"]}\n')


def test_the_panel_shows_a_running_node(start, connect):
    rich = pytest.importorskip('rich')
    start()
    connect().until(state='waiting')
    ended = watch(ROOT, Path(rich.__file__).parents[1], COLUMNS='120')
    assert ended.returncode == 0, ended.stderr
    for words in ('/calibrator', 'waiting', 'no IMU on /imu/data', 'standstill', 'limit 1000 ppm'):
        assert words in ended.stdout


def test_the_panel_shows_the_running_estimate_during_the_computation():
    rich = pytest.importorskip('rich.console')
    from odocal_ros.live.watch import panel
    status = {'state': 'computing', 'scale_factor': '0.03', 'scale_factor_sigma': '0.0001',
              'estimate_scale_factor': '0.02', 'estimate_scale_factor_sigma': '0.0001'}

    def shown(**values):
        console = rich.Console(width=100, record=True, file=io.StringIO())
        console.print(panel(b'\0', 'calibrator', status | values, 'computing'))
        return console.export_text()
    assert 'provisional: scale factor 0.02000 ± 0.00010' in shown()
    assert 'provisional' not in shown(state='recording')
    done = shown(state='calibrated')
    assert 'provisional' not in done
    assert 'scale factor 0.03000 ± 0.00010' in done


def test_watch_once_ends_if_there_is_no_node(monkeypatch, capsys):
    pytest.importorskip('rich')
    monkeypatch.setattr(commands, 'WAIT_S', 0.5)
    assert main(['watch', '/nobody', '--once']) == 2
    out, err = capsys.readouterr()
    assert not out
    assert 'no status on /nobody/status for 0.5 s: start the node' in err


def test_an_invalid_node_name_is_refused(capsys):
    pytest.importorskip('rich')
    assert main(['watch', 'not a name', '--once']) == 2
    assert "'not a name' is not the name of a node; ros2 node list" in capsys.readouterr().err


def test_the_bars_show_progress_relative_to_the_limits():
    pytest.importorskip('rich')
    from odocal_ros.live.watch import progress_shares
    found = progress_shares({'distance_m': '75.0', 'distance_to_minimum_m': '25.0',
                             'seconds_to_stand': '4.0',
                             'required_scale_sigma_ppm': '1000.0',
                             'predicted_scale_sigma_ppm': '4000.0',
                             'required_yaw_sigma_deg': '0.5', 'predicted_yaw_sigma_deg': ''})
    assert {name: share for name, (share, _) in found.items()} == {
        'path': 0.75, 'standstill': 0.6, 'scale': 0.25, 'yaw': 0.0}
    # after a leg the result is compared with the limits
    done = {'state': 'calibrated', 'required_scale_sigma_ppm': '1000.0', 'scale_factor': '0.02',
            'scale_factor_sigma': '0.00004', 'required_yaw_sigma_deg': '0.5',
            'yaw_mounting_angle_sigma_rad': repr(math.radians(0.25))}
    assert progress_shares(done)['scale'] == (pytest.approx(0.5), '2000 ppm, limit 1000 ppm')
    assert progress_shares(done | {'scale_factor_sigma': '0.0004'})['scale'] == (
        pytest.approx(0.05), '2 %, limit 0.1 %')
    assert progress_shares(done)['yaw'] == (1.0, '0.25 deg, limit 0.5 deg')
    assert progress_shares(done | {'state': 'recording'})['scale'] == (0.0,
                                                                       'not known, limit 1000 ppm')
    assert progress_shares({'state': 'computing', 'computing_percent': '40.0'}) == {}
    # without a leg there is no remaining distance, and '0 m to go' would be wrong
    assert 'path' not in progress_shares({'state': 'waiting', 'distance_to_minimum_m': '0.0'})


def test_control_characters_from_topics_do_not_reach_the_terminal():
    odd = 'waiting\x1b]52;c;eA==\x07\x1b]0;title\x07\u202e'
    with StatusListener('/odd') as listener:
        other = listener._node
        status = other.create_publisher(DiagnosticArray, '/odd/status', LATCHED)
        hint = other.create_publisher(String, '/odd/hint', LATCHED)
        hint.publish(String(data=odd * 100_000))
        found = iter(listener)
        status.publish(DiagnosticArray())           # without status: ignored
        listener._executor.spin_once(timeout_sec=1.0)
        status.publish(DiagnosticArray(status=[DiagnosticStatus(
            values=[KeyValue(key='state', value=odd)] * 5000)]))
        _, values, hint_text = next(found)
        assert len(hint_text) < 3000
        assert (hint_text + values['state']).isprintable()
        assert 'waiting' in hint_text


def test_each_status_is_paired_with_its_own_hint(connect):
    node = connect('/sent').node
    status = node.create_publisher(DiagnosticArray, '/sent/status', LATCHED)
    hint = node.create_publisher(String, '/sent/hint', LATCHED)

    def send(number):
        hint.publish(String(data=str(number)))
        status.publish(DiagnosticArray(status=[DiagnosticStatus(
            values=[KeyValue(key='number', value=str(number))])]))
    with StatusListener('/sent') as listener:
        send(0)
        pairs = []
        for _, values, text in listener:
            pairs.append((values['number'], text))
            if len(pairs) == 20:
                break
            send(len(pairs))
    assert pairs == [(str(k), str(k)) for k in range(20)]


SECOND = 10**9


def test_each_message_is_printed_once_or_at_growing_intervals():
    hint_text = []
    console = Console(SimpleNamespace(info=lambda x: hint_text.append(('info', x)),
                                      warning=lambda x: hint_text.append(('warning', x))))
    session = Session()

    def report(second, **known):
        before = len(hint_text)
        console.report(SessionView(session, Config(), **known), second * SECOND)
        return hint_text[before:]

    nothing = {'missing_inputs': ['no IMU on /imu/data']}
    times = [s for s in range(-20000, 280) if report(s, **nothing)]
    assert [t + 20000 for t in times[:4]] == [5, 15, 35, 75]       # 5 s, then growing intervals
    assert max(b - a for a, b in zip(times, times[1:], strict=False)) == 3600
    # another missing input is printed soon; the duration of a silence is not a change
    other = {'missing_inputs': ['no IMU on /imu/data for 3 s: 1 publisher found']}
    assert [s for s in range(280, 290) if report(s, **other)] == [285]
    assert report(290, missing_inputs=['no IMU on /imu/data for 9 s: 1 publisher found']) == []
    assert report(300, rates_hz={'imu': 100.0})[0] == (
        'info', 'ready (imu 100 Hz): stand still for 10 s, then call ~/start_leg')
    assert report(301) == []
    assert report(302, **nothing) == [('warning', 'no IMU on /imu/data')]       # immediately
    assert report(303, **nothing) == []
    assert report(304) == [('info', 'all inputs are available again')]
    two = {'duplicate_publishers': ['/ticks has 2 publishers (/a, /b)']}
    assert report(305, **two) == [('warning', two['duplicate_publishers'][0])]
    assert report(306, **two) == []
    for lost, new in ((0, False), (3, True), (29, False), (31, True), (32, False), (0, False),
                      (1, True)):       # of the next leg
        line = report(306, lost_messages={'/ticks': lost, '/imu': 0})
        assert bool(line) == new, lost
        assert all(f'{lost} message{"s" * (lost > 1)} of /ticks lost. Likely' in text
                   for _, text in line)
    gap = {'faults': (Reason(Code.IMU_GAP, 'no IMU data for 3 s'),)}
    for _ in range(2):                                   # of each leg
        session.start(1, Config())
        (level, text), = report(307, **gap)
        assert text.startswith(f'leg {session.leg_id}: IMU_GAP: no IMU data for 3 s. Fix')
        assert report(308, **gap) == []
        session.cancel()


def test_a_problem_that_later_messages_contradict_is_withdrawn_once():
    """Late messages of an IMU look like a gap; then all of them arrive."""
    hint_text, session = [], Session()
    console = Console(SimpleNamespace(info=hint_text.append, warning=hint_text.append))
    cut = (Reason(Code.LEG_CUT, 'the IMU is missing for 1.30 s'),)
    session.start(1, Config())
    for second, faults in enumerate([cut, (), (), cut, ()]):
        console.report(SessionView(session, Config(), faults=faults), second * SECOND)
    assert [x for x in hint_text if 'LEG_CUT' in x and 'no longer' not in x] == [hint_text[0]]
    assert [x for x in hint_text if 'no longer' in x] == [
        'leg 1: LEG_CUT no longer applies: later messages contradict it']
    # the end of a leg withdraws nothing
    session.cancel()
    session.start(2, Config())
    console.report(SessionView(session, Config(), faults=cut), 9 * SECOND)
    session.cancel()
    console.report(SessionView(session, Config()), 10 * SECOND)
    assert sum('no longer' in x for x in hint_text) == 1


def test_ready_without_known_rates_has_no_empty_brackets():
    hint_text = []
    Console(SimpleNamespace(info=hint_text.append)).report(SessionView(Session(), Config()),
                                                           SECOND)
    assert hint_text == ['ready: stand still for 10 s, then call ~/start_leg']


def test_similar_topics_and_duplicate_publishers_are_reported(start, connect):
    from sensor_msgs.msg import Imu
    from std_msgs.msg import Int64
    node, client = start(), connect()
    client.node.create_publisher(Imu, '/my_imu', 10)
    for _ in range(2):
        client.node.create_publisher(Int64, '/odometer', 10)
    line = wait_for(lambda: next((x for x in node.lines if 'waiting: ' in x), ''), 'a word')
    assert 'no IMU on /imu/data: 0 publishers found' in line
    assert '(did you mean /my_imu?)' in line
    named = f'/odometer has 2 publishers (/{client.node.get_name()}'
    wait_for(lambda: any(named in x for x in node.lines), 'who publishes')
    assert 'UNKNOWN' not in node.text
    assert client.call('start_leg').success is False
    wait_for(lambda: '~/start_leg refused: no leg can be started' in node.text, 'the refusal')


def test_a_publisher_with_another_type_is_reported(start, connect):
    from geometry_msgs.msg import TwistStamped
    from std_msgs.msg import Int64
    node, client, other = start(), connect(), connect()
    speed = client.node.create_publisher(TwistStamped, '/odometer', 10)
    wait_for(speed.get_subscription_count, 'the subscription')
    sent = TwistStamped()
    sent.header.stamp.sec = 1
    speed.publish(sent)
    other.node.create_publisher(Int64, '/odometer', 10)
    wait_for(lambda: client.node.count_publishers('/odometer') == 2, 'the second publisher')
    time.sleep(2 * SEARCH_PERIOD_S)
    assert 'their messages are mixed' not in node.text
    client.node.destroy_publisher(speed)
    wait_for(lambda: any('/odometer is published as std_msgs/msg/Int64; required: '
                         'geometry_msgs/msg/TwistStamped. Remap odometer, or restart the node'
                         in line for line in node.lines), 'the two types')

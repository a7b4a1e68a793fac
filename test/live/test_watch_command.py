# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One line to watch, typed topics to plot, and the panel of ``odocal watch``."""

import io
import math
import os
from pathlib import Path
import subprocess
import sys

from bench import PATIENCE, ROOT, wait_for
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import pytest
from std_msgs.msg import Float64, String

from odocal_ros.live import start as commands
from odocal_ros.live.start import NEEDS
from odocal_ros.live.status_listener import LATCHED, StatusListener
from odocal_ros.offline.cli import main

ODOCAL = [sys.executable, '-m', 'odocal_ros.offline.cli', 'watch', '--once']


def test_hint_and_values_are_latched_in_standard_types(start, connect):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    start('-p', 'result.scale_factor:=0.02', '-p', 'result.scale_factor_sigma:=0.00001', '-p',
          'result.valid:=true')
    client, received = connect(), {}
    client.until(state='waiting')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for name, kind in (('hint', String), ('scale_factor', Float64),
                       ('scale_factor_sigma', Float64), ('yaw_mounting_angle', Float64)):
        client.node.create_subscription(
            kind, f'/calibrator/{name}',
            lambda message, name=name: received.update({name: message.data}), latched)
    wait_for(lambda: len(received) == 4, 'latched values')     # to one who comes late
    assert received['hint'] == client.status['hint']
    assert (received['scale_factor'], received['scale_factor_sigma']) == (0.02, 1e-5)
    assert math.isnan(received['yaw_mounting_angle'])


def test_without_the_library_a_sentence_says_what_to_install(tmp_path):
    (tmp_path / 'rich.py').write_text('raise ModuleNotFoundError("no", name="rich")\n')
    ended = subprocess.run(ODOCAL, capture_output=True, text=True, timeout=PATIENCE, check=False,
                           env=os.environ | {'PYTHONPATH': f'{tmp_path}:{ROOT}'})
    assert (ended.returncode, ended.stdout) == (2, '')
    assert ended.stderr == f'odocal: odocal watch needs the package rich: {NEEDS["rich"]}\n'


def test_the_panel_shows_a_running_node(start, connect):
    rich = pytest.importorskip('rich')
    start()
    connect().until(state='waiting')
    paths = os.pathsep.join([str(ROOT), str(Path(rich.__file__).parents[1])])
    ended = subprocess.run(ODOCAL, capture_output=True, text=True, timeout=PATIENCE, check=False,
                           env=os.environ | {'PYTHONPATH': paths, 'COLUMNS': '120'})
    assert ended.returncode == 0, ended.stderr
    for words in ('/calibrator', 'waiting', 'no IMU on /imu/data', 'standstill', 'limit 1000 ppm'):
        assert words in ended.stdout


def test_while_a_leg_is_computed_the_panel_shows_its_running_estimate():
    rich = pytest.importorskip('rich.console')
    from odocal_ros.live.panel import panel
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


def test_once_without_a_node_ends(monkeypatch, capsys):
    pytest.importorskip('rich')
    monkeypatch.setattr(commands, 'WAIT_S', 0.5)
    assert main(['watch', '/nobody', '--once']) == 2
    out, err = capsys.readouterr()
    assert 'no status on /nobody/status yet' in out
    assert 'no status on /nobody/status for 0.5 s: start the node' in err


def test_the_bars_are_shares_of_what_is_asked():
    pytest.importorskip('rich')
    from odocal_ros.live.panel import shares
    found = shares({'distance_m': '75.0', 'metres_to_least': '25.0', 'seconds_to_stand': '4.0',
                    'asked_scale_sigma_ppm': '1000.0', 'predicted_scale_sigma_ppm': '4000.0',
                    'asked_yaw_sigma_deg': '0.5', 'predicted_yaw_sigma_deg': ''})
    assert {name: share for name, (share, _) in found.items()} == {
        'path': 0.75, 'standstill': 0.6, 'scale': 0.25, 'yaw': 0.0}
    # after a leg it is the result that is held against what is asked
    done = {'state': 'calibrated', 'asked_scale_sigma_ppm': '1000.0', 'scale_factor': '0.02',
            'scale_factor_sigma': '0.00004', 'asked_yaw_sigma_deg': '0.5',
            'yaw_mounting_angle_sigma_rad': repr(math.radians(0.25))}
    assert shares(done)['scale'] == (pytest.approx(0.5), '2000 ppm, limit 1000 ppm')
    assert shares(done)['yaw'] == (1.0, '0.25 deg, limit 0.5 deg')
    assert shares(done | {'state': 'recording'})['scale'] == (0.0, 'not known, limit 1000 ppm')
    assert shares({'state': 'computing', 'computing_percent': '40.0'}) == {}
    # without a leg no metres are missing, and '0 m to go' would be wrong
    assert 'path' not in shares({'state': 'waiting', 'metres_to_least': '0.0'})


def test_what_anybody_publishes_does_not_reach_the_terminal():
    odd = 'waiting\x1b]52;c;eA==\x07\x1b]0;title\x07\u202e'
    with StatusListener('/odd') as listener:
        other = listener._node
        status = other.create_publisher(DiagnosticArray, '/odd/status', LATCHED)
        hint = other.create_publisher(String, '/odd/hint', LATCHED)
        hint.publish(String(data=odd * 100_000))
        found = iter(listener)
        status.publish(DiagnosticArray())           # of no status: passed over
        listener._executor.spin_once(timeout_sec=1.0)
        status.publish(DiagnosticArray(status=[DiagnosticStatus(
            values=[KeyValue(key='state', value=odd)] * 5000)]))
        _, values, said = next(found)
        assert len(said) < 3000
        assert (said + values['state']).isprintable()
        assert 'waiting' in said


def test_a_status_comes_with_its_own_hint():
    import rclpy
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('sender', context=context)
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
    node.destroy_node()
    context.try_shutdown()

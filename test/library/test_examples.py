# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The examples run unchanged and print correct values."""

import json
import os
from pathlib import Path
import re
import runpy
import subprocess
import sys
import threading

import numpy as np
import pytest
import ros_bags
import ros_messages as make

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import write_bag

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
NUMBER = r'([\d.]+)'


def run(name, monkeypatch, folder, *argv):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, 'argv', [name, *map(str, argv)])
    runpy.run_path(str(EXAMPLES / name), run_name='__main__')


def test_each_example_is_run_here():
    text = Path(__file__).read_text()
    for path in EXAMPLES.iterdir():
        assert f"'{path.name}'" in text, path.name
        assert path.suffix == '.ipynb' or len(path.read_text().splitlines()) < 45


def test_calibrate_a_bag(town, tmp_path, monkeypatch, capsys):
    drive, bag = town
    run('calibrate_a_bag.py', monkeypatch, tmp_path, bag)
    out = capsys.readouterr().out
    scale, sigma = map(float, re.search(rf'scale factor {NUMBER} \+- {NUMBER}', out).groups())
    assert abs(scale - drive.truth.scale) < 4 * sigma
    assert (tmp_path / 'result' / 'calibration.json').exists()


def test_a_bag_with_other_topics_is_read_and_a_missing_one_refused(
        town, tmp_path, monkeypatch, capsys):
    drive, _ = town
    bag = write_bag(tmp_path / 'own', [
        encode.imu('/sensors/imu', drive.imu), encode.fix('/ublox/fix', drive.fix),
        encode.counter('/hall', drive.odometer)])
    run('calibrate_a_bag.py', monkeypatch, tmp_path, bag)
    assert re.search(r'scale factor .* m/pulse$', capsys.readouterr().out, re.MULTILINE)
    with pytest.raises(SystemExit, match='nowhere: no such'):
        run('calibrate_a_bag.py', monkeypatch, tmp_path, tmp_path / 'nowhere')


def test_plan_a_drive(tmp_path, monkeypatch, capsys):
    run('plan_a_drive.py', monkeypatch, tmp_path)
    lines = capsys.readouterr().out.splitlines()
    plain, rtk = (float(re.search(rf'scale {NUMBER} ppm', line).group(1)) for line in (
        lines[2], lines[3]))
    assert rtk < plain / 3
    assert lines[0].startswith('0 turns')


def test_add_message_type(town, tmp_path, monkeypatch, capsys):
    """The true speed, claimed 5 % too small: its scale is 1.05."""
    drive, _ = town
    bag = write_bag(tmp_path / 'sensors', [encode.imu('/imu/data', drive.imu),
                                           encode.fix('/fix', drive.fix)], 'sqlite3')
    stamps = drive.odometer.stamp_ns
    speed = drive.motion.at((stamps - drive.options.start_ns) * 1e-9).speed / 1.05
    kind = make.kind('geometry_msgs/msg/Vector3Stamped')
    ours = ros_bags.write(tmp_path / 'speed', [
        ('/wheel_speed', stamp, kind(header=make.header(stamp), vector=make.vector(v)))
        for stamp, v in zip(stamps.tolist(), speed.tolist(), strict=True)], 'sqlite3')
    merged = tmp_path / 'merged'
    merged.mkdir()
    for path in (*bag.glob('*.db3'), *ours.glob('*.db3')):
        path.rename(merged / path.name)
    run('add_message_type.py', monkeypatch, tmp_path, merged)
    scale, sigma = map(float, re.search(
        rf'claimed {NUMBER} \+- ([\d.e-]+)', capsys.readouterr().out).groups())
    assert abs(scale - 1.05) < 4 * sigma < 0.02


def test_custom_report(town, tmp_path, monkeypatch):
    from matplotlib.image import imread
    run('custom_report.py', monkeypatch, tmp_path, town[1], 'report.png')
    picture = imread(tmp_path / 'report.png')
    assert picture.shape[:2] == (1000, 800)
    assert 0.01 < np.mean(picture[..., :3].min(axis=-1) < 0.9) < 0.6


def test_the_notebook_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('MPLBACKEND', 'agg')
    cells = json.loads((EXAMPLES / 'first_look.ipynb').read_text())['cells']
    names: dict = {}
    shown: list = []
    for cell in cells:
        if cell['cell_type'] == 'code':
            exec(compile(''.join(cell['source']), 'first_look.ipynb', 'exec'), names)   # noqa: S102
            shown += [out.get('data', {}) for out in cell['outputs']]
            assert all(out['output_type'] != 'error' for out in cell['outputs'])
    assert any('image/png' in data for data in shown), 'outputs are missing: run the notebook'
    assert all(abs(off) < 4 for off in names['off'].values())
    assert {'trajectory.tum', 'track.kml', 'states.csv', 'result'} <= {
        p.name for p in tmp_path.iterdir()}
    assert 'ACCEPTED' in capsys.readouterr().out


def test_live_result(tmp_path):
    rclpy = pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import Float64
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('calibrator', context=context)
    for name, value in (('scale_factor', 0.0213), ('scale_factor_sigma', 2e-6)):
        node.create_publisher(Float64, f'/calibrator/{name}', latched).publish(Float64(data=value))
    listener = subprocess.Popen([sys.executable, EXAMPLES / 'live_result.py'], text=True,
                                stdout=subprocess.PIPE, cwd=tmp_path, env=os.environ)
    watchdog = threading.Timer(60.0, listener.kill)     # if no message arrives
    watchdog.start()
    try:
        assert listener.stdout.readline() == 'scale factor 0.0213 +- 2e-06\n'
    finally:
        watchdog.cancel()
        listener.kill()
        listener.communicate()
        rclpy.shutdown(context=context)

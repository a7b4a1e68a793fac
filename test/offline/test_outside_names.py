# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bag that attacks by its names: folder and frame, through the command, into every file."""

import json

import pytest
import ros_bags
import yaml

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.offline.cli import main
from odocal_ros.sim.scenarios import SimOptions, simulate

FRAME = "imu$(command 'touch ran')\x1b[2J\ntouch ran; `touch ran`"


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Write a drive whose IMU frame and folder name are commands."""
    drive = simulate(SimOptions(scenario='straight', duration=200.0, imu_grade='tactical',
                                imu_rate=50.0, odometer_rate=20.0))
    topics = [t for t in drive_topics(drive) if t.name != '/imu/data']
    return write_bag(tmp_path_factory.mktemp('evil') / 'drive\ntouch ran: \x1b[2J',
                     [encode.imu('/imu/data', drive.imu, FRAME), *topics])


def test_replay_of_a_bag_of_evil_names_writes_and_says_nothing_that_acts(
        bag, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['replay', str(bag), '--set', 'alignment.heading=0.7', '--set',
                 'output.formats=[params, autoware, transform, track, legs]']) in (0, 1)
    out, err = capsys.readouterr()
    folder, = tmp_path.iterdir()
    assert folder.name.isprintable()
    content = json.loads((folder / 'calibration.json').read_text())
    assert 'FRAME_REPLACED' in {r['code'] for r in content['reasons']}
    assert content['config']['frames.imu'] == 'imu_link'
    for text in (out, err, *(p.read_text() for p in folder.iterdir())):
        assert text.replace('\n', '').isprintable()
        assert not [x for x in text.splitlines() if x.startswith('touch')]
    result = yaml.safe_load((folder / 'calibration.yaml').read_text())
    assert list(result) == ['/**']


def test_a_topic_that_is_two_lines_is_one_of_the_list(tmp_path, capsys):
    rows = [('/a\ntouch ran\x1b[2J' if topic == '/odometer' else topic, time_ns, message)
            for topic, time_ns, message in ros_bags.drive()]
    bag = ros_bags.write(tmp_path / 'bag', rows)
    assert main(['inspect', str(bag)]) == 0
    out, _ = capsys.readouterr()
    assert out.replace('\n', '').isprintable()
    assert not [line for line in out.splitlines() if line.startswith('touch')]
    assert '/a\\ntouch ran' in out


def test_what_is_said_of_it_is_one_line(bag, tmp_path, capsys):
    for argv in (['replay', str(bag), '--imu-topic', '/no\x1b[2J'],
                 ['replay', str(bag.parent / 'no\nsuch\x1b[2J')], ['inspect', str(bag / 'x\ny')]):
        assert main(argv) == 2
        out, err = capsys.readouterr()
        assert out == ''
        assert err.count('\n') == 1
        assert err.rstrip('\n').isprintable()
    assert main(['inspect', str(bag)]) == 0
    assert capsys.readouterr().out.replace('\n', '').isprintable()


def test_a_journal_that_names_an_evil_frame_is_refused_in_one_line(bag, tmp_path, capsys):
    (bag / 'journal.yaml').write_text(
        '/**:\n  ros__parameters:\n    frames.imu: "x$(command y)"\n')
    try:
        assert main(['replay', str(bag), '--output', str(tmp_path / 'o')]) == 2
    finally:
        (bag / 'journal.yaml').unlink()
    assert 'is not a frame name' in capsys.readouterr().err

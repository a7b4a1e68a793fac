# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Internals of rosbags (0.x) that are used, and reading of standard types without it."""

from importlib.metadata import version
import inspect
import re
import subprocess
import sys

from bag_content import chunks_of
from drives import drive
import pytest
import ros_bags
from ros_bags import T0
from rosbags import rosbag1
from rosbags.rosbag1 import reader
from rosbags.rosbag2 import storage_mcap

from odocal_ros.bagio import rosbags_readers, write
from odocal_ros.bagio.encode import counter, fix, imu
from odocal_ros.bagio.write import write_bag
from odocal_ros.errors import BadBag
from odocal_ros.safe_io.limits import Allowance, LimitReached
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.scenarios import simulate

PROGRAM = ("import sys; sys.modules['rosbags'] = None\n"
           'from odocal_ros.offline.cli import main\n'
           'sys.exit(main(sys.argv[1:]))')


def test_the_installed_version_is_one_that_was_checked():
    assert re.match(r'0\.11\.', version('rosbags'))


def test_the_reader_of_rosbag1_has_the_expected_internals(tmp_path):
    assert set(reader.decompressors) == set(rosbags_readers.COMPRESSIONS)
    assert set(reader.Chunk._fields) == {'datasize', 'datapos', 'decompressor'}
    assert list(inspect.signature(rosbag1.Reader.read_index_data).parameters) == [
        'self', 'pos', 'indexes']
    path = ros_bags.write(tmp_path / 'a.bag', [
        ('/imu', T0 + i, ros_bags.make.imu(T0 + i)) for i in range(3)], 'rosbag1', 'bz2')
    taken = []

    class Counted(Allowance):
        def unpack(self, packing, data, size=None):
            taken.append(packing)
            return super().unpack(packing, data, size)
    file = rosbags_readers.Rosbag1File(path, Counted(path, 1), lambda raw, _: raw)
    assert len(list(file.messages({'/imu': 'sensor_msgs/msg/Imu'}))) == 3
    assert taken == ['bz2']
    file.close()


def test_a_rosbag1_with_a_circular_index_is_refused(tmp_path, monkeypatch):
    path = ros_bags.write(tmp_path / 'a.bag', ros_bags.drive(1.0), 'rosbag1')
    given, found = rosbag1.Reader.read_chunk_info, []

    def always_the_first(self):
        found[:] = found or [given(self)]
        return found[0]
    monkeypatch.setattr(rosbag1.Reader, 'read_chunk_info', always_the_first)
    data = bytearray(path.read_bytes())
    at = data.index(b'chunk_count=') + len(b'chunk_count=')
    data[at:at + 4] = (1000).to_bytes(4, 'little')
    path.write_bytes(data)
    with pytest.raises(BadBag, match='contains a cycle'):
        rosbags_readers.Rosbag1File(path, Allowance(path, len(data)), print)


def test_a_rosbag1_that_decompresses_beyond_the_limit_is_refused(tmp_path, monkeypatch):
    path = ros_bags.write(tmp_path / 'a.bag', ros_bags.drive(1.0), 'rosbag1')
    part = rosbags_readers.Rosbag1File(path, Allowance(path, 2**40), lambda raw, _: raw)
    part._allowance.limit = 1000
    with pytest.raises(LimitReached):
        list(part.batches({'/imu/data': 'sensor_msgs/msg/Imu'}))
    part.close()


@pytest.mark.parametrize('compression', ['none', 'storage'])
def test_the_mcap_writer_uses_our_checksums(tmp_path, compression):
    assert 'write_uint32(rec, 0)' in inspect.getsource(storage_mcap.McapWriter.close_chunk)
    drive = simulate(SimOptions(scenario='straight', duration=180.0))
    path = write.write_bag(tmp_path / 'bag', write.drive_topics(drive), 'mcap', compression)
    data = (path / 'bag.mcap').read_bytes()
    places = chunks_of(data)
    assert places
    for at, size in places:
        end = at + 9 + 28 + 4 + int.from_bytes(data[at + 37:at + 41], 'little') + 8
        records = storage_mcap.decompress(          # checks it
            data[end:at + size], 'zstd' * (compression == 'storage'),
            int.from_bytes(data[at + 25:at + 33], 'little'),
            int.from_bytes(data[at + 33:at + 37], 'little'))
        assert records
        assert data[at + 33:at + 37] != bytes(4)


def odocal(folder, *words):
    """Run the command in a process that cannot import rosbags."""
    return subprocess.run([sys.executable, '-c', PROGRAM, *words], capture_output=True, text=True,
                          cwd=folder)


@pytest.mark.slow
@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_a_bag_of_standard_types_is_calibrated(tmp_path, storage):
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    write_bag(tmp_path / 'drive', [imu('/imu/data', made.imu), fix('/fix', made.fix),
                                   counter('/odometer', made.odometer)], storage=storage)
    done = odocal(tmp_path, 'replay', 'drive', '--set', 'method=two_point', '--quiet')
    assert done.returncode in (0, 1), done.stderr
    assert (tmp_path / 'odocal_drive' / 'calibration.json').exists()


@pytest.mark.slow
def test_commands_that_need_rosbags_report_it(tmp_path):
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    write_bag(tmp_path / 'drive.bag', [imu('/imu/data', made.imu)], storage='rosbag1')
    for words in (['inspect', 'drive.bag'], [
            'simulate', '--scenario', 'straight', '--out', 'new']):
        done = odocal(tmp_path, *words)
        assert done.returncode == 2, done.stderr
        assert 'needs the Python package rosbags, which is not installed: pip install rosbags' in (
            done.stderr)
        assert done.stderr.count('\n') == 1

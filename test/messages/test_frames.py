# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Several IMUs on one topic, distinguished by their frame_id."""

from dataclasses import replace
import re

from drives import drive, settings
import numpy as np
import pytest
import ros_messages as make

from odocal_ros.bagio.encode import imu
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.data.samples import columns_of, join
from odocal_ros.library.calibrate_bag import calibrate_bag
from odocal_ros.messages.decode import make_reader
from odocal_ros.messages.sensor_types import IMU
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core


def read(frames, pieces=(), wanted='', little_endian=True):
    """Return the rows by slot of messages of some frames, read in pieces; and the reader."""
    raws = [make.cdr(make.imu(10**9 + k, frame=frame), little_endian)
            for k, frame in enumerate(frames)]
    reader = make_reader('imu', IMU, with_settings(Config(), {'imu.frame_id': wanted}))
    found = {}
    edges = [0, *pieces, len(raws)]
    for a, b in zip(edges, edges[1:], strict=False):
        for slot, block in reader.rows(raws[a:b], list(range(a, b)), make.deserializer(IMU)):
            found.setdefault(slot, []).append(block)
    return {slot: join(blocks) for slot, blocks in found.items()}, reader


@pytest.mark.parametrize('little_endian', [True, False])
def test_one_frame_is_used_however_the_stream_is_chopped(little_endian):
    frames = ['front', 'rear_imu'] * 10
    whole, reader = read(frames, little_endian=little_endian)
    assert reader.frame == 'front'
    assert whole['imu'].received_ns.tolist() == [0, 1, 2, 3, *range(4, 20, 2)]
    assert whole['imu_other'].received_ns.tolist() == [*range(5, 20, 2)]
    assert set(whole['imu_other'].frame.tolist()) == {b'rear_imu'}
    assert set(whole['imu_other'].used.tolist()) == {b'front'}
    if little_endian:
        assert whole['imu_other'].stamp_ns.tolist() == [10**9 + k for k in range(5, 20, 2)]
    for pieces in ([1], [2, 5, 7], range(1, 20)):
        found, _ = read(frames, pieces, little_endian=little_endian)
        assert found.keys() == whole.keys()
        for slot in whole:
            for one, other in zip(columns_of(found[slot]), columns_of(whole[slot]), strict=True):
                assert one.tobytes() == other.tobytes()


def test_a_damaged_frame_decides_nothing_and_one_that_is_set_is_used_at_once():
    found, reader = read(['x\x07', *['front'] * 9])
    assert reader.frame == 'front'
    assert found.keys() == {'imu'}
    found, _ = read(['front', 'rear'] * 5, wanted='rear')
    assert found['imu'].received_ns.tolist() == [1, 3, 5, 7, 9]
    assert len(found['imu_other'].stamp_ns) == 5


def mixed(made, every):
    """Return the topics of a drive whose IMU topic has a second IMU, yawed by 20 deg."""
    C = matrix_from_rpy((0.0, 0.0, np.deg2rad(20.0)))
    rear = np.arange(len(made.imu.stamp_ns)) % every == 0
    turned = replace(made.imu, w_i=np.where(rear[:, None], made.imu.w_i @ C, made.imu.w_i),
                     f_i=np.where(rear[:, None], made.imu.f_i @ C, made.imu.f_i))
    topic = imu('/imu/data', turned, frame='imu_a')

    def pack(rows):
        out = topic.pack(rows)
        out.view('u1').reshape(len(out), -1)[rear[rows], 16 + 4] = ord('b')
        return out
    return [replace(topic, pack=pack), *drive_topics(made)[1:]]


@pytest.fixture(scope='module')
def made():
    return drive(scenario='town', duration=300.0, imu_grade='industrial', seed=3)


def said(made, topics, path, **more):
    write_bag(path, topics)
    result = calibrate_bag(path, config=with_settings(settings(made), more))
    return result, {r.code: r for r in result.reasons}


def test_two_imus_on_one_topic_reject_the_leg_and_the_setting_chooses_one(made, tmp_path):
    result, reasons = said(made, mixed(made, 2), tmp_path / 'bag')
    assert result.verdict.value == 'rejected'
    used, other = map(int, re.findall(r"(\d+) (?:messages )?of 'imu_[ab]'",
                                      reasons[Code.SEVERAL_IMUS].text))
    assert used == pytest.approx(other, abs=5)
    assert "imu.frame_id: 'imu_b'" in reasons[Code.SEVERAL_IMUS].do

    chosen, reasons = said(made, mixed(made, 2), tmp_path / 'a', **{'imu.frame_id': 'imu_a'})
    assert Code.SEVERAL_IMUS not in reasons
    name = 'yaw_mounting_angle'
    assert abs(chosen.values[name] - made.truth.yaw) < 4 * chosen.sigmas[name]

    _, reasons = said(made, mixed(made, 2), tmp_path / 'none', **{'imu.frame_id': 'imu_c'})
    assert "'imu_c' of imu.frame_id" in reasons[Code.NO_IMU].text


def test_a_few_messages_of_another_frame_are_dropped(made, tmp_path):
    _, reasons = said(made, mixed(made, 500), tmp_path / 'bag')
    assert Code.SEVERAL_IMUS not in reasons
    assert "have another frame_id than 'imu_a'" in reasons[Code.BAD_ROWS_DROPPED].text

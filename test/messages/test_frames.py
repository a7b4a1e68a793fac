# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Several IMUs on one topic by their frame_id; positions in a local frame as geodetic fixes."""

from dataclasses import replace
import math
import re

from drives import settings
import numpy as np
from pyproj import Transformer
import pytest
import ros_messages as make

from odocal_ros.bagio.encode import imu
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.data.samples import columns_of, join, LOCAL_STATUS
from odocal_ros.errors import BadData
from odocal_ros.library.calibrate_bag import calibrate_bag
from odocal_ros.messages.decode import make_reader
from odocal_ros.messages.message_fields import IMU
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import FRAME_LONGITUDE, geodetic_from_local, LARGEST_FRAME
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.reasons import Code
from odocal_ros.screening.fix_screen import covariances, has_position
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
TENTH_MM = 1e-4
MADE = {'scenario': 'town', 'duration': 300.0, 'imu_grade': 'industrial', 'seed': 3}


def read(frames, pieces=(), frame_id='', little_endian=True):
    """Return the rows by slot of messages of some frames, read in pieces; and the reader."""
    raws = [make.cdr(make.imu(10**9 + k, frame=frame), little_endian)
            for k, frame in enumerate(frames)]
    reader = make_reader('imu', IMU, with_settings(Config(), {'imu.frame_id': frame_id}))
    found = {}
    edges = [0, *pieces, len(raws)]
    for a, b in zip(edges, edges[1:], strict=False):
        for slot, block in reader.rows(raws[a:b], list(range(a, b)), make.deserializer(IMU)):
            found.setdefault(slot, []).append(block)
    return {slot: join(blocks) for slot, blocks in found.items()}, reader


@pytest.mark.parametrize('little_endian', [True, False])
def test_one_frame_is_used_for_any_division_into_blocks(little_endian):
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


def test_a_damaged_frame_is_ignored_and_a_configured_frame_is_used():
    found, reader = read(['x\x07', *['front'] * 9])
    assert reader.frame == 'front'
    assert found.keys() == {'imu'}
    found, _ = read(['front', 'rear'] * 5, frame_id='rear')
    assert found['imu'].received_ns.tolist() == [1, 3, 5, 7, 9]
    assert len(found['imu_other'].stamp_ns) == 5


@pytest.mark.parametrize(('frames', 'frame_id'), [
    (['imu', '/imu'], ''), (['/imu', 'imu'], ''), (['imu', '/imu'], 'imu'),
    (['imu', '/imu'], '/imu')])
def test_a_leading_slash_does_not_make_another_frame(frames, frame_id):
    found, reader = read(np.repeat(frames, 10).tolist(), frame_id=frame_id)
    assert found.keys() == {'imu'}
    assert len(found['imu'].stamp_ns) == 20
    assert reader.frame == (frame_id or frames[0])


def mixed(made, every):
    """Return the topics of a drive whose IMU topic has a second IMU, yawed by 20 deg."""
    C = matrix_from_rpy((0.0, 0.0, np.deg2rad(20.0)))
    rear = np.arange(len(made.imu.stamp_ns)) % every == 0
    turned = {name: np.where(rear[:, None], getattr(made.imu, name) @ C, getattr(made.imu, name))
              for name in ('w_i', 'f_i')}
    topic = imu('/imu/data', replace(made.imu, **turned), frame='imu_a')

    def pack(rows):
        out = topic.pack(rows)
        out.view('u1').reshape(len(out), -1)[rear[rows], 16 + 4] = ord('b')
        return out
    return [replace(topic, pack=pack), *drive_topics(made)[1:]]


def found_reasons(made, topics, path, **more):
    write_bag(path, topics)
    result = calibrate_bag(path, config=with_settings(settings(made), more))
    return result, {r.code: r for r in result.reasons}


def test_two_imus_on_one_topic_reject_the_leg_and_the_setting_chooses_one(made, tmp_path):
    result, reasons = found_reasons(made, mixed(made, 2), tmp_path / 'bag')
    assert result.verdict.value == 'rejected'
    used, other = map(int, re.findall(r"(\d+) (?:messages )?of 'imu_[ab]'",
                                      reasons[Code.SEVERAL_IMUS].text))
    assert used == pytest.approx(other, abs=5)
    assert "imu.frame_id: 'imu_b'" in reasons[Code.SEVERAL_IMUS].special_remedy

    chosen, reasons = found_reasons(made, mixed(made, 2), tmp_path / 'a',
                                    **{'imu.frame_id': 'imu_a'})
    assert Code.SEVERAL_IMUS not in reasons
    name = 'yaw_mounting_angle'
    assert abs(chosen.values[name] - made.truth.yaw) < 4 * chosen.sigmas[name]

    _, reasons = found_reasons(made, mixed(made, 2), tmp_path / 'none',
                               **{'imu.frame_id': 'imu_c'})
    assert "'imu_c' of imu.frame_id" in reasons[Code.NO_IMU].text


def test_a_few_messages_of_another_frame_are_dropped(made, tmp_path):
    _, reasons = found_reasons(made, mixed(made, 500), tmp_path / 'bag')
    assert Code.SEVERAL_IMUS not in reasons
    assert "have another frame_id than 'imu_a'" in reasons[Code.BAD_ROWS_DROPPED].text


def fixes_of(messages, **settings):
    msgtype = messages[0].__msgtype__
    config = with_settings(Config(), {k.replace('__', '.'): v for k, v in settings.items()})
    reader = make_reader('fix', msgtype, config)
    (slot, block), = reader.rows([make.cdr(m) for m in messages], range(1, len(messages) + 1),
                                 make.deserializer(msgtype))
    assert slot == 'fix'
    return block


def local(block):
    """Return the positions of fixes in the frame that they were sent in."""
    geodetic = np.stack([block.latitude, block.longitude, block.height], -1)
    return Origin(math.radians(45.0), FRAME_LONGITUDE, 0.0).to_n(geodetic)


def places(reach, n=200):
    """Return positions up to a distance, at all heights of a building or a hill: (n, 3) m."""
    rng = np.random.default_rng(3)
    size = [reach / 1.5, reach / 1.5, 200.0]
    return np.vstack([[0.0, 0.0, 1.0], rng.uniform(-1, 1, (n, 3)) * size])


@pytest.mark.parametrize('latitude_deg', [-85.0, -33.0, 0.0, 48.0, 85.0])
def test_a_local_frame_is_a_tangent_plane_as_in_proj(latitude_deg):
    position = places(10_000.0)
    lat, lon, height = geodetic_from_local(position, latitude_deg)
    local = Transformer.from_pipeline(
        '+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 '
        f'+lat_0={latitude_deg} +lon_0={math.degrees(FRAME_LONGITUDE)} +h_0=0')
    back = np.stack(local.transform(np.degrees(lon), np.degrees(lat), height), -1)
    assert np.abs(back - position).max() < TENTH_MM


def test_a_z_of_zero_is_not_a_height():
    """2D SLAM and AMCL do not measure it."""
    _, _, height = geodetic_from_local(np.array([[3.0, 4.0, 0.0], [3.0, 4.0, 1e-3]]), math.nan)
    assert np.isnan(height[0])
    assert height[1] == pytest.approx(1e-3, abs=1e-5)    # 5 m from the origin: 2 um above it


def test_a_local_frame_at_the_equator_gives_positions():
    """Latitude 0 and longitude 0 together would mean 'no position'."""
    block = fixes_of([make.pose(1, (0.0, 0.0, 0.0))], reference__latitude_deg=0.0)
    assert has_position(block).all()


@pytest.mark.parametrize('message', [
    make.pose(5 * 10**9, (3.0, -4.0, 1.5)), make.point(5 * 10**9, (3.0, -4.0, 1.5)),
    make.transform(5 * 10**9, (3.0, -4.0, 1.5)),
    make.pose_covariance(5 * 10**9, (3.0, -4.0, 1.5), np.zeros((6, 6)))],
    ids=lambda m: m.__msgtype__.rpartition('/')[2])
def test_each_type_gives_its_position_and_no_covariance(message):
    block = fixes_of([message])
    np.testing.assert_allclose(local(block), [[3.0, -4.0, 1.5]], atol=TENTH_MM)
    assert block.stamp_ns.tolist() == [5 * 10**9]
    assert block.status.tolist() == [LOCAL_STATUS]
    covariance, unknown = covariances(block, 2.5)
    assert unknown.all()
    assert covariance[0, 0, 0] == 2.5**2


def test_the_covariance_is_the_position_block_of_the_message():
    whole = np.diag([0.04, 0.09, 0.25, 7.0, 8.0, 9.0])
    whole[0, 1] = whole[1, 0] = 0.01
    block = fixes_of([make.pose_covariance(1, (1, 2, 3), whole)])
    covariance, unknown = covariances(block, 2.5)
    assert not unknown.any()
    np.testing.assert_array_equal(covariance[0], whole[:3, :3])


def test_an_odometry_message_as_reference_gives_its_pose():
    block = fixes_of([make.odometry(1, 9.0)])                   # its covariance is 0, 1, 2 .. 35
    assert block.covariance_n[0].tolist() == [[0, 1, 2], [6, 7, 8], [12, 13, 14]]
    np.testing.assert_allclose(local(block), [[1.0, 2.0, 3.0]], atol=TENTH_MM)


def test_map_coordinates_and_nan_are_not_positions():
    far = (LARGEST_FRAME + 1.0, 0.0, 0.0)
    block = fixes_of([make.pose(1, (500_000.0, 5_300_000.0, 300.0)), make.pose(2, far),
                      make.pose(3, (math.nan, 0.0, 0.0)), make.pose(4, (1.0, 2.0, 3.0))])
    assert has_position(block).tolist() == [False, False, False, True]


def test_other_types_are_refused_with_the_supported_types():
    with pytest.raises(BadData, match='sensor_msgs/msg/NavSatFix or gps_msgs/msg/GPSFix or '
                       'gps_common/msg/GPSFix or geometry_msgs/msg/PoseStamped'):
        make_reader('fix', 'sensor_msgs/msg/Imu', Config())

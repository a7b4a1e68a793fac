# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Positions in a local frame: as geodetic fixes they are at the same distances, to 0.1 mm."""

import math

import numpy as np
from pyproj import Transformer
import pytest
import ros_messages as make

from odocal_ros.data.samples import LOCAL
from odocal_ros.errors import BadData
from odocal_ros.messages.decode import make_reader
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.local_frame import FRAME_LONGITUDE, geodetic_of, LARGEST_FRAME
from odocal_ros.screening.fix_screen import covariances, placed
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
TENTH_MM = 1e-4


def read(messages, **settings):
    """Return the fixes of messages of one type."""
    msgtype = messages[0].__msgtype__
    config = with_settings(Config(), {k.replace('__', '.'): v for k, v in settings.items()})
    reader = make_reader('fix', msgtype, config)
    (slot, block), = reader.rows([make.cdr(m) for m in messages], range(1, len(messages) + 1),
                                 make.deserializer(msgtype))
    assert slot == 'fix'
    return block


def places(reach, n=200):
    """Return positions up to a distance, at all heights of a building or a hill: (n, 3) m."""
    rng = np.random.default_rng(3)
    return np.vstack([np.zeros(3), rng.uniform(-1, 1, (n, 3)) * [reach / 1.5, reach / 1.5, 200.0]])


@pytest.mark.parametrize('latitude_deg', [-85.0, -33.0, 0.0, 48.0, 85.0])
def test_a_local_frame_is_a_tangent_plane_as_proj_has_it(latitude_deg):
    position = places(10_000.0)
    lat, lon, height = geodetic_of(position, latitude_deg)
    local = Transformer.from_pipeline(
        '+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 '
        f'+lat_0={latitude_deg} +lon_0={math.degrees(FRAME_LONGITUDE)} +h_0=0')
    back = np.stack(local.transform(np.degrees(lon), np.degrees(lat), height), -1)
    assert np.abs(back - position).max() < TENTH_MM


@pytest.mark.parametrize('latitude_deg', [-33.0, 0.0, 48.0])
def test_the_core_sees_every_distance_as_the_frame_has_it(latitude_deg):
    position = places(10_000.0)
    geodetic = np.stack(geodetic_of(position, latitude_deg), -1)
    position_n = Origin(*geodetic[7]).to_n(geodetic)       # the core's frame has another origin
    for row in (0, 5, 9):
        own, core = (np.linalg.norm(p - p[row], axis=1) for p in (position, position_n))
        assert np.abs(core - own).max() < TENTH_MM


def test_a_frame_at_the_equator_has_an_origin_too():
    """There latitude and longitude zero would mean 'no position'."""
    block = read([make.pose(1, (0.0, 0.0, 0.0))], reference__latitude_deg=0.0)
    assert placed(block).all()


@pytest.mark.parametrize('message', [
    make.pose(5 * 10**9, (3.0, -4.0, 1.5)), make.point(5 * 10**9, (3.0, -4.0, 1.5)),
    make.transform(5 * 10**9, (3.0, -4.0, 1.5)),
    make.pose_covariance(5 * 10**9, (3.0, -4.0, 1.5), np.zeros((6, 6)))],
    ids=lambda m: m.__msgtype__.rpartition('/')[2])
def test_each_type_gives_its_position_and_no_covariance(message):
    block = read([message])
    origin = Origin(math.radians(45.0), FRAME_LONGITUDE, 0.0)
    geodetic = np.stack([block.latitude, block.longitude, block.height], -1)
    np.testing.assert_allclose(origin.to_n(geodetic), [[3.0, -4.0, 1.5]], atol=TENTH_MM)
    assert block.stamp_ns.tolist() == [5 * 10**9]
    assert block.status.tolist() == [LOCAL]
    covariance, unknown = covariances(block, 2.5)
    assert unknown.all()
    assert covariance[0, 0, 0] == 2.5**2


def test_a_stated_covariance_is_the_block_of_the_position():
    whole = np.diag([0.04, 0.09, 0.25, 7.0, 8.0, 9.0])
    whole[0, 1] = whole[1, 0] = 0.01
    block = read([make.pose_covariance(1, (1, 2, 3), whole)])
    covariance, unknown = covariances(block, 2.5)
    assert not unknown.any()
    np.testing.assert_array_equal(covariance[0], whole[:3, :3])


def test_an_odometry_as_reference_is_its_pose():
    block = read([make.odometry(1, 9.0)])                   # its covariance is 0, 1, 2 .. 35
    assert block.covariance_n[0].tolist() == [[0, 1, 2], [6, 7, 8], [12, 13, 14]]
    geodetic = np.stack([block.latitude, block.longitude, block.height], -1)
    place = Origin(math.radians(45.0), FRAME_LONGITUDE, 0.0).to_n(geodetic)
    np.testing.assert_allclose(place, [[1.0, 2.0, 3.0]], atol=TENTH_MM)


def test_map_coordinates_and_nan_are_no_positions():
    far = (LARGEST_FRAME + 1.0, 0.0, 0.0)
    block = read([make.pose(1, (500_000.0, 5_300_000.0, 300.0)), make.pose(2, far),
                  make.pose(3, (math.nan, 0.0, 0.0)), make.pose(4, (1.0, 2.0, 3.0))])
    assert placed(block).tolist() == [False, False, False, True]


def test_other_types_are_refused_with_those_that_serve():
    with pytest.raises(BadData, match='sensor_msgs/msg/NavSatFix or geometry_msgs/msg/PoseSt'):
        make_reader('fix', 'sensor_msgs/msg/Imu', Config())

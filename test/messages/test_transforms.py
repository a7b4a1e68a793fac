# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""TF as a reference: chains agree with scipy, and blocks do not change the result."""

import numpy as np
import pytest
import ros_bags
import ros_messages as make
from scipy.spatial.transform import Rotation, Slerp

from odocal_ros.bagio.read import open_bag
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadData
from odocal_ros.messages.decode import make_reader
from odocal_ros.messages.transforms import add_static_readers
from odocal_ros.nav.geodesy import geodetic_from_local
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
TF = 'tf2_msgs/msg/TFMessage'
DESERIALIZE = make.deserializer(TF)
NS = 10**9
ARM = (0.2, -0.1, 0.3)
# a robot on a floor with ramps; SLAM corrects five times a second, by a jump of 0.1 rad
T_MAP, T_ODOM = np.arange(40) / 5, np.arange(0.003, 7.9, 0.02)


def corrections(t):
    return (np.stack([0.1 * t, np.sin(t), 0 * t], -1),
            Rotation.from_euler('ZY', np.stack([0.5 + 0.1 * (t > 4), 0.01 * t], -1)))


def driven(t):
    return (np.stack([2 * np.cos(0.8 * t), 2 * np.sin(0.8 * t), 0.02 * t], -1),
            Rotation.from_euler('ZX', np.stack([0.8 * t + np.pi / 2, 0.05 * np.sin(t)], -1)))


def one(t, place, turn, child, frame, sign=1):
    """Return a geometry_msgs/TransformStamped; q and -q are the same rotation."""
    out = make.transform(round(t * NS), place, child, frame)
    for axis, value in zip('xyzw', sign * turn.as_quat(), strict=True):
        setattr(out.transform.rotation, axis, float(value))
    return out


def message(*transforms):
    return make.kind(TF)(transforms=list(transforms))


def raws(*series):
    """Return (arrival ns, message) of series of transforms, merged by arrival."""
    found = []
    for t, of, child, frame in series:
        place, turn = of(t)
        found += [(round(x * NS) + 10**6, message(one(
            x, p, q, child, frame, (-1)**k if child == 'base_link' else 1)))
                  for k, (x, p, q) in enumerate(zip(t, place, turn, strict=True))]
    return sorted(found, key=lambda pair: pair[0])


BY_SLAM, BY_WHEELS = (corrections, 'odom', 'map'), (driven, 'base_link', 'odom')
MOVING = raws((T_MAP, *BY_SLAM), (T_ODOM, *BY_WHEELS))
SLOW = raws((T_ODOM, *BY_SLAM), (T_MAP, *BY_WHEELS))
THREE = raws((T_ODOM, *BY_SLAM), (T_MAP, *BY_WHEELS), (T_MAP + 0.07, driven, 'prism', 'base_link'))
STATIC = message(one(0.0, ARM, Rotation.from_euler('Z', 1.0), 'prism', 'base_link'))


def reader(**settings):
    return make_reader('fix', TF, with_settings(Config(), {
        'reference.frames': ['map', 'prism']} | settings))


def read(source, moving=MOVING, static=STATIC, block=10**9, static_after=0, **cdr):
    """Return stamps, arrivals and geodetic positions, of blocks; static after so many blocks."""
    recorder = LegRecorder()
    blocks = [moving[k:k + block] for k in range(0, len(moving), block)]
    for k, some in enumerate([*blocks, []]):
        pairs = []
        if k == static_after and static is not None:
            pairs += source.static.rows([make.cdr(static)], [1], DESERIALIZE)
        pairs += source.rows([make.cdr(m, **cdr) for _, m in some], [at for at, _ in some],
                             DESERIALIZE)
        for slot, rows in pairs:
            recorder.feed(slot, rows)
    rows = recorder.rows('fix')
    return np.stack([rows.stamp_ns, rows.received_ns]), np.stack(
        [rows.latitude, rows.longitude, rows.height])


def expected(t):
    """Return the chain by scipy: positions of base_link interpolated linearly, rotations slerp."""
    place, turn = driven(T_ODOM)
    place = np.stack([np.interp(t, T_ODOM, column) for column in place.T], -1)
    place = place + Slerp(T_ODOM, turn)(t).apply(ARM)
    shift, rotation = corrections(t)
    return rotation.apply(place) + shift


def test_a_chain_of_transforms_agrees_with_scipy():
    stamps, places = read(reader())
    t = stamps[0] / NS
    inside = T_MAP[1:]      # the first may be old
    assert t == pytest.approx(inside, abs=1e-9)
    # the positions of an arm of 0.37 m; the rotation between two transforms is 0.016 rad
    off = np.abs(places - np.stack(geodetic_from_local(expected(inside), np.nan)))
    assert off[2].max() < 1e-7
    assert off[:2].max() < 1e-14
    assert (stamps[1] - stamps[0] == 10**6).all()       # the arrival of the correction


@pytest.mark.parametrize('block', [1, 7, 100])
@pytest.mark.parametrize('static_after', [0, 3])
@pytest.mark.parametrize('moving', [MOVING, SLOW, THREE], ids=['fast', 'slow', 'three'])
def test_blocks_and_late_static_transforms_change_no_position(block, static_after, moving):
    plain = read(reader(), moving)
    others = read(reader(), moving, block=block, static_after=static_after)
    for a, b in zip(plain, others, strict=True):
        assert a.tobytes() == b.tobytes()


def test_other_encodings_give_the_same_bits():
    slashed = [(at, message(*(one(x.header.stamp.sec + x.header.stamp.nanosec / NS, (
        x.transform.translation.x, x.transform.translation.y, x.transform.translation.z),
        Rotation.from_quat([getattr(x.transform.rotation, a) for a in 'xyzw']),
        '/' + x.child_frame_id, '/' + x.header.frame_id) for x in m.transforms)))
        for at, m in MOVING[:60]]
    plain = read(reader(), MOVING[:60])
    assert len(plain[0][0]) > 3
    assert plain[1].tobytes() == read(reader(), MOVING[:60], little_endian=False)[1].tobytes()
    assert plain[1] == pytest.approx(read(reader(), slashed)[1], abs=1e-9)


def test_gaps_give_no_positions_and_repetitions_no_duplicates():
    gap = [(at, m) for at, m in MOVING if m.transforms[0].child_frame_id != 'base_link'
           or not 2 * NS < at < 3 * NS]
    again = [pair for pair in gap for _ in range(2)]
    t = read(reader(), again)[0][0] / NS
    assert len(t) == len(set(t))
    assert not ((t > 2.01) & (t < 2.99)).any()
    assert {1.8, 3.2} <= set(t.round(1))


def test_a_repeated_correction_gives_no_position():
    """SLAM repeats its last correction while odometry moves the robot."""
    held = raws((T_MAP, *BY_SLAM), (T_ODOM, *BY_WHEELS), *(
        (T_MAP + later, lambda t: corrections(T_MAP), 'odom', 'map') for later in (0.05, 0.15)))
    t = read(reader(), held)[0][0] / NS
    assert t == pytest.approx(read(reader())[0][0] / NS)
    still = raws((T_MAP, lambda t: corrections(0 * t), 'odom', 'map'), (T_ODOM, *BY_WHEELS))
    source = reader()
    assert not len(read(source, still)[0][0])
    assert 'without corrections the positions are odometry alone' in source.error


def test_a_recording_that_starts_again_is_read_to_its_end():
    at_once = read(reader())
    for block in (13, 10**9):
        twice = read(reader(), MOVING + MOVING, block=block)
        for a, b in zip(at_once, twice, strict=True):
            assert np.hstack([a, a]).tobytes() == b.tobytes()


@pytest.mark.parametrize(('frames', 'static', 'message_'), [
    (['map', 'prism'], None, "no transform from map to prism: 'prism' has no parent frame (frames "
     "received: 'base_link', 'map', 'odom'); set reference.frames"),
    (['world', 'prism'], STATIC, "no transform from world to prism: 'map' has no parent frame"),
    (['base_link', 'prism'], STATIC, 'all transforms from base_link to prism are static')])
def test_the_reason_for_missing_positions_is_reported(frames, static, message_):
    source = reader(**{'reference.frames': frames})
    read(source, MOVING[:50], static)
    assert source.unreadable == 50
    assert message_ in source.error


def test_a_block_may_exceed_the_number_of_waiting_transforms(monkeypatch):
    monkeypatch.setattr('odocal_ros.nav.frame_chain.MAX_WAITING', 25)
    assert read(reader())[1].tobytes() == read(reader(), block=1)[1].tobytes()
    assert len(read(reader())[0][0]) == len(T_MAP) - 1
    # the oldest are dropped while the static transform is missing
    assert 1 < len(read(reader(), block=100, static_after=3)[0][0]) < len(T_MAP) - 1


def test_damaged_messages_are_counted_and_random_bytes_raise_nothing():
    source = reader()
    whole = [make.cdr(m) for _, m in MOVING[:100]]
    rng = np.random.default_rng(4)
    cut = [raw[:int(k)] for raw, k in zip(whole, rng.integers(0, 90, 100), strict=True)]
    noise = [b'\0\1\0\0' + rng.bytes(int(k)) for k in rng.integers(0, 200, 200)]
    source.static.rows([make.cdr(STATIC)], [1], DESERIALIZE)
    assert source.rows(whole, range(100), DESERIALIZE)
    source.rows(cut + noise, range(300), DESERIALIZE)
    assert 250 < source.unreadable <= 300
    assert source.error == 'damaged messages'


def test_both_tf_topics_of_a_bag_are_read(tmp_path):
    path = ros_bags.write(tmp_path / 'bag', [
        *(('/tf', at, m) for at, m in MOVING[:200]), ('/tf_static', 2 * NS, STATIC)])
    recorder, source = LegRecorder(), reader()
    with open_bag(path) as bag:
        bag.read(add_static_readers({'/tf': source}, bag.topics), recorder.feed)
        assert recorder.rows('fix').latitude.tobytes() == read(
            reader(), MOVING[:200])[1][0].tobytes()
        with pytest.raises(BadData, match='/tf: none of its 200 messages can be used: no transfo'):
            bag.read({'/tf': reader()}, recorder.feed)

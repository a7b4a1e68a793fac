# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bag that grows by closed files: its content for readers whenever its writer stops."""

from contextlib import suppress
from itertools import count
import struct
import zlib

from disk_errors import Refusing
import pytest
import ros_bags
import ros_messages as make
from rosbags import rosbag2

from odocal_ros.bagio import mcap_write, segments
from odocal_ros.bagio.bag_file import Channel
from odocal_ros.bagio.mcap_records import CHUNK_HEAD, text_at
from odocal_ros.bagio.mcap_write import pack, read_chunks, write_file
from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.segments import joined_name, JOURNAL_FILE, part_name, SegmentedBag
from odocal_ros.errors import BadBag
from odocal_ros.safe_io.atomic_files import PART

pytestmark = pytest.mark.core
T0 = ros_bags.T0
CHANNELS = {
    1: Channel('/imu/data', 'sensor_msgs/msg/Imu'), 2: Channel('/odometer', 'std_msgs/msg/Int64')}


def second(k, rate=20):
    """Return the chunks of second k and their messages; two of each three times are equal."""
    times = [T0 + k * 10**9 + i // 3 * 3 * 10**9 // rate for i in range(rate)]
    imu = [make.cdr(make.imu(t, w=(k, i, 0))) for i, t in enumerate(times)]
    counts = [make.cdr(make.whole(k * rate + i)) for i in range(rate)]
    messages = {'/imu/data': list(zip(times, imu, strict=True)),
                '/odometer': list(zip(times, counts, strict=True))}
    return [pack(1, times, imu), pack(2, times, counts)], messages


def grown(folder, number):
    """Return a bag of so many segments, not finished, and its messages by topic."""
    folder.mkdir(parents=True)
    (folder / JOURNAL_FILE).touch()
    bag, messages = SegmentedBag(folder), {'/imu/data': [], '/odometer': []}
    bag.channels = CHANNELS
    for k in range(number):
        packed, new = second(k)
        bag.append(packed)
        for topic, some in new.items():
            messages[topic] += some
        bag.join_some()
    return bag, messages


def read(path):
    """Return bag time and bytes of the messages by topic, in the order that replay has them."""
    found = {'/imu/data': [], '/odometer': []}
    with open_bag(path) as bag:
        for batch in bag._batches({t for t in found if t in bag.topics}):
            for topic, (times, raws) in batch.items():
                found[topic] += zip(times, raws, strict=True)
    return found


@pytest.mark.parametrize('zstd', [True, False])
def test_other_readers_read_a_segment(tmp_path, monkeypatch, zstd):
    if not zstd:
        monkeypatch.setattr(mcap_write, '_zstd', lambda: None)
    packed, messages = second(0)
    written = write_file(tmp_path / 'part.mcap', CHANNELS, packed)
    assert written.size == (tmp_path / 'part.mcap').stat().st_size
    with rosbag2.Reader(tmp_path / 'part.mcap') as reader:
        assert {c.topic: (c.msgtype, c.msgcount) for c in reader.connections} == {
            '/imu/data': ('sensor_msgs/msg/Imu', 20), '/odometer': ('std_msgs/msg/Int64', 20)}
        assert (reader.start_time, reader.end_time) == (T0, T0 + 900_000_000 + 1)
        for topic, sent in messages.items():
            mine = [c for c in reader.connections if c.topic == topic]
            assert [(t, bytes(raw)) for _, t, raw in reader.messages(mine)] == sent


def test_records_are_read_without_an_index_and_chunks_are_unchanged(tmp_path):
    packed, messages = second(0)
    write_file(tmp_path / 'cut.mcap', CHANNELS, packed)
    whole = (tmp_path / 'cut.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[:-40])
    assert read(tmp_path / 'cut.mcap') == messages
    packed, _ = second(3)
    write_file(tmp_path / 'part.mcap', CHANNELS, packed)
    assert [vars(chunk) for chunk in read_chunks(tmp_path / 'part.mcap')] == [
        vars(chunk) for chunk in packed]


def test_messages_are_in_order_of_time_if_the_index_states_other_times(tmp_path):
    (first, messages), (second_chunks, later) = second(0), second(1)
    path = tmp_path / 'part.mcap'
    write_file(path, CHANNELS, first + second_chunks)
    data = path.read_bytes()
    summary = struct.unpack_from('<Q', data, len(data) - 28)[0]
    one, two = (struct.pack('<QQ', c[0].start_ns, c[0].end_ns) for c in (first, second_chunks))
    swapped = data[summary:].replace(one, b'-' * 16).replace(two, one).replace(b'-' * 16, two)
    path.write_bytes(data[:summary] + swapped)
    assert read(path) == {topic: messages[topic] + later[topic] for topic in messages}


@pytest.mark.parametrize('zstd', [True, False])
def test_the_index_of_a_chunk_points_at_its_messages(monkeypatch, zstd):
    # rosbags reads without it, the readers of ros2 bag and Foxglove do not
    if not zstd:
        monkeypatch.setattr(mcap_write, '_zstd', lambda: None)
    times, raws = [T0 + 5, T0 + 3, T0 + 9], [b'a' * 10, b'b', b'c' * 300]
    chunk = pack(7, times, raws, sequence=40)
    start_ns, end_ns, size, crc = CHUNK_HEAD.unpack_from(chunk.record, 9)
    form, at = text_at(chunk.record, 9 + CHUNK_HEAD.size)
    records = chunk.record[at + 8:]
    records = mcap_write.zstd_module().decompress(records) if zstd else records
    assert (start_ns, end_ns, size, crc, form) == (
        T0 + 3, T0 + 9, len(records), zlib.crc32(records), 'zstd' if zstd else '')
    channel, nbytes = struct.unpack_from('<HI', chunk.index, 9)
    entries = list(struct.iter_unpack('<QQ', chunk.index[15:]))
    assert (channel, nbytes, [t for t, _ in entries]) == (7, 48, times)
    for number, ((time_ns, at), raw) in enumerate(zip(entries, raws, strict=True), 40):
        assert struct.unpack_from('<BQHIQQ', records, at) == (
            5, len(raw) + 22, 7, number, time_ns, time_ns)
        assert records[at + 31:at + 31 + len(raw)] == raw


def test_a_growing_bag_is_read_at_any_moment(tmp_path):
    bag, messages = grown(tmp_path / 'leg', 4)
    (bag.folder / f'.{part_name(4, 4)}{PART}').write_bytes(b'being written')
    assert read(bag.folder) == messages
    assert sorted(p.name for p in bag.folder.glob('*.mcap')) == [part_name(k, k) for k in range(4)]


def test_a_finished_bag_is_one_file_with_metadata(tmp_path):
    bag, messages = grown(tmp_path / 'leg', 4)
    assert bag.finish() == bag.folder / 'leg_0.mcap'
    assert sorted(p.name for p in bag.folder.iterdir()) == [
        JOURNAL_FILE, 'leg_0.mcap', 'metadata.yaml']
    assert read(bag.folder) == messages
    with rosbag2.Reader(bag.folder) as reader:
        assert (reader.message_count, reader.ros_distro) == (160, 'jazzy')
        assert {c.topic: c.msgcount for c in reader.connections} == {
            '/imu/data': 80, '/odometer': 80}


def test_sixty_segments_are_joined_while_it_grows(tmp_path, monkeypatch):
    monkeypatch.setattr(segments, 'FILES_JOINED', 3)
    bag, messages = grown(tmp_path / 'leg', 9)
    assert sorted(p.name for p in bag.folder.glob('*.mcap')) == [
        part_name(0, 0), part_name(1, 3), part_name(4, 6), part_name(7, 7), part_name(8, 8)]
    assert bag.size == sum(p.stat().st_size for p in bag.folder.glob('*.mcap'))
    assert bag.unjoined_size == sum((bag.folder / part_name(k, k)).stat().st_size for k in (7, 8))
    assert read(bag.folder) == messages


class Killed(BaseException):
    """The process ends here."""


@pytest.mark.parametrize('join', [SegmentedBag.join_some, SegmentedBag.finish])
def test_a_kill_at_any_step_of_joining_neither_loses_nor_repeats_messages(tmp_path, join):
    seen = set()
    for step in count(1):
        folder = tmp_path / str(step) / 'leg'
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(segments, 'FILES_JOINED', 99)
            bag, messages = grown(folder, 5)
            patch.setattr(segments, 'FILES_JOINED', 4)
            disk = Refusing(step, for_ever=True, error=Killed()).put_in(patch)
            with suppress(Killed):
                join(bag)
        assert read(folder) == messages, step
        seen.add(tuple(sorted(path.name for path in folder.iterdir())))
        if len(disk.steps) < step:
            break
    assert len(seen) > 5      # states that differ were met


def test_without_space_for_the_copy_the_segments_remain_the_bag(tmp_path):
    bag, messages = grown(tmp_path / 'leg', 3)
    bag.finish(free_bytes=bag.size - 1)
    assert sorted(p.name for p in bag.folder.glob('*.mcap')) == [part_name(k, k) for k in range(3)]
    assert read(bag.folder) == messages
    with rosbag2.Reader(bag.folder) as reader:
        assert reader.message_count == 120


@pytest.mark.parametrize('free_bytes', [None, 0])
@pytest.mark.parametrize('metadata', [True, False])
def test_a_mark_is_added_to_a_finished_bag(tmp_path, free_bytes, metadata):
    bag, messages = grown(tmp_path / 'leg', 3)
    bag.finish(free_bytes)
    late, more = second(7)
    bag.add(late)
    assert (bag.folder / joined_name(bag.folder, 1)).exists()
    if not metadata:
        (bag.folder / 'metadata.yaml').unlink()
    assert read(bag.folder) == {topic: messages[topic] + more[topic] for topic in messages}


def test_file_names_are_checked_in_journals_only(tmp_path):
    bag, _ = grown(tmp_path / 'leg', 2)
    (bag.folder / part_name(0, 0)).rename(bag.folder / part_name(0, 5))
    (bag.folder / JOURNAL_FILE).unlink()
    assert len(read(bag.folder)['/odometer']) == 40


def test_an_empty_folder_of_a_journal_is_reported(tmp_path):
    (tmp_path / JOURNAL_FILE).touch()
    with pytest.raises(BadBag, match='holds no .mcap'), open_bag(tmp_path):
        pass

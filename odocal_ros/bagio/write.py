# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Write a bag of several topics in order of time, completely or not at all, by rosbags."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
import shutil
import tempfile
from typing import Any
import zlib

import numpy as np

from odocal_ros.bagio import encode
from odocal_ros.bagio.rosbags_readers import require_rosbags
from odocal_ros.errors import BadUsage

STORAGES = ('mcap', 'sqlite3', 'rosbag1')
COMPRESSIONS = ('none', 'message', 'file', 'storage')   # all zstd
BLOCK_MESSAGES, BLOCK_BYTES = 20_000, 2**26      # judgement: packed at a time, to bound memory


def drive_topics(drive: Any) -> list[encode.Topic]:
    """Return a simulated drive's topics, with the names of the node's inputs."""
    reference = drive.reference
    position = () if reference.encoder == 'fix' else (drive.positions(),)
    topics = [encode.imu('/imu/data', drive.imu)] if len(drive.imu.stamp_ns) else []
    topics.append(getattr(encode, reference.encoder)(reference.topic, drive.fix, *position))
    kind, left, right = drive.options.odometer, drive.odometer, drive.odometer_right
    if kind == 'angle':
        topics.append(encode.joints('/joint_states', dict(zip(
            drive.joints, drive.wheels, strict=True))))
    elif kind == 'speed':
        topics.append(encode.twist('/odometer', left))
    elif len(drive.wheels) > 1:
        topics += [encode.counter('/odometer/left', left),
                   encode.counter('/odometer/right', right)]
    else:
        topics.append(encode.counter('/odometer', left))
    others = (encode.heading('/heading', drive.heading),
              encode.velocity('/fix_velocity', drive.velocity),
              encode.pressure('/pressure', drive.pressure))
    return topics + [topic for topic in others if len(topic.time_ns)]


def write_bag(path: Path, topics: Sequence[encode.Topic], storage: str = 'mcap',
              compression: str = 'none', force: bool = False,
              progress: Callable[[float], None] | None = None) -> Path:
    """
    Write topics as one bag, messages in order of bag time; return its path.

    storage : mcap or sqlite3, a rosbag2 folder; rosbag1, a file.   progress : called with the
    share written.   force : replace an existing bag. Only a complete bag gets its name.

    Raises BadUsage: the path exists and ``force`` is not set; its folder cannot be written; an
    unknown storage or a compression the storage does not have.
    """
    path = Path(path)
    check_target(path, storage, compression, force)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix='.odocal_', dir=path.parent))
    except OSError as error:
        raise BadUsage(f'{path}: cannot be written ({error.strerror}); choose another '
                       '--out') from None
    try:
        bag = temporary / path.name      # rosbag2 names its files after the folder
        _write(bag, topics, storage, compression, progress)
        if force and path.is_dir():
            shutil.rmtree(path)
        bag.replace(path)
    except OSError as error:
        raise BadUsage(f'{path}: writing failed ({error.strerror}); the incomplete bag was '
                       'deleted; choose another --out') from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return path


def check_target(path: Path, storage: str, compression: str, force: bool) -> None:
    """Raise BadUsage as write_bag does, before any work is done."""
    if storage not in STORAGES:
        raise BadUsage(f'--storage {storage}: required: one of {", ".join(STORAGES)}')
    if compression not in COMPRESSIONS:
        raise BadUsage(f'--compression {compression}: required: one of {", ".join(COMPRESSIONS)}')
    unavailable = {'sqlite3': ('storage',), 'mcap': (), 'rosbag1': ('message', 'file', 'storage')}
    if compression in unavailable[storage]:
        raise BadUsage(f'--compression {compression} is not available for --storage {storage}')
    if path.exists() and not force:
        raise BadUsage(f'{path} already exists; give --force to replace it, or another --out')
    if path.exists() and not _is_bag(path):
        raise BadUsage(f'{path} already exists and is not a bag; choose another --out')


def _is_bag(path: Path) -> bool:
    suffixes = {'.db3', '.mcap', '.bag', '.zstd', '.db3-wal', '.db3-shm'}
    if path.is_file():
        return path.suffix in suffixes
    return path.is_dir() and all(
        p.name == 'metadata.yaml' or p.suffix in suffixes for p in path.iterdir())


def _write(path: Path, topics: Sequence[encode.Topic], storage: str, compression: str,
           progress: Callable[[float], None] | None) -> None:
    with require_rosbags('writing a bag'):
        from rosbags import rosbag1
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import get_typestore, Stores
    ros2 = store = get_typestore(Stores.ROS2_JAZZY)
    writer: Any
    if storage == 'rosbag1':
        store, writer = get_typestore(Stores.ROS1_NOETIC), rosbag1.Writer(path)
    else:
        writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        if storage == 'mcap':
            _with_checksums(writer.storage)
        connections = [writer.add_connection(t.name, t.msgtype, typestore=store) for t in topics]
        for topic, time_ns, raw in _merged(topics, progress):
            writer.write(connections[topic], time_ns, ros2.cdr_to_ros1(
                raw, topics[topic].msgtype) if storage == 'rosbag1' else raw)


def _with_checksums(storage: Any) -> None:
    """Add the checksum of each chunk to rosbags' mcap storage, which writes zeros."""
    close_chunk = storage.close_chunk

    def close_with_checksum() -> None:
        crc, begin = zlib.crc32(storage.chunk.bio.getbuffer()), storage.bio.tell()
        close_chunk()
        end = storage.bio.tell()
        # in a chunk record of mcap: after opcode and size, start, end and unpacked size
        storage.bio.seek(begin + 9 + 24)
        storage.bio.write(crc.to_bytes(4, 'little'))
        storage.bio.seek(end)
    storage.close_chunk = close_with_checksum


def _merged(topics: Sequence[encode.Topic],
            progress: Callable[[float], None] | None) -> Iterator[tuple[int, int, bytes]]:
    """Yield (index of the topic, bag time, message) in order of time, packed in blocks."""
    order = np.argsort(np.concatenate([t.time_ns for t in topics]), kind='stable')
    # index of the topic of each message
    by_time = np.concatenate([np.full(len(t.time_ns), i) for i, t in enumerate(topics)])[order]
    largest = max((t.pack(slice(0, 1)).itemsize for t in topics if len(t.time_ns)), default=1)
    block = int(np.clip(BLOCK_BYTES // largest, 1, BLOCK_MESSAGES))
    rows_done = [0] * len(topics)
    for first in range(0, len(by_time), block):
        in_block = by_time[first:first + block]
        queues = []
        for i, topic in enumerate(topics):
            rows = slice(rows_done[i], rows_done[i] + int(np.count_nonzero(in_block == i)))
            rows_done[i] = rows.stop
            queues.append(_messages(topic, rows))
        for i in in_block.tolist():
            yield (i, *next(queues[i]))
        if progress:
            progress(min(1.0, (first + block) / len(by_time)))


def _messages(topic: encode.Topic, rows: slice) -> Iterator[tuple[int, bytes]]:
    packed = topic.pack(rows)
    raw, size = packed.tobytes(), packed.itemsize
    for offset, time_ns in zip(range(0, len(raw), size), topic.time_ns[rows].tolist(),
                               strict=True):
        yield time_ns, raw[offset:offset + size]

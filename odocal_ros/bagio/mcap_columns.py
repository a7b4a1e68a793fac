# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Messages of an mcap file as columns: a block of chunks at a time, without a loop over messages.

The message index after each chunk (mcap.dev/spec#message-index-op0x07) has the offsets of the
records. They are verified: each record must be a message (op 0x05) that ends at the start of the
next one, or at the end of the chunk. Chunks that differ are read by a sequential scan.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.bagio.bag_file import Batch, Channel
from odocal_ros.bagio.mcap_records import Chunk, ChunkIndex, Entry, MESSAGE, MESSAGE_INDEX, RECORD
from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.messages.raws import RawMessages, Rows
from odocal_ros.safe_io.limits import Damaged, LATEST_NS

BLOCK_BYTES = 2**21          # judgement: bytes of chunks unpacked at a time
# format: of a message record, before the message: mcap.dev/spec
HEAD = np.dtype([('op', 'u1'), ('size', '<i8'), ('channel', '<u2'), ('sequence', '<u4'),
                 ('time_ns', '<i8'), ('published_ns', '<i8')])
# format: bytes of HEAD that the size of a record includes: all after the opcode and the size
COUNTED_HEAD = HEAD.itemsize - RECORD.size


class Columns(NamedTuple):
    """Times, channel numbers and bytes of n messages."""

    time_ns: Ints                  # (n,)
    channel: NDArray[np.uint16]    # (n,)
    raws: RawMessages

    def take(self, rows: Rows) -> 'Columns':
        return Columns(self.time_ns[rows], self.channel[rows], self.raws.take(rows))


ReadChunk = Callable[[ChunkIndex], Chunk]     # or raises Damaged
ScanChunk = Callable[[Chunk], Sequence[Entry]]     # or raises Damaged
ReportDamage = Callable[[Damaged], None]


def batches(index: Sequence[ChunkIndex], channels: Mapping[int, Channel],
            known_channels: Collection[int], read_chunk: ReadChunk, scan: ScanChunk,
            report_damage: ReportDamage) -> Iterator[Batch]:
    """
    Yield the messages of some channels by time, many at a time.

    index : chunks in order of their stated times.   known_channels : all channels of the file.
    scan : returns the messages of a chunk, read one by one.   report_damage : called with each
    damage.
    """
    is_requested, is_known = _channel_mask(channels), _channel_mask(known_channels)
    later: Columns | None = None         # messages that may be later than those of the next chunk
    next_chunk, min_bytes = 0, 1      # the first block is one chunk, which is often sufficient
    while next_chunk < len(index):
        first_chunk, next_chunk = next_chunk, _block_end(index, next_chunk, min_bytes)
        chunks = []
        for entry in index[first_chunk:next_chunk]:
            try:
                chunks.append(read_chunk(entry))
            except Damaged as error:
                report_damage(error)
        columns = _columns(chunks, is_known, scan, report_damage)
        if len(channels) < len(known_channels):
            columns = columns.take(is_requested[columns.channel])
        columns = _join(later, columns) if later else columns
        if (columns.time_ns[1:] < columns.time_ns[:-1]).any():
            columns = columns.take(np.argsort(columns.time_ns, kind='stable'))
        next_ns = index[next_chunk].start_ns if next_chunk < len(index) else LATEST_NS
        end = int(np.searchsorted(columns.time_ns, next_ns))
        later = columns.take(slice(end, None)) if end < len(columns.time_ns) else None
        if end:
            yield _batch(columns.take(slice(end)), channels)
        # a block as large as what it may wait for: else many chunks that overlap are joined again
        min_bytes = BLOCK_BYTES + int(later.raws.size.sum() if later else 0)


def _block_end(index: Sequence[ChunkIndex], number: int, min_bytes: int) -> int:
    """
    Return the end of a block of chunks from ``number`` on, with at least ``min_bytes``.

    Chunks that overlap these in time are included, up to BLOCK_BYTES more bytes.
    """
    bytes_left, end_ns = min_bytes, 0
    while number < len(index) and (
            bytes_left > 0 or (index[number].start_ns < end_ns and bytes_left > -BLOCK_BYTES)):
        entry = index[number]
        # the larger one: a wrong index may state 0 for the unpacked size
        bytes_left -= max(entry.size, entry.unpacked_size)
        end_ns, number = max(end_ns, entry.end_ns), number + 1
    return number


def _columns(chunks: Sequence[Chunk], is_known: Bools, scan: ScanChunk,
             report_damage: ReportDamage) -> Columns:
    """Return the messages of chunks; where the index is unexpected by a sequential scan."""
    columns = _columns_by_index(chunks, is_known)
    if columns is not None:
        return columns
    parts = []
    for chunk in chunks:
        try:
            part = _columns_by_index([chunk], is_known)
            parts.append(_columns_of_messages(scan(chunk)) if part is None else part)
        except Damaged as error:
            report_damage(error)
    return _join(*parts)


def _channel_mask(channel_numbers: Collection[int]) -> Bools:
    """Return a mask of all possible channel numbers, True for the given ones: (65536,)."""
    mask = np.zeros(2**16, bool)
    mask[list(channel_numbers)] = True
    return mask


def _columns_by_index(chunks: Sequence[Chunk], is_known: Bools) -> Columns | None:
    """Return the messages of chunks; None if any of them has an unexpected layout."""
    offsets = [_record_offsets(chunk) for chunk in chunks]
    counts = np.array([len(chunk_offsets) for chunk_offsets in offsets])
    if not chunks or not counts.all():
        return None
    data = b''.join([chunk.records for chunk in chunks])
    chunk_stop = np.cumsum([len(chunk.records) for chunk in chunks])      # in the data
    chunk_begin = np.append(0, chunk_stop[:-1])
    start = np.sort(np.concatenate(offsets) + np.repeat(chunk_begin, counts))      # of each record
    if start[0] < 0 or start[-1] > len(data) - HEAD.itemsize:
        return None
    # a view with a head at every offset of the buffer; only those of records are read
    offset_count = len(data) - HEAD.itemsize + 1
    head = np.ndarray((offset_count,), f'V{HEAD.itemsize}', data, 0, (1,))[start].view(HEAD)
    # row after the last message of each chunk; if the sorted records of chunks are mixed, a record
    # is not adjacent to the one before
    end = counts.cumsum()
    first = end - counts
    stop = np.append(start[1:], 0)
    stop[end - 1] = chunk_stop
    size = stop - start - RECORD.size
    is_adjacent = (      # each record begins where the one before it ends
        (head['op'] == MESSAGE).all() and (head['size'] == size).all()
        and size.min() >= COUNTED_HEAD and (start[first] == chunk_begin).all())
    time_ns, channel = head['time_ns'].copy(), head['channel'].copy()
    if not (is_adjacent and is_known[channel].all() and _are_times_as_stated(
            chunks, time_ns, first)):
        return None
    return Columns(time_ns, channel, RawMessages(data, start + HEAD.itemsize, size - COUNTED_HEAD))


def _are_times_as_stated(chunks: Sequence[Chunk], time_ns: Ints, first: Ints) -> bool:
    """Return True if messages are within the times of their chunks; first : row of their first."""
    earliest, latest = np.minimum.reduceat(time_ns, first), np.maximum.reduceat(time_ns, first)
    return all(high < LATEST_NS
               and chunk.start_ns <= low <= high <= max(chunk.end_ns, chunk.start_ns)
               for chunk, low, high in zip(chunks, earliest.tolist(), latest.tolist(),
                                           strict=True))


def _record_offsets(chunk: Chunk) -> Ints:
    """Return the offsets of the records of a chunk from its message index, in any order."""
    offsets, position, index = [np.empty(0, np.int64)], 0, chunk.message_index
    # opcode, size of the rest, channel, bytes of pairs; then 8 bytes of time and of offset each
    head = struct.Struct('<BQHI')
    while position + head.size <= len(index):
        op, size, _, length = head.unpack_from(index, position)
        pairs = position + head.size
        if op != MESSAGE_INDEX or size != length + 6 or length % 16 or (
                pairs + length > len(index)):
            break      # of a damaged index offsets are missing: _columns_by_index rejects them
        offsets.append(np.frombuffer(index, '<i8', length // 8, pairs)[1::2])
        position = pairs + length
    return np.concatenate(offsets)


def _columns_of_messages(entries: Sequence[Entry]) -> Columns:
    return Columns(np.array([entry[0] for entry in entries], np.int64),
                   np.array([entry[1] for entry in entries], np.uint16),
                   RawMessages.joined([entry[2] for entry in entries]))


def _join(*parts: Columns) -> Columns:
    """Return the messages of several columns in one buffer."""
    if not parts:
        return _columns_of_messages([])
    packed = [part.raws.packed() for part in parts]
    base = np.cumsum([0, *(len(raws.data) for raws in packed[:-1])])
    return Columns(
        np.concatenate([part.time_ns for part in parts]),
        np.concatenate([part.channel for part in parts]),
        RawMessages(b''.join([raws.data for raws in packed]),
                    np.concatenate([raws.start + offset
                                    for raws, offset in zip(packed, base, strict=True)]),
                    np.concatenate([raws.size for raws in packed])))


def _batch(columns: Columns, channels: Mapping[int, Channel]) -> Batch:
    """Return messages by topic, which may have several channels."""
    batch: Batch = {}
    for topic in dict.fromkeys(channel.topic for channel in channels.values()):
        masks = [columns.channel == channel_number
                 for channel_number, channel in channels.items() if channel.topic == topic]
        rows = np.flatnonzero(np.logical_or.reduce(masks))
        if len(rows):
            batch[topic] = columns.time_ns[rows], columns.raws.take(rows)
    return batch

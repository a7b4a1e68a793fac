# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Messages of an mcap file as columns: a block of chunks at a time, without a loop over messages.

The offsets of the records in a chunk are from the message index after it
(mcap.dev/spec#message-index-op0x07), and are verified: each must be a message (op 0x05) that ends
at the begin of the next one, the last of them at the end of the chunk, as in a sequential scan of
the records. Other chunks are read by such a scan.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.bagio.channels import Batch, Channel
from odocal_ros.bagio.mcap_records import Chunk, MESSAGE, MESSAGE_INDEX, Place, RECORD
from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.messages.raws import Raws, Rows
from odocal_ros.safe_io.limits import Damaged, LATEST_NS

BLOCK = 2**21          # judgement: bytes of chunks unpacked at a time
HEAD = np.dtype([('op', 'u1'), ('size', '<i8'), ('channel', '<u2'), ('sequence', '<u4'),
                 ('time_ns', '<i8'), ('published_ns', '<i8')])
BODY = 22              # format: bytes of HEAD in a record's size: mcap.dev/spec


class Columns(NamedTuple):
    """Messages: their times, channels and bytes."""

    time_ns: Ints
    channel: NDArray[np.uint16]
    raws: Raws

    def take(self, rows: Rows) -> 'Columns':
        return Columns(self.time_ns[rows], self.channel[rows], self.raws.take(rows))


Block = list[Chunk | Damaged]
Read = Callable[[Sequence[Place]], Block]                     # of adjacent chunks
Walk = Callable[[Chunk], Sequence[tuple[int, int, bytes]]]    # time, channel, message; or Damaged
Note = Callable[[Damaged], None]


def batches(places: Sequence[Place], wanted: Mapping[int, Channel], known: Collection[int],
            read: Read, walk: Walk, note: Note) -> Iterator[Batch]:
    """
    Yield the messages of some channels by time, many at a time.

    places : chunks in order of their stated times.   known : all channels of the file.
    walk   : returns the messages of a chunk one by one.   note : called with each damage.
    """
    mine, all_known = _table(wanted), _table(known)
    late: Columns | None = None          # messages that may be later than those of the next chunk
    at, size = 0, 1                      # the first block is one chunk, which is often sufficient
    while at < len(places):
        block, at = _block(places, at, size, read)
        found = _columns(block, all_known, walk, note)
        if len(wanted) < len(known):
            found = found.take(mine[found.channel])
        found = _by_time(_joined(late, found) if late else found)
        end = int(np.searchsorted(found.time_ns, places[at].start_ns)) if at < len(
            places) else len(found.time_ns)
        late = found.take(slice(end, None)) if end < len(found.time_ns) else None
        if end:
            yield _batch(found.take(slice(end)), wanted)
        size = BLOCK + int(late.raws.size.sum() if late else 0)


def _block(places: Sequence[Place], at: int, size: int, read: Read) -> tuple[Block, int]:
    """Read chunks from number ``at``, of ``size`` bytes or more; return them and the next one."""
    block: Block = []
    end_ns, first, beside = 0, at, 0
    while at < len(places) and (size > 0 or places[at].start_ns < end_ns and size > -BLOCK):
        place = places[at]
        if place.at != beside:
            block += read(places[first:at]) if at > first else []
            first = at
        beside = place.at + place.size + place.index_size
        size -= max(place.size, place.unpacked)
        end_ns, at = max(end_ns, place.end_ns), at + 1
    return block + read(places[first:at]), at


def _columns(block: Block, known: Bools, walk: Walk, note: Note) -> Columns:
    """Return the messages of chunks; of one with an unexpected layout by a sequential scan."""
    found = _gathered([chunk for chunk in block if isinstance(chunk, Chunk)], known)
    parts = []
    for chunk in block:
        try:
            if isinstance(chunk, Damaged):
                raise chunk
            if found is None:
                parts.append(_gathered([chunk], known) or _walked(walk(chunk)))
        except Damaged as error:
            note(error)
    return found or _joined(*parts)


def _table(keys: Collection[int]) -> Bools:
    """Return a table of all channel numbers, True for those in ``keys``."""
    table = np.zeros(2**16, bool)
    table[list(keys)] = True
    return table


def _gathered(chunks: Sequence[Chunk], known: Bools) -> Columns | None:
    """Return the messages of chunks; None if any of them has an unexpected layout."""
    chunks = _in_one(chunks)
    starts = [_starts(chunk) for chunk in chunks]
    counts = np.array([len(s) for s in starts])
    if not chunks or not counts.all():
        return None
    data = chunks[0].data
    start = np.sort(np.concatenate(starts))
    if start[0] < 0 or start[-1] > len(data) - HEAD.itemsize:
        return None
    head = np.ndarray((len(data) - HEAD.itemsize + 1,), f'V{HEAD.itemsize}', data, 0, (1,))[
        start].view(HEAD)
    end = counts.cumsum()
    first = end - counts
    stop = np.append(start[1:], 0)
    stop[end - 1] = [chunk.stop for chunk in chunks]
    size = stop - start - 9
    chain = ((head['size'] == size).all() and size.min() >= BODY and (head['op'] == MESSAGE).all()
             and start[first].tolist() == [chunk.at for chunk in chunks])
    time_ns, channel = head['time_ns'].copy(), head['channel'].copy()
    if not chain or not known[channel].all():
        return None
    least, most = np.minimum.reduceat(time_ns, first), np.maximum.reduceat(time_ns, first)
    for chunk, a, b in zip(chunks, least.tolist(), most.tolist(), strict=True):
        if not chunk.start_ns <= a <= b <= max(chunk.end_ns, chunk.start_ns) or b >= LATEST_NS:
            return None
    return Columns(time_ns, channel, Raws(data, start + HEAD.itemsize, size - BODY))


def _in_one(chunks: Sequence[Chunk]) -> Sequence[Chunk]:
    if len({id(chunk.data) for chunk in chunks}) <= 1:
        return chunks
    data, at, found = b''.join([chunk.records for chunk in chunks]), 0, []
    for chunk in chunks:
        stop = at + chunk.stop - chunk.at
        found.append(chunk._replace(data=data, at=at, stop=stop))
        at = stop
    return found


def _starts(chunk: Chunk) -> Ints:
    """Return the offsets of the records of a chunk from its message index, in any order."""
    found, at, index = [np.empty(0, np.int64)], 0, chunk.begins
    while at + 15 <= len(index):
        op, size = RECORD.unpack_from(index, at)
        (length,) = struct.unpack_from('<I', index, at + 11)
        if op != MESSAGE_INDEX or size != length + 6 or length % 16 or (
                at + 15 + length > len(index)):
            break
        found.append(np.frombuffer(index, '<i8', length // 8, at + 15)[1::2])
        at += 9 + size
    return np.concatenate(found) + chunk.at


def _walked(entries: Sequence[tuple[int, int, bytes]]) -> Columns:
    return Columns(np.array([entry[0] for entry in entries], np.int64),
                   np.array([entry[1] for entry in entries], np.uint16),
                   Raws.of([entry[2] for entry in entries]))


def _joined(*parts: Columns) -> Columns:
    if not parts:
        return _walked([])
    packed = [part.raws.packed() for part in parts]
    base = np.cumsum([0, *(len(raws.data) for raws in packed)])
    return Columns(
        np.concatenate([part.time_ns for part in parts]),
        np.concatenate([part.channel for part in parts]),
        Raws(b''.join([raws.data for raws in packed]),
             np.concatenate([raws.start + at for raws, at in zip(packed, base, strict=False)]),
             np.concatenate([raws.size for raws in packed])))


def _by_time(found: Columns) -> Columns:
    if (found.time_ns[1:] >= found.time_ns[:-1]).all():
        return found
    return found.take(np.argsort(found.time_ns, kind='stable'))


def _batch(found: Columns, wanted: Mapping[int, Channel]) -> Batch:
    batch: Batch = {}
    for topic in dict.fromkeys(channel.topic for channel in wanted.values()):
        mine = [found.channel == key for key, channel in wanted.items() if channel.topic == topic]
        rows = np.flatnonzero(np.logical_or.reduce(mine))
        if len(rows):
            batch[topic] = found.time_ns[rows], found.raws.take(rows)
    return batch

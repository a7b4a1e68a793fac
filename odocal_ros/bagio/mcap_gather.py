# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Messages of an mcap file as columns: a block of chunks at a time, no step for a single message.

Where the records of a chunk begin is taken from the message index behind it
(mcap.dev/spec#message-index-op0x07), and then proved: each must be a message (op 0x05) that ends
where the next one begins, the last of them with the chunk, as a walk over the records would find
them. A chunk that is not so goes through the walk.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.bagio.channels import Batch, Channel
from odocal_ros.bagio.mcap_chunk import Chunk
from odocal_ros.bagio.mcap_records import MESSAGE, MESSAGE_INDEX, Place, RECORD
from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.messages.raws import Raws, Rows
from odocal_ros.outside.limits import Damaged, LATEST_NS

BLOCK = 2**21          # bytes of chunks unpacked at a time
HEAD = np.dtype([('op', 'u1'), ('size', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                 ('time_ns', '<u8'), ('published_ns', '<u8')])
BODY = 22              # of those bytes, what a record's size counts


class Columns(NamedTuple):
    """Messages: when, of which channel, and their bytes."""

    time_ns: Ints
    channel: NDArray[np.uint16]
    raws: Raws

    def take(self, rows: Rows) -> 'Columns':
        """Return some rows."""
        return Columns(self.time_ns[rows], self.channel[rows], self.raws.take(rows))


Unpack = Callable[[Place], Chunk]                             # or Damaged
Walk = Callable[[Chunk], Sequence[tuple[int, int, bytes]]]    # time, channel, message; or Damaged
Note = Callable[[Damaged], None]
Block = list[Chunk | Damaged]


def batches(places: Sequence[Place], wanted: Mapping[int, Channel], known: Collection[int],
            unpack: Unpack, walk: Walk, note: Note) -> Iterator[Batch]:
    """
    Yield the messages of some channels by time, many at a time.

    places : chunks by the times they state.   known : all channels of the file.
    walk   : gives the messages of a chunk one by one.   note : is told what damage costs.
    """
    columns = partial(_columns, known=_table(known), walk=walk, note=note)
    mine = _table(wanted)
    late: Columns | None = None          # messages that one of a chunk to come may precede
    with ThreadPoolExecutor(1) as beside:
        # the first block is one chunk: often no more is asked for
        block = beside.submit(_block, places, 0, 1, unpack)
        while True:
            chunks, at = block.result()
            size = BLOCK + int(late.raws.size.sum() if late else 0)
            block = beside.submit(_block, places, at, size, unpack)
            found = columns(chunks)
            found = found.take(mine[found.channel])
            found = _by_time(_joined(late, found) if late else found)
            end = int(np.searchsorted(found.time_ns, places[at].start_ns)) if at < len(
                places) else len(found.time_ns)
            late = found.take(slice(end, None)) if end < len(found.time_ns) else None
            if end:
                yield _batch(found.take(slice(end)), wanted)
            if at >= len(places):
                return


def _block(places: Sequence[Place], at: int, size: int, unpack: Unpack) -> tuple[Block, int]:
    """Unpack chunks from one on, of so many bytes or more; return them and which comes next."""
    block: Block = []
    end_ns = 0
    while at < len(places) and (size > 0 or places[at].start_ns < end_ns and size > -BLOCK):
        try:
            chunk = unpack(places[at])
            block.append(chunk)
            size -= len(chunk.records)
        except Damaged as error:
            block.append(error)
        size, end_ns, at = size - 1, max(end_ns, places[at].end_ns), at + 1
    return block, at


def _columns(block: Block, known: Bools, walk: Walk, note: Note) -> Columns:
    """Return the messages of chunks; those of one that is odd by a walk."""
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
    """Return for each number a channel may have whether it is one of these."""
    table = np.zeros(2**16, bool)
    table[list(keys)] = True
    return table


def _gathered(chunks: Sequence[Chunk], known: Bools) -> Columns | None:
    """Return the messages of chunks; None where anything of them is odd."""
    starts = [_starts(chunk) for chunk in chunks]
    counts = [len(s) for s in starts]
    if not chunks or not all(counts):
        return None
    data = b''.join([chunk.records for chunk in chunks])
    first = np.cumsum([0, *counts[:-1]])
    base = np.cumsum([0, *(len(chunk.records) for chunk in chunks)])
    start = np.concatenate([s + b for s, b in zip(starts, base[:-1], strict=True)])
    if len(data) < HEAD.itemsize or start.max() > len(data) - HEAD.itemsize or start.min() < 0:
        return None
    head = np.ndarray((len(data) - HEAD.itemsize + 1,), HEAD, data, 0, (1,))[start]
    time_ns, size = head['time_ns'], head['size'].astype(np.int64)
    stop = start + 9 + size
    chain = ((start[first] == base[:-1]).all() and (stop[:-1] == start[1:]).all()
             and stop[-1] == base[-1] and (size >= BODY).all()
             and (head['op'] == MESSAGE).all())
    if not chain or not known[head['channel']].all() or (time_ns >= LATEST_NS).any():
        return None
    least, most = np.minimum.reduceat(time_ns, first), np.maximum.reduceat(time_ns, first)
    for chunk, a, b in zip(chunks, least.tolist(), most.tolist(), strict=True):
        if not chunk.start_ns <= a <= b <= max(chunk.end_ns, chunk.start_ns):
            return None
    return Columns(time_ns.astype(np.int64), head['channel'],
                   Raws(data, start + HEAD.itemsize, size - BODY))


def _starts(chunk: Chunk) -> Ints:
    """Return where the records of a chunk begin, by its message index; to be proved."""
    found, at, index = [np.empty(0, np.int64)], 0, chunk.begins
    while at + 15 <= len(index):
        op, size = RECORD.unpack_from(index, at)
        (length,) = struct.unpack_from('<I', index, at + 11)
        if op != MESSAGE_INDEX or size != length + 6 or length % 16 or (
                at + 15 + length > len(index)):
            break
        found.append(np.frombuffer(index, '<i8', length // 8, at + 15)[1::2])
        at += 9 + size
    return np.sort(np.concatenate(found), kind='stable')


def _walked(entries: Sequence[tuple[int, int, bytes]]) -> Columns:
    """Return messages of a walk as columns."""
    return Columns(np.array([entry[0] for entry in entries], np.int64),
                   np.array([entry[1] for entry in entries], np.uint16),
                   Raws.of([entry[2] for entry in entries]))


def _joined(*parts: Columns) -> Columns:
    """Return columns one after the other."""
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
    """Return messages in order of time, those of one time as they stand."""
    if (np.diff(found.time_ns) >= 0).all():
        return found
    return found.take(np.argsort(found.time_ns, kind='stable'))


def _batch(found: Columns, wanted: Mapping[int, Channel]) -> Batch:
    """Return messages by topic."""
    batch: Batch = {}
    for topic in dict.fromkeys(channel.topic for channel in wanted.values()):
        mine = _table([key for key, channel in wanted.items() if channel.topic == topic])
        rows = np.flatnonzero(mine[found.channel])
        if len(rows):
            batch[topic] = found.time_ns[rows], found.raws.take(rows)
    return batch

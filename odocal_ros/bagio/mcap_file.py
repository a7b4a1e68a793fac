# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An mcap file, read by its index, or record by record if that is missing or invalid."""

from collections.abc import Iterator, Mapping, Sequence
import heapq
from operator import itemgetter
from pathlib import Path
import struct
import zlib

from odocal_ros.bagio import mcap_records as mcap
from odocal_ros.bagio.channels import Batch, Channel, FileBytes, FORMATS, overlapping, Recording
from odocal_ros.bagio.mcap_gather import batches
from odocal_ros.safe_io.limits import Allowance, Damaged, LATEST_NS

Entry = tuple[int, int, bytes]     # time, channel, message


class McapFile(Recording):
    """
    A file of messages in chunks.

    The size, the checksum (if any), the channels and the times of each chunk are checked. A chunk
    with any error is left out completely, since other errors in it may be undetected; of a chunk
    truncated by the end of the file, complete messages are used.
    """

    def __init__(self, path: Path, allowance: Allowance) -> None:
        super().__init__(path)
        self._allowance = allowance
        self._schemas: dict[int, tuple[str, tuple[str, str]]] = {}
        self._places: list[mcap.Place] = []
        self._counted = ''         # known damage when messages were counted
        self._file = FileBytes(path)
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        try:
            if self._index():
                return
        except (Damaged, struct.error, UnicodeDecodeError) as error:
            self.damage = str(error) if isinstance(error, Damaged) else mcap.INDEX_DAMAGED
        self._places = []
        self._count()
        self._counted = self.damage

    # ---- the index -------------------------------------------------------------------------

    def _index(self) -> bool:
        data = self._file
        if data[-len(mcap.MAGIC):] != mcap.MAGIC or (
                data[-mcap.END:-mcap.END + 9] != mcap.RECORD.pack(mcap.FOOTER, 20)):
            raise Damaged('cut off')
        start, _, crc = struct.unpack('<QQI', data[-mcap.END + 9:-len(mcap.MAGIC)])
        if not start:
            return False
        if not len(mcap.MAGIC) <= start <= len(data) - mcap.END:
            raise Damaged(mcap.INDEX_DAMAGED)
        if crc and zlib.crc32(data[start:-len(mcap.MAGIC) - 4]) != crc:
            raise Damaged(mcap.INDEX_DAMAGED)
        found = None
        for op, body, _ in mcap.records_of(data[start:-mcap.END]):
            if op in (mcap.SCHEMA, mcap.CHANNEL):
                self._learn(op, body)
            elif op == mcap.CHUNK_INDEX:
                self._places.append(mcap.place_of(body))
            elif op == mcap.STATISTICS:
                found = mcap.statistics_of(body)
        if found is None or found[0] and not (self._places and self._schemas):
            return False
        count, start_ns, end_ns, counts = found
        if not 0 <= start_ns <= end_ns < LATEST_NS and count:
            raise Damaged(mcap.INDEX_DAMAGED)
        self._places = mcap.apart(self._places, start)
        self._set_counts(counts, start_ns, end_ns)
        return True

    # ---- messages --------------------------------------------------------------------------

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield the messages of some topics (name -> type) by time; by chunk without an index."""
        wanted = self._wanted(topics)
        self._allowance.again()
        entries = self._by_time(wanted) if self._places else (
            entry for entry in self._walk() if entry[1] in wanted)
        for time_ns, key, raw in entries:
            yield wanted[key], time_ns, raw
        self._recount()

    def batches(self, topics: Mapping[str, str]) -> Iterator[Batch] | None:
        """Return the messages in batches; None if the index is missing or of other chunks."""
        wanted = self._wanted(topics)
        places = [place for place in self._places
                  if not place.channels or place.channels & wanted.keys()]
        if not self._places or any(self._file[place.at + 9:place.at + 25] != mcap.TIMES.pack(
                place.start_ns, place.end_ns) for place in places):
            return None
        return self._gathered(places, wanted)

    def _gathered(self, places: list[mcap.Place],
                  wanted: Mapping[int, Channel]) -> Iterator[Batch]:
        self._allowance.again()
        yield from batches(places, wanted, self._channels, self._read, self._walked, self._note)
        self._recount()

    def _read(self, places: Sequence[mcap.Place]) -> list[mcap.Chunk | Damaged]:
        """Return adjacent chunks of the index, each with its message index."""
        begin, end = places[0].at, places[-1].at + places[-1].size + places[-1].index_size
        data = self._file[begin:end]
        found: list[mcap.Chunk | Damaged] = []
        for place in places:
            at = place.at - begin
            stop = at + place.size
            try:
                if data[at:at + 9] != mcap.RECORD.pack(mcap.CHUNK, place.size - 9):
                    raise Damaged(mcap.CHUNK_DAMAGED)
                found.append(mcap.unpacked(data, at + 9, stop, self._allowance)._replace(
                    begins=memoryview(data)[stop:stop + place.index_size]))
            except Damaged as error:
                found.append(error)
        return found

    def _note(self, damage: Damaged) -> None:
        self.damage = self.damage or str(damage)

    def _recount(self) -> None:
        """Count the messages again if some of those in the index are lost."""
        if self.damage != self._counted:
            self._count()
            self._counted = self.damage

    def _by_time(self, wanted: Mapping[int, Channel]) -> Iterator[Entry]:
        for together in overlapping(place for place in self._places
                                    if not place.channels or place.channels & wanted.keys()):
            yield from self._merged(together, wanted)

    def _merged(self, places: list[mcap.Place], wanted: Mapping[int, Channel]) -> Iterator[Entry]:
        def lazily(place: mcap.Place) -> Iterator[Entry | tuple[int]]:
            yield (place.start_ns,)        # the chunk is unpacked at its start time
            yield from self._of(place, wanted)
        return (entry for entry in heapq.merge(*map(lazily, places), key=itemgetter(0))
                if len(entry) > 1)

    def _of(self, place: mcap.Place, wanted: Mapping[int, Channel]) -> list[Entry]:
        """Return the messages of a chunk of the index, sorted; [] if it is damaged."""
        try:
            (chunk,) = self._read([place])
            if isinstance(chunk, Damaged):
                raise chunk
            found = self._walked(chunk)
        except Damaged as error:
            self._note(error)
            return []
        return [entry for entry in found if entry[1] in wanted]

    def _scan(self) -> Iterator[tuple[int, int]]:
        self._allowance.again()
        entries = (entry for place in self._places for entry in self._of(place, self._channels)
                   ) if self._places else self._walk()
        return ((key, time_ns) for time_ns, key, _ in entries)

    def _walk(self) -> Iterator[Entry]:
        """Yield every message from the first record on, chunk by chunk."""
        for op, body, whole in mcap.records_of(self._file, len(mcap.MAGIC)):
            try:
                if op == mcap.CHUNK:
                    chunk = mcap.unpacked(body, 0, len(body), self._allowance, cut=not whole)
                    yield from self._walked(chunk, cut=not whole)
                elif op == mcap.MESSAGE:
                    key, _, time_ns, _ = mcap.MESSAGE_HEAD.unpack_from(body)
                    if key not in self._channels or time_ns >= LATEST_NS:
                        raise Damaged('a damaged record')
                    yield time_ns, key, body[mcap.MESSAGE_HEAD.size:]
                elif op in (mcap.SCHEMA, mcap.CHANNEL):
                    self._learn(op, body)
            except (Damaged, struct.error, UnicodeDecodeError) as error:
                self.damage = self.damage or (
                    str(error) if isinstance(error, Damaged) else 'a damaged record')

    # ---- records one by one ----------------------------------------------------------------

    def _walked(self, chunk: mcap.Chunk, cut: bool = False) -> list[Entry]:
        """Return the messages of a chunk by time, from a sequential scan."""
        found = self._entries(bytes(chunk.records), cut)
        found.sort(key=itemgetter(0))
        if found and not chunk.start_ns <= found[0][0] <= found[-1][0] <= max(
                chunk.end_ns, chunk.start_ns):
            raise Damaged(mcap.CHUNK_DAMAGED)
        return found

    def _entries(self, records: bytes, cut: bool) -> list[Entry]:
        """Return the messages of a chunk; raise Damaged if any of its records is invalid."""
        found = []
        channels, head, at, end = self._channels, mcap.RECORD.unpack_from, 0, len(records)
        while at + 9 <= end:
            op, size = head(records, at)
            stop = at + 9 + size
            if stop > end:
                break
            if op == mcap.MESSAGE:
                if size < mcap.MESSAGE_HEAD.size:
                    raise Damaged(mcap.CHUNK_DAMAGED)
                key, _, time_ns, _ = mcap.MESSAGE_HEAD.unpack_from(records, at + 9)
                if key not in channels or time_ns >= LATEST_NS:
                    raise Damaged(mcap.CHUNK_DAMAGED)
                found.append((time_ns, key, records[at + 31:stop]))
            elif op in (mcap.SCHEMA, mcap.CHANNEL):
                try:
                    self._learn(op, records[at + 9:stop])
                except (struct.error, UnicodeDecodeError):
                    raise Damaged(mcap.CHUNK_DAMAGED) from None
            else:       # not allowed in a chunk
                raise Damaged(mcap.CHUNK_DAMAGED)
            at = stop
        if at != end and not cut:
            raise Damaged(mcap.CHUNK_DAMAGED)
        return found

    def _learn(self, op: int, body: bytes) -> None:
        (key,) = struct.unpack_from('<H', body)
        if op == mcap.SCHEMA:
            name, at = mcap.text_at(body, 2)
            form, at = mcap.text_at(body, at)
            text, _ = mcap.text_at(body, at)
            self._schemas[key] = name, (FORMATS.get(form, ''), text)
        elif key not in self._channels:
            topic, at = mcap.text_at(body, 4)
            form, _ = mcap.text_at(body, at)
            (schema,) = struct.unpack_from('<H', body, 2)
            name, definition = self._schemas.get(schema, ('', ('', '')))
            self._channels[key] = Channel(topic, name, 0, form, definition)

    def close(self) -> None:
        self._file.close()

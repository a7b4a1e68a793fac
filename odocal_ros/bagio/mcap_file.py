"""An mcap file: by its index, or record by record where that is gone or wrong."""

from collections.abc import Iterator, Mapping
import heapq
from operator import itemgetter
from pathlib import Path
import struct
import zlib

from odocal_ros.bagio.channels import Channel, FORMATS, Message, Recording
from odocal_ros.bagio.file_bytes import FileBytes
from odocal_ros.bagio.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    CHUNK_INDEX,
    END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    Place,
    place_of,
    RECORD,
    records_of,
    SCHEMA,
    STATISTICS,
    statistics_of,
    text_at,
)
from odocal_ros.outside.limits import Allowance, Damaged, LATEST_NS, LimitReached

CHUNK_DAMAGED, INDEX_DAMAGED = 'a damaged chunk', 'a damaged index'
Entry = tuple[int, int, bytes]     # time, channel, message


class McapFile(Recording):
    """
    A file of messages in chunks.

    What a chunk says of itself is checked: its size, its checksum where it has one, its channels,
    the times of its messages. A chunk of which anything is wrong is left out whole, since what
    else of it is wrong would not show; of a chunk that is cut off, what is there is taken.
    """

    def __init__(self, path: Path, allowance: Allowance) -> None:
        super().__init__(path)
        self._allowance = allowance
        self._schemas: dict[int, tuple[str, tuple[str, str]]] = {}
        self._places: list[Place] = []
        self._file = FileBytes(path)
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        """Learn what is in the file, by its index if that is sound."""
        try:
            if self._index():
                return
        except (Damaged, struct.error, UnicodeDecodeError) as error:
            self.damage = str(error) if isinstance(error, Damaged) else INDEX_DAMAGED
        self._places = []
        self._count()

    # ---- the index -------------------------------------------------------------------------

    def _index(self) -> bool:
        """Read the index; False: the file has none."""
        data = self._file
        if data[-len(MAGIC):] != MAGIC or data[-END:-END + 9] != RECORD.pack(FOOTER, 20):
            raise Damaged('cut off')
        start, _, crc = struct.unpack('<QQI', data[-END + 9:-len(MAGIC)])
        if not start:
            return False
        if not len(MAGIC) <= start <= len(data) - END:
            raise Damaged(INDEX_DAMAGED)
        if crc and zlib.crc32(data[start:-len(MAGIC) - 4]) != crc:
            raise Damaged(INDEX_DAMAGED)
        found = None
        for op, body, _ in records_of(data[start:-END]):
            if op in (SCHEMA, CHANNEL):
                self._learn(op, body)
            elif op == CHUNK_INDEX:
                self._places.append(place_of(body))
            elif op == STATISTICS:
                found = statistics_of(body)
        if found is None or found[0] and not (self._places and self._schemas):
            return False
        count, start_ns, end_ns, counts = found
        if not 0 <= start_ns <= end_ns < LATEST_NS and count:
            raise Damaged(INDEX_DAMAGED)
        self._sound(start)
        self._tell(counts, start_ns, end_ns)
        return True

    def _sound(self, end: int) -> None:
        """See that no two chunks of the index are one: a file would hold more than its bytes."""
        at = len(MAGIC)
        for place in sorted(self._places, key=lambda place: place.at):
            if place.at < at or place.size < 9 or place.at + place.size > end:
                raise Damaged(INDEX_DAMAGED)
            at = place.at + place.size
        self._places.sort()

    # ---- messages --------------------------------------------------------------------------

    def messages(self, topics: Mapping[str, str]) -> Iterator[Message]:
        """Yield the messages of some topics (name -> type) by time; by chunk without an index."""
        wanted, known = self._wanted(topics), self.damage
        self._allowance.again()
        entries = self._by_time(wanted) if self._places else (
            entry for entry in self._walk() if entry[1] in wanted)
        for time_ns, key, raw in entries:
            yield Message(wanted[key], time_ns, raw)
        if self.damage != known:
            self._count()          # the index counts what is lost too

    def _by_time(self, wanted: Mapping[int, Channel]) -> Iterator[Entry]:
        """Yield the messages of the chunks in the index, those of chunks that overlap merged."""
        together: list[Place] = []
        end_ns = 0
        for place in self._places:
            if place.channels and not (place.channels & wanted.keys()):
                continue
            if together and place.start_ns >= end_ns:
                yield from self._merged(together, wanted)
                together, end_ns = [], 0
            together.append(place)
            end_ns = max(end_ns, place.end_ns)
        yield from self._merged(together, wanted)

    def _merged(self, places: list[Place], wanted: Mapping[int, Channel]) -> Iterator[Entry]:
        if len(places) == 1:
            return iter(self._of(places[0], wanted))

        def lazily(place: Place) -> Iterator[Entry | tuple[int]]:
            yield (place.start_ns,)        # the chunk is unpacked when its turn has come
            yield from self._of(place, wanted)
        return (entry for entry in heapq.merge(*map(lazily, places), key=itemgetter(0))
                if len(entry) > 1)

    def _of(self, place: Place, wanted: Mapping[int, Channel]) -> list[Entry]:
        """Return the messages of a chunk of the index, sorted; none of one that is damaged."""
        record = self._file[place.at:place.at + place.size]
        try:
            op, size = RECORD.unpack_from(record)
            if op != CHUNK or size != place.size - 9:
                raise Damaged(CHUNK_DAMAGED)
            found = self._chunk(record[9:])
        except (Damaged, struct.error) as error:
            self.damage = self.damage or _said(error)
            return []
        return [entry for entry in found if entry[1] in wanted]

    def _scan(self) -> Iterator[tuple[int, int]]:
        self._allowance.again()
        entries = (entry for place in self._places for entry in self._of(place, self._channels)
                   ) if self._places else self._walk()
        return ((key, time_ns) for time_ns, key, _ in entries)

    def _walk(self) -> Iterator[Entry]:
        """Yield every message from the first record on, chunk by chunk."""
        for op, body, whole in records_of(self._file, len(MAGIC)):
            try:
                if op == CHUNK:
                    yield from self._chunk(body, cut=not whole)
                elif op == MESSAGE:
                    yield self._message(body)
                elif op in (SCHEMA, CHANNEL):
                    self._learn(op, body)
            except (Damaged, struct.error, UnicodeDecodeError) as error:
                self.damage = self.damage or _said(error)

    def _message(self, body: bytes) -> Entry:
        key, _, time_ns, _ = MESSAGE_HEAD.unpack_from(body)
        if key not in self._channels or time_ns >= LATEST_NS:
            raise Damaged('a damaged record')
        return time_ns, key, body[MESSAGE_HEAD.size:]

    def _chunk(self, body: bytes, cut: bool = False) -> list[Entry]:
        """Return the messages of a chunk by time; or Damaged. ``cut``: the file ends in it."""
        try:
            start_ns, end_ns, size, crc = CHUNK_HEAD.unpack_from(body)
            packing, at = text_at(body, CHUNK_HEAD.size)
            (packed,) = struct.unpack_from('<Q', body, at)
            data = body[at + 8:at + 8 + packed]
            records = self._allowance.unpack(packing, data, size)
        except (LimitReached, MemoryError):
            raise
        except Exception:    # each compression has its own error; what is lost is lost
            raise Damaged(CHUNK_DAMAGED) from None
        if not cut and (len(records) != size or crc and zlib.crc32(records) != crc):
            raise Damaged(CHUNK_DAMAGED)
        found = self._entries(records, cut)
        found.sort(key=itemgetter(0))
        if found and not start_ns <= found[0][0] <= found[-1][0] <= max(end_ns, start_ns):
            raise Damaged(CHUNK_DAMAGED)
        return found

    def _entries(self, records: bytes, cut: bool) -> list[Entry]:
        """Return the messages among the records of a chunk; all of them are right, or Damaged."""
        found = []
        channels, head, at, end = self._channels, RECORD.unpack_from, 0, len(records)
        while at + 9 <= end:
            op, size = head(records, at)
            stop = at + 9 + size
            if stop > end:
                break
            if op == MESSAGE:
                if size < MESSAGE_HEAD.size:
                    raise Damaged(CHUNK_DAMAGED)
                key, _, time_ns, _ = MESSAGE_HEAD.unpack_from(records, at + 9)
                if key not in channels or time_ns >= LATEST_NS:
                    raise Damaged(CHUNK_DAMAGED)
                found.append((time_ns, key, records[at + 31:stop]))
            elif op in (SCHEMA, CHANNEL):
                try:
                    self._learn(op, records[at + 9:stop])
                except (struct.error, UnicodeDecodeError):
                    raise Damaged(CHUNK_DAMAGED) from None
            else:       # nothing else may stand in a chunk
                raise Damaged(CHUNK_DAMAGED)
            at = stop
        if at != end and not cut:
            raise Damaged(CHUNK_DAMAGED)
        return found

    def _learn(self, op: int, body: bytes) -> None:
        """Note a schema or a channel."""
        (key,) = struct.unpack_from('<H', body)
        if op == SCHEMA:
            name, at = text_at(body, 2)
            form, at = text_at(body, at)
            text, _ = text_at(body, at)
            self._schemas[key] = name, (FORMATS.get(form, ''), text)
        elif key not in self._channels:
            topic, at = text_at(body, 4)
            form, _ = text_at(body, at)
            (schema,) = struct.unpack_from('<H', body, 2)
            name, definition = self._schemas.get(schema, ('', ('', '')))
            self._channels[key] = Channel(topic, name, 0, form, definition)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def _said(error: Exception) -> str:
    return str(error) if isinstance(error, Damaged) else 'a damaged record'

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Read an mcap file: topics, counts and messages.

With a valid index only the chunks with the requested topics are read. Without one, or in a
damaged file, records are read from the start of the file, as far as they are valid.
"""

from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
import struct
import zlib

from odocal_ros.bagio import mcap_records as mcap
from odocal_ros.bagio.bag_file import BagFile, Batch, Channel, FileBytes, FORMATS
from odocal_ros.bagio.mcap_columns import batches
from odocal_ros.safe_io.limits import Allowance, Damaged, LATEST_NS


class McapFile(BagFile):
    """
    A file of messages in chunks.

    The size, the checksum (if any), the channels and the times of each chunk are checked. A chunk
    with any error is skipped, since other errors in it may be undetected. If the end of the file
    truncates a chunk, its complete messages are used.
    """

    def __init__(self, path: Path, allowance: Allowance) -> None:
        super().__init__(path, allowance)
        self._schemas: dict[int, tuple[str, tuple[str, str]]] = {}
        self._chunks: list[mcap.ChunkIndex] = []
        self._counted_damage = ''         # the damage known when messages were counted
        self._file = FileBytes(path)
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        """Read the index, or else count the messages by a scan."""
        try:
            if self._read_index():
                return
        except (Damaged, struct.error, UnicodeDecodeError) as error:
            self.damage = str(error) if isinstance(error, Damaged) else mcap.INDEX_DAMAGED
        self._chunks = []
        self._count()
        self._counted_damage = self.damage

    def _read_index(self) -> bool:
        """Read the index; return False if the file has none, or raise Damaged."""
        data = self._file
        footer = data[-mcap.FOOTER_SIZE:]
        if footer[-len(mcap.MAGIC):] != mcap.MAGIC or (
                footer[:mcap.RECORD.size] != mcap.RECORD.pack(mcap.FOOTER, 20)):
            raise Damaged('truncated')
        start, _, crc = struct.unpack('<QQI', footer[mcap.RECORD.size:-len(mcap.MAGIC)])
        if not start:
            return False
        if not len(mcap.MAGIC) <= start <= len(data) - mcap.FOOTER_SIZE:
            raise Damaged(mcap.INDEX_DAMAGED)
        if crc and zlib.crc32(data[start:-len(mcap.MAGIC) - 4]) != crc:
            raise Damaged(mcap.INDEX_DAMAGED)
        statistics = None
        for op, body, _ in mcap.records_of(data[start:-mcap.FOOTER_SIZE]):
            if op in (mcap.SCHEMA, mcap.CHANNEL):
                self._add_definition(op, body)
            elif op == mcap.CHUNK_INDEX:
                self._chunks.append(mcap.chunk_index_of(body))
            elif op == mcap.STATISTICS:
                statistics = mcap.statistics_of(body)
        if statistics is None or statistics[0] and not (self._chunks and self._schemas):
            return False
        count, start_ns, end_ns, counts = statistics
        if not 0 <= start_ns <= end_ns < LATEST_NS and count:
            raise Damaged(mcap.INDEX_DAMAGED)
        self._chunks = mcap.ordered_chunks(self._chunks, start)
        self._set_counts(counts, start_ns, end_ns)
        return True

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield the messages of some topics (name -> type), by time in each chunk."""
        channels = self._channels_of(topics)
        self._allowance.restart()
        for time_ns, number, raw in self._scan_records():
            if number in channels:
                yield channels[number], time_ns, raw
        self._recount()

    def _fast_batches(self, topics: Mapping[str, str]) -> Iterator[Batch] | None:
        """Return the messages in batches; None without an index."""
        return self._indexed_batches(self._channels_of(topics)) if self._chunks else None

    def _indexed_batches(self, channels: Mapping[int, Channel]) -> Iterator[Batch]:
        self._allowance.restart()
        chunks = sorted(self._with_own_times(chunk) for chunk in self._chunks
                        if not chunk.channels or chunk.channels & channels.keys())
        yield from batches(chunks, channels, self._channels, self._read_chunk,
                           self._messages_by_scan, self._report_damage)
        self._recount()

    def _with_own_times(self, chunk: mcap.ChunkIndex) -> mcap.ChunkIndex:
        """Return the entry of a chunk with the times that the chunk itself states."""
        begin = chunk.offset + mcap.RECORD.size
        start_ns, end_ns = mcap.TIMES.unpack(self._file[begin:begin + mcap.TIMES.size])
        return chunk._replace(start_ns=start_ns, end_ns=end_ns)

    def _read_chunk(self, index: mcap.ChunkIndex) -> mcap.Chunk:
        """Return a chunk from the file, with its message index, or raise Damaged."""
        data = self._file[index.offset:index.offset + index.size + index.index_size]
        content = mcap.RECORD.size      # where it begins
        if data[:content] != mcap.RECORD.pack(mcap.CHUNK, index.size - content):
            raise Damaged(mcap.CHUNK_DAMAGED)
        chunk = mcap.unpack_chunk(memoryview(data)[content:index.size], self._allowance)
        return chunk._replace(message_index=data[index.size:])

    def _report_damage(self, damage: Damaged) -> None:
        self.damage = self.damage or str(damage)

    def _recount(self) -> None:
        """Count the messages again if some of those in the index are lost."""
        if self.damage != self._counted_damage:
            self._count()
            self._counted_damage = self.damage

    def _scan(self) -> Iterator[tuple[int, int]]:
        """Yield channel number and time, ns, of every readable message."""
        self._allowance.restart()
        for time_ns, number, _ in self._scan_index() if self._chunks else self._scan_records():
            yield number, time_ns

    def _scan_index(self) -> Iterator[mcap.Entry]:
        """Yield every message in the chunks of the index."""
        for index in self._chunks:
            try:
                yield from self._messages_by_scan(self._read_chunk(index))
            except Damaged as error:
                self._report_damage(error)

    def _scan_records(self) -> Iterator[mcap.Entry]:
        """Yield every message from the first record on, chunk by chunk."""
        for op, body, is_complete in mcap.records_of(self._file, len(mcap.MAGIC)):
            try:
                if op == mcap.CHUNK:
                    chunk = mcap.unpack_chunk(body, self._allowance, not is_complete)
                    yield from self._messages_by_scan(chunk, is_truncated=not is_complete)
                elif op == mcap.MESSAGE:
                    yield self._entry(body)
                elif op in (mcap.SCHEMA, mcap.CHANNEL):
                    self._add_definition(op, body)
            except (Damaged, struct.error, UnicodeDecodeError) as error:
                self._report_damage(
                    error if isinstance(error, Damaged) else Damaged('invalid record'))

    def _messages_by_scan(self, chunk: mcap.Chunk,
                          is_truncated: bool = False) -> list[mcap.Entry]:
        """Return the messages of a chunk by time; raise Damaged if any record is invalid."""
        records, messages, offset = bytes(chunk.records), [], 0
        while (content := offset + mcap.RECORD.size) <= len(records):
            op, size = mcap.RECORD.unpack_from(records, offset)
            stop = content + size
            if stop > len(records):
                break
            try:
                if op == mcap.MESSAGE:
                    messages.append(self._entry(records[content:stop]))
                elif op in (mcap.SCHEMA, mcap.CHANNEL):
                    self._add_definition(op, records[content:stop])
                else:
                    raise Damaged('a record that is not allowed in a chunk')
            except (Damaged, struct.error, UnicodeDecodeError):
                raise Damaged(mcap.CHUNK_DAMAGED) from None
            offset = stop
        messages.sort(key=itemgetter(0))
        if (offset != len(records) and not is_truncated) or messages and not (
                chunk.start_ns <= messages[0][0]
                and messages[-1][0] <= max(chunk.end_ns, chunk.start_ns)):
            raise Damaged(mcap.CHUNK_DAMAGED)
        return messages

    def _entry(self, body: bytes) -> mcap.Entry:
        """Return the message in the content of a record; raise Damaged or struct.error."""
        number, _, time_ns, _ = mcap.MESSAGE_HEAD.unpack_from(body)
        if number not in self._channels or time_ns >= LATEST_NS:
            raise Damaged('invalid record')
        return time_ns, number, body[mcap.MESSAGE_HEAD.size:]

    def _add_definition(self, op: int, body: bytes) -> None:
        """Store the schema or the channel in the content of a record."""
        (number,) = struct.unpack_from('<H', body)
        if op == mcap.SCHEMA:
            name, offset = mcap.text_at(body, 2)
            encoding, offset = mcap.text_at(body, offset)
            text, _ = mcap.text_at(body, offset)
            self._schemas[number] = name, (FORMATS.get(encoding, ''), text)
        elif number not in self._channels:
            topic, offset = mcap.text_at(body, 4)
            encoding, _ = mcap.text_at(body, offset)
            (schema,) = struct.unpack_from('<H', body, 2)
            name, definition = self._schemas.get(schema, ('', ('', '')))
            self._channels[number] = Channel(topic, name, 0, encoding, definition)

    def close(self) -> None:
        self._file.close()

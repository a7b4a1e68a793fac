# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The records of an mcap file one by one: what they hold, and whether all of it is right."""

from operator import itemgetter
from pathlib import Path
import struct

from odocal_ros.bagio.channels import Channel, FORMATS, Recording
from odocal_ros.bagio.mcap_chunk import Chunk, CHUNK_DAMAGED
from odocal_ros.bagio.mcap_records import (
    CHANNEL,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD,
    SCHEMA,
    text_at,
)
from odocal_ros.outside.limits import Damaged, LATEST_NS

Entry = tuple[int, int, bytes]     # time, channel, message


class RecordWalk(Recording):
    """A file of records; its channels are learned as they come."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._schemas: dict[int, tuple[str, tuple[str, str]]] = {}

    def _message(self, body: bytes) -> Entry:
        key, _, time_ns, _ = MESSAGE_HEAD.unpack_from(body)
        if key not in self._channels or time_ns >= LATEST_NS:
            raise Damaged('a damaged record')
        return time_ns, key, body[MESSAGE_HEAD.size:]

    def _walked(self, chunk: Chunk, cut: bool = False) -> list[Entry]:
        """Return the messages of a chunk by time, as a walk over its records finds them."""
        found = self._entries(bytes(chunk.records), cut)
        found.sort(key=itemgetter(0))
        if found and not chunk.start_ns <= found[0][0] <= found[-1][0] <= max(
                chunk.end_ns, chunk.start_ns):
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

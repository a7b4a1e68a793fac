# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The thread of the journal: receives raw messages in a queue, and writes them to the leg's bag.

Between legs it keeps the pre-roll, the messages before a start mark, as packed chunks.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
import queue
import threading
from typing import Any

from odocal_ros.bagio.bag_file import Channel
from odocal_ros.bagio.mcap_write import pack, PackedChunk
from odocal_ros.live.journal_leg import JournalPlan, LegJournal
from odocal_ros.live.messages import definition_of

ALWAYS_NS = 1      # definition: stamp of static messages, which every journal contains
PREROLL_BYTES = 256 * 2**20    # judgement: 1 kHz for 600 s are 55 MB
StampedChunks = deque[tuple[int, PackedChunk]]      # stamp of its last message, ns, and the chunk


@dataclass
class ReceivedMessages:
    """Raw messages of one topic since the last batch."""

    topic: str
    msgtype: str
    kind: type                                          # the message class
    raws: list[bytes] = field(default_factory=list)
    sent_ns: list[int] = field(default_factory=list)    # send times: bag times of the journal
    newest_ns: int = 0                                  # stamp of the last message


class PreRoll:
    """The newest chunks of each topic that a later leg may use, limited in bytes."""

    def __init__(self) -> None:
        self._chunks: dict[str, StampedChunks] = {}
        self.size = 0

    def feed(self, slot: str, newest_ns: int, chunk: PackedChunk, preroll_ns: int) -> None:
        """Keep a chunk by the stamp of its last row; drop those more than ``preroll_ns`` older."""
        chunks = self._chunks.setdefault(slot, deque())
        chunks.append((newest_ns, chunk))
        self.size += chunk.size
        # by the topic's own stamps: a topic on another clock must not grow without limit
        while chunks[0][0] < newest_ns - preroll_ns:
            self._drop_oldest(chunks)
        while self.size > PREROLL_BYTES:
            self._drop_oldest(max(self._chunks.values(), key=_size))

    def _drop_oldest(self, chunks: StampedChunks) -> None:
        _, chunk = chunks.popleft()
        self.size -= chunk.size

    def chunks(self) -> list[PackedChunk]:
        """Return all chunks in order of time."""
        return sorted((chunk for chunks in self._chunks.values() for _, chunk in chunks),
                      key=lambda chunk: chunk.start_ns)

    def clear(self) -> None:
        """Forget all except static messages."""
        self._chunks = {slot: chunks for slot, chunks in self._chunks.items()
                        if chunks[-1][0] == ALWAYS_NS}
        self.size = sum(map(_size, self._chunks.values()))


def _size(chunks: StampedChunks) -> int:
    """Return the size of chunks, bytes."""
    return sum(chunk.size for _, chunk in chunks)


class JournalWriter:
    """
    The jobs of the journal's thread; other threads call only ``submit`` and ``close``.

    Any thread may read ``error`` (why writing fails) and ``folder`` of the newest leg.
    """

    def __init__(self) -> None:
        self.error = self.folder = ''
        self._channels: dict[int, Channel] = {}
        self._channel_numbers: dict[str, int] = {}    # by topic
        self._message_counts: dict[str, int] = {}     # by topic, packed so far
        self._preroll = PreRoll()
        self._leg: LegJournal | None = None
        self._is_recording = False                    # samples of that leg continue
        self._closed_legs: dict[int, LegJournal] = {}      # finished journals, by leg
        self._jobs: queue.SimpleQueue[tuple[Callable[..., None], Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name='odocal_journal', daemon=True)
        self._thread.start()

    def submit(self, job: Callable[..., None], *values: Any) -> None:
        """Queue a call of one of the public methods below."""
        self._jobs.put((job, values))

    def close(self, grace_s: float) -> bool:
        """Let the thread end after its queue; return True if it ended within ``grace_s``."""
        self._jobs.put(None)
        self._thread.join(grace_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            job, values = entry
            try:
                job(*values)
            except Exception as error:  # a journal error must not stop a calibration
                self._leg = None
                self.error = ('internal error, please report it: '
                              f'{type(error).__name__}: {error}')
            else:
                self._update_state()

    def _update_state(self) -> None:
        if self._leg is not None:
            self.error, self.folder = self._leg.error, self._leg.folder

    def store(self, batch: dict[str, ReceivedMessages], preroll_ns: int,
              marks: ReceivedMessages | None) -> None:
        """Pack a batch, keep it as pre-roll of later legs, and write it to the open leg."""
        chunks = []
        for slot, received in batch.items():
            chunk = self._packed(received)
            chunks.append(chunk)
            # without stamps, by the send time
            newest_ns = received.newest_ns if received.newest_ns else received.sent_ns[-1]
            self._preroll.feed(slot, newest_ns, chunk, preroll_ns)
        for leg in self._closed_legs.values():     # a mark that drops a leg must reach its journal
            if leg.late_marks:
                leg.retry()
                self.error = leg.error
        if self._leg is not None:
            mark_chunks = [self._packed(marks)] if marks else []
            self._leg.append(chunks * self._is_recording + mark_chunks)

    def restart(self) -> None:
        """Discard the pre-roll, after a jump of time."""
        self._preroll.clear()

    def begin(self, plan: JournalPlan) -> None:
        """Open the journal of a leg; its pre-roll is written with the first mark."""
        self.finish()
        self._leg = LegJournal(plan, self._channels, self._preroll.chunks())
        self._is_recording = True

    def end(self) -> None:
        """Write only marks to the open leg from now on."""
        self._is_recording = False

    def add_mark(self, leg_id: int, marks: ReceivedMessages) -> None:
        """Add a mark to the journal of a leg that is closed."""
        if leg := self._closed_legs.get(leg_id):
            leg.add_mark([self._packed(marks)])
            self.error = leg.error

    def finish(self) -> None:
        """Close the journal of the open leg and join its files."""
        leg = self._leg
        if leg is not None:
            leg.finish()
            self._update_state()
            self._closed_legs[leg.plan.leg_id] = leg
            self._leg = None

    def _packed(self, received: ReceivedMessages) -> PackedChunk:
        """Return messages as a chunk of their channel, which is created with the first ones."""
        number = self._channel_numbers.get(received.topic)
        if number is None:
            number = self._channel_numbers[received.topic] = len(self._channel_numbers) + 1
            self._channels[number] = Channel(
                received.topic, received.msgtype, definition=('msg', definition_of(received.kind)))
        first = self._message_counts.get(received.topic, 0)      # sequence number
        self._message_counts[received.topic] = first + len(received.raws)
        return pack(number, received.sent_ns, received.raws, first)

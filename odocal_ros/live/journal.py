# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The journal: a bag of each leg, written while it is driven, so that a crash loses only a second.

In: raw messages of the inputs, and statuses with the marks of legs. The thread of
``journal_writer`` writes them into the bag of ``journal_leg``.
"""

from datetime import datetime, UTC
import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.serialization import serialize_message

from odocal_ros import __version__
from odocal_ros.bagio.segments import DROPPED_EVENTS, STATUS_TYPE
from odocal_ros.live.journal_leg import JournalPlan
from odocal_ros.live.journal_writer import JournalWriter, ReceivedMessages
from odocal_ros.live.messages import message_class
from odocal_ros.live.recording import PREROLL_MARGIN_S
from odocal_ros.live.result_folders import output_root
from odocal_ros.live.session import Session
from odocal_ros.live.topic_input import Input, StaticTransforms
from odocal_ros.output.value_text import iso
from odocal_ros.safe_io.text_formats import for_shell, parameter_block
from odocal_ros.settings.config import Config, flat

BATCH_NS = 800_000_000    # judgement: including the writing, a kill loses about a second
JOURNAL_GRACE_S = 2.0     # judgement: for the last batch, once the node must stop
FILE_HEAD = """\
# Journal of a leg: 'odocal replay' on this folder computes it again with the settings below,
# which are those in force when the leg was started. They are a ROS parameter file too:
# --params-file, ros2 param load, odocal replay --config.
"""


class Journal:
    """
    Collects raw messages, and the statuses that contain the marks of the legs.

    status_topic : resolved name of ``~/status``. A leg's journal has exactly the messages of the
    recorder, so that its replay gives the same result.
    """

    def __init__(self, node: Node, status_topic: str) -> None:
        self._log, self._clock = node.get_logger(), node.get_clock()
        self._node, self._status_topic = node.get_fully_qualified_name(), status_topic
        self._writer = JournalWriter()
        self._batch: dict[str, ReceivedMessages] = {}
        self._marks: ReceivedMessages | None = None      # statuses of the leg that are not written
        self._due_ns = 0                 # steady time of the next batch
        self._limit = 0                  # bytes of all journals; 0: no journal is written
        self._preroll_ns = 0             # duration of the messages kept for later legs
        self._leg_id = 0                 # of the leg whose journal is not joined yet, 0: none
        self._is_complete = False        # all samples of this leg have come
        self._last_event = ''            # event of its last stored status
        self._dropped_legs: set[int] = set()     # numbers of legs whose drop is stored
        self._logged_error = ''          # the error that was logged last

    @property
    def error(self) -> str:
        """Return the explanation why the leg cannot be written, empty if it can."""
        return self._writer.error if self._limit else ''

    @property
    def folder(self) -> str:
        return self._writer.folder if self._limit else ''

    def store(self, source: Input | StaticTransforms, raws: list[bytes],
              sent_ns: list[int]) -> None:
        """Store messages of a topic in the order of the recorder."""
        if not self._limit:
            return
        received = self._batch.get(source.slot)
        if received is None:
            received = self._batch[source.slot] = ReceivedMessages(
                source.topic, source.msgtype, message_class(source.msgtype))
        received.raws += raws
        received.sent_ns += sent_ns
        received.newest_ns = source.newest_ns

    def tick(self, config: Config, is_busy: bool) -> None:
        """Hand over new messages if due; join the files of an ended leg once no leg is busy."""
        now_ns = time.monotonic_ns()
        if not self._update_limit(config):
            return
        if now_ns >= self._due_ns:
            self._hand_over()
        if self._is_complete and not is_busy:
            self._leg_id, self._is_complete = 0, False
            self._writer.submit(self._writer.finish)
        if self.error != self._logged_error:
            self._logged_error = self.error
            if self._logged_error:
                self._log.warning(f'the journal cannot be written: {self._logged_error}')

    def _update_limit(self, config: Config) -> int:
        """Update limit and pre-roll from the settings; return the limit, 0 for no journal."""
        if self._limit and not config.journal.max_bytes:
            self.restart()
        self._limit = config.journal.max_bytes
        # the recorder's margin, and a batch of about a second
        self._preroll_ns = round((config.leg.preroll + PREROLL_MARGIN_S + 1.0) * 1e9)
        return self._limit

    def _hand_over(self) -> None:
        self._due_ns = time.monotonic_ns() + BATCH_NS
        batch, self._batch = self._batch, {}
        marks, self._marks = self._marks, None
        if batch or marks:
            self._writer.submit(self._writer.store, batch, self._preroll_ns, marks)

    def begin(self, session: Session, topics: dict[str, str]) -> None:
        """Open the journal of the leg that the session has just started."""
        config = session.config
        if not self._update_limit(config):
            return
        self._hand_over()       # earlier messages are pre-roll
        now_ns = self._clock.now().nanoseconds
        self._leg_id, self._is_complete, self._last_event = session.leg_id, False, ''
        self._writer.submit(self._writer.begin, JournalPlan(
            session.leg_id, output_root(config, self._node) / 'journal',
            f'{iso(now_ns).replace(":", "-")}_leg_{session.leg_id}',
            journal_text(config, session.leg_id, session.start_ns, topics, self._node),
            config.journal.max_bytes))

    def store_status(self, session: Session, array: DiagnosticArray) -> None:
        """Store a published status, by which a replay finds the marks of the leg."""
        leg_id, event = session.leg_id, session.event
        is_new_drop = event in DROPPED_EVENTS and leg_id not in self._dropped_legs
        if is_new_drop:
            self._dropped_legs.add(leg_id)
        if leg_id != self._leg_id and not is_new_drop:
            return
        marks = self._marks if leg_id == self._leg_id else None
        marks = marks or ReceivedMessages(self._status_topic, STATUS_TYPE, DiagnosticArray)
        marks.raws.append(serialize_message(array))
        marks.sent_ns.append(self._clock.now().nanoseconds)
        if leg_id != self._leg_id:      # of a journal that is closed
            self._writer.submit(self._writer.add_mark, leg_id, marks)
            return
        self._marks = marks
        if event != self._last_event:
            self._last_event = event
            self._hand_over()

    def end(self) -> None:
        """Note that the leg's samples are complete: later ones belong to no leg."""
        if self._leg_id and not self._is_complete:
            self._hand_over()
            self._is_complete = True
            self._writer.submit(self._writer.end)

    def restart(self) -> None:
        """Discard the samples so far, after a jump of time."""
        self._batch = {}
        self._writer.submit(self._writer.restart)

    def close(self) -> bool:
        """Write the rest; files of a long leg may stay separate; return True if all is done."""
        self._hand_over()
        self._writer.submit(self._writer.finish)
        return self._writer.close(JOURNAL_GRACE_S)


def journal_text(config: Config, leg_id: int, start_ns: int, topics: dict[str, str],
                 node: str = '') -> str:
    """Return the text of journal.yaml; ``topics`` are slot -> topic, ``node`` its full name."""
    about = {'software': f'odocal_ros {__version__}', 'node': node, 'leg_id': leg_id,
             'leg_start_ns': start_ns}
    about |= {f'topics.{slot}': topic for slot, topic in topics.items()}
    return FILE_HEAD + parameter_block(flat(config)) + parameter_block(about, 'odocal_journal')


def replay_command(folder: str, start_ns: int = 0) -> str:
    """Return the command that computes a leg from its mark, if given, to the journal's end."""
    seconds, nanoseconds = divmod(start_ns, 10**9)
    start = f'{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{nanoseconds // 1000:06}'
    return for_shell(['odocal', 'replay', folder, *(['--leg', f'{start}/'] if start_ns else [])])

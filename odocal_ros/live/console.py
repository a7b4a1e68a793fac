# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Texts that a node logs: missing inputs (repeated), readiness, problems of the leg, lost messages.

Each text appears when it becomes true, so that an operator can read the console during a drive.
"""

import re
from typing import Any

from odocal_ros.live.session import SessionView, State
from odocal_ros.output.value_text import counted
from odocal_ros.reasons import Code
from odocal_ros.safe_io.text_formats import brief_line

# judgement: delay of the first log of missing inputs, and largest interval of its repetitions
MISSING_LOG_DELAY_NS, MAX_MISSING_LOG_INTERVAL_NS = 5 * 10**9, 3600 * 10**9
LOSS_FACTOR = 10  # judgement: growth of a count of lost messages after which it is reported again
NUMBER = re.compile(r'\d+')


class PlainLog:
    """A logger of rclpy that only gets single lines without control characters."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger

    # one method each: rclpy requires that a line of the caller always has the same severity
    def debug(self, text: str) -> None:
        self._logger.debug(brief_line(text))

    def info(self, text: str) -> None:
        self._logger.info(brief_line(text))

    def warning(self, text: str) -> None:
        self._logger.warning(brief_line(text))

    def error(self, text: str) -> None:
        self._logger.error(brief_line(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)


class TopicReport:
    """Reports topics with several publishers once, and losses when they are LOSS_FACTOR larger."""

    def __init__(self) -> None:
        self._reported_counts: dict[str, int] = {}
        self._reported_duplicates: set[str] = set()

    def new_texts(self, lost: dict[str, int], duplicate_publishers: list[str]) -> list[str]:
        """Return new sentences on losses and publishers; lost : messages by topic so far."""
        texts = [text for text in dict.fromkeys(duplicate_publishers) if text
                 and text not in self._reported_duplicates]
        self._reported_duplicates.update(texts)
        for topic, count in lost.items():
            reported = self._reported_counts.get(topic, 0)
            if count < reported:
                reported = self._reported_counts[topic] = 0
            if count >= max(1, LOSS_FACTOR * reported):
                self._reported_counts[topic] = count
                texts.append(f'{losses_text({topic: count})}. Likely cause: CPU load or '
                             'network. Reduce the load, or set the QoS of the topic to reliable')
        return texts


def losses_text(lost: dict[str, int]) -> str:
    """Return the counts as text, empty if nothing was lost in a queue or on the network."""
    return ', '.join(f'{counted(count, "message")} of {topic} lost'
                     for topic, count in lost.items() if count)


class Console:
    """Logs changes of the status, and repeats missing inputs at growing intervals."""

    def __init__(self, log: PlainLog) -> None:
        self._log = log
        self._ready_logged = self._missing_logged = False
        self._topics = TopicReport()
        self._due_ns = 0             # time of the next log of missing inputs
        self._pause_ns = MISSING_LOG_DELAY_NS      # until the one after it
        self._missing_text = ''      # missing inputs of the last view, numbers removed
        self._leg_id = 0             # the leg whose faults are logged
        self._logged_faults: set[Code] = set()      # of this leg
        self._logged_ends: set[Code] = set()        # faults logged as no longer valid

    def report(self, view: SessionView, steady_ns: int) -> None:
        self._log_faults(view)
        for text in self._topics.new_texts(view.lost_messages, view.duplicate_publishers):
            self._log.warning(text)
        if view.missing_inputs:
            self._log_missing(view, steady_ns)
        else:
            self._log_complete(view)

    def _log_missing(self, view: SessionView, steady_ns: int) -> None:
        text = NUMBER.sub('', '; '.join(view.missing_inputs))
        if self._missing_logged and text != self._missing_text:    # other publishers, other inputs
            self._pause_ns = MISSING_LOG_DELAY_NS
            self._due_ns = min(self._due_ns, steady_ns + MISSING_LOG_DELAY_NS)
        self._missing_text = text
        if not self._due_ns:     # an input lost after the start is logged at once
            self._due_ns = steady_ns + (0 if self._ready_logged else MISSING_LOG_DELAY_NS)
        if steady_ns >= self._due_ns:
            state_text = '' if self._ready_logged else 'waiting: '
            self._log.warning(state_text + '; '.join(view.missing_inputs))
            self._missing_logged = True
            self._pause_ns = min(2 * self._pause_ns, MAX_MISSING_LOG_INTERVAL_NS)
            self._due_ns = steady_ns + self._pause_ns

    def _log_complete(self, view: SessionView) -> None:
        self._due_ns, self._pause_ns = 0, MISSING_LOG_DELAY_NS
        if not self._ready_logged:
            rates = ', '.join(f'{slot} {hz:.0f} Hz' for slot, hz in view.rates_hz.items() if hz)
            action = ('legs start and end automatically' if view.config.leg.automatic else
                    'stand still for 10 s, then call ~/start_leg')
            self._log.info(f'ready ({rates}): {action}' if rates else f'ready: {action}')
        elif self._missing_logged:
            self._log.info('all inputs are available again')
        self._ready_logged, self._missing_logged = True, False

    def _log_faults(self, view: SessionView) -> None:
        """Log the problems of the current leg, each once."""
        leg_id = view.session.leg_id
        if self._leg_id != leg_id:
            self._leg_id, self._logged_faults, self._logged_ends = leg_id, set(), set()
        for fault in view.faults:
            if fault.code not in self._logged_faults:
                self._logged_faults.add(fault.code)
                self._log.warning(f'leg {leg_id}: {fault}. {fault.remedy}')
        if view.session.state is not State.RECORDING:
            return
        ended = self._logged_faults - self._logged_ends - {fault.code for fault in view.faults}
        for code in sorted(ended, key=lambda code: code.name):
            self._logged_ends.add(code)
            self._log.info(f'leg {leg_id}: {code.name} no longer applies: later messages '
                           'contradict it')

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Names from outside (frames, topics, types, joints, files), made safe for each format.

Writers of such a name use the function of their format; a frame is taken only where
ROS takes it, since files that are acted on name it.
"""

import re
import shlex

# what may stand raw in a line: no control, no half of a surrogate pair, nothing that turns writing
UNSEEN = re.compile('[\x00-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202f\u2060-\u206f'
                    '\ufeff\ufff9-\ufffb\ud800-\udfff]')
# of our own on a terminal: these words alone, not what others send
VERDICT_STYLE = re.compile('(\x1b\\[1;3[123]m(?:ACCEPTED|CAUTION|REJECTED)\x1b\\[0m)')
LONGEST_LINE = 2000       # judgement: characters of one line of a log, a panel or an error
FRAME = re.compile(r'[A-Za-z0-9_][A-Za-z0-9_./-]{0,199}')


def one_line(text: object) -> str:
    """Return text as one line, what cannot be seen in it shown as an escape sequence."""
    return _seen(str(text))


def brief_line(text: object) -> str:
    """Return text as ``one_line`` has it, cut at LONGEST_LINE: for a log, a panel, an error."""
    # cut first: what is shown of a control character is up to ten times as long
    line = _seen(str(text)[:LONGEST_LINE + 1])
    return line if len(line) <= LONGEST_LINE else f'{line[:LONGEST_LINE]} ...'


def said_by(error: BaseException) -> str:
    """Return the text of an error as one line, bounded."""
    return brief_line(' '.join(str(error)[:10 * LONGEST_LINE].split()))


def for_terminal(text: str) -> str:
    """Return lines for a terminal: nothing in them moves its cursor or sets its state."""
    parts = VERDICT_STYLE.split(text)
    parts[::2] = ['\n'.join(map(_seen, part.split('\n'))) for part in parts[::2]]
    return ''.join(parts)


def _seen(text: str) -> str:
    return UNSEEN.sub(lambda match: match[0].encode('unicode_escape').decode(), text)


def is_frame(name: str) -> bool:
    """Return True if a frame name is valid in tf2 and safe in every file that contains it."""
    return FRAME.fullmatch(name) is not None


def for_comment(text: str) -> str:
    """Return lines as comment lines of YAML, a shell or a table."""
    return ''.join(f'# {one_line(line)}\n' for line in text.split('\n'))


def for_table(text: str) -> str:
    """Return text as a cell that no spreadsheet takes for a formula."""
    return f"'{text}" if text.startswith(('=', '+', '-', '@')) else text


def for_xml_comment(text: str) -> str:
    """Return lines for the inside of an XML comment, which no ``--`` may be in."""
    return re.sub('-(?=-)', '- ', '\n'.join(map(one_line, text.split('\n'))))


def for_launch(words: list[str]) -> str:
    """Return the words of a command as an attribute of a launch file: nothing is substituted."""
    return re.sub(r'([\\$"\'])', r'\\\1', for_shell(words))


def for_shell(words: list[str]) -> str:
    """Return the words of a command as a shell takes them, each as it is."""
    return shlex.join(map(one_line, words))

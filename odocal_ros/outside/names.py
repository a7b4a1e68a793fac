# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Untrusted names (frames, topics, types, joints, files), made safe for each format.

Writers of such a name use the function of their format. A frame is accepted only if
ROS accepts it, since programs act on files that contain it.
"""

import re
import shlex

# never raw in a line: control characters, half surrogate pairs, changes of the writing direction
UNSEEN = re.compile('[\x00-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202f\u2060-\u206f'
                    '\ufeff\ufff9-\ufffb\ud800-\udfff]')
# our own colours on a terminal: of these words only, not of input text
VERDICT_STYLE = re.compile('(\x1b\\[1;3[123]m(?:ACCEPTED|CAUTION|REJECTED)\x1b\\[0m)')
LONGEST_LINE = 2000       # judgement: characters of one line of a log, a panel or an error
FRAME = re.compile(r'[A-Za-z0-9_][A-Za-z0-9_./-]{0,199}')


def one_line(text: object) -> str:
    """Return text as one line, invisible characters as escape sequences."""
    return _seen(str(text))


def brief_line(text: object) -> str:
    """Return ``one_line`` of a text, cut at LONGEST_LINE, for a log, a panel or an error."""
    # cut first: an escape sequence is up to ten times as long as its character
    line = _seen(str(text)[:LONGEST_LINE + 1])
    return line if len(line) <= LONGEST_LINE else f'{line[:LONGEST_LINE]} ...'


def said_by(error: BaseException) -> str:
    """Return the text of an error as one line of limited length."""
    return brief_line(' '.join(str(error)[:10 * LONGEST_LINE].split()))


def for_terminal(text: str) -> str:
    """Return lines for a terminal that neither move its cursor nor set its state."""
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
    """Return text as a cell that no spreadsheet reads as a formula."""
    return f"'{text}" if text.startswith(('=', '+', '-', '@')) else text


def for_xml_comment(text: str) -> str:
    """Return lines for the inside of an XML comment, without ``--``."""
    return re.sub('-(?=-)', '- ', '\n'.join(map(one_line, text.split('\n'))))


def for_launch(words: list[str]) -> str:
    """Return the words of a command as an attribute of a launch file: nothing is substituted."""
    return re.sub(r'([\\$"\'])', r'\\\1', for_shell(words))


def for_shell(words: list[str]) -> str:
    """Return the words of a command quoted for a shell."""
    return shlex.join(map(one_line, words))

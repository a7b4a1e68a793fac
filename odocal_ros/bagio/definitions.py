# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Definitions of message types that a bag brings: parsed by rosbags, in bounded time."""

from collections.abc import Iterator
from contextlib import contextmanager
import re
import signal
import threading
from typing import Any

from odocal_ros.errors import BadUsage

BAR = '=' * 80 + '\n'    # format: between definitions, of ros2msg in mcap.dev/spec/registry
TOKEN = re.compile(r'"(?:[^"\\\n]|\\.)*"|//[^\n]*|/\*.*?\*/|@\s*[\w:]+|[()]|[^"/@()]+|.',
                   re.DOTALL)


@contextmanager
def rosbags_for(what: str) -> Iterator[None]:
    """Raise BadUsage if an import of rosbags, which is optional, fails; ``what`` needs it."""
    try:
        yield
    except ModuleNotFoundError:
        raise BadUsage(f'{what} needs the Python package rosbags, which is not installed: '
                       'pip install rosbags') from None


def parsed(msgtype: str, form: str, text: str) -> dict[str, Any]:
    """Return the fields of a type and those it stands on; form is 'msg' or 'idl'."""
    with rosbags_for('a non-standard message type'):
        from rosbags.typesys import get_types_from_idl, get_types_from_msg
    if form == 'msg':
        return get_types_from_msg(text, msgtype)
    parts = [part.split('\n', 1)[1] for part in text.split(BAR)[1:]] if text.startswith(
        f'{BAR}IDL: ') else [text]
    found: dict[str, Any] = {}
    for part in parts:
        found.update(get_types_from_idl(bare(part)))
    return found


def bare(text: str) -> str:
    """
    Return IDL without comments and annotations, which say nothing of a layout and parse slowly.

    Raises ValueError for constants that are computed: messages have none, and 1 << 2**40 is large.
    """
    kept, depth, annotated = [], 0, False
    for token in TOKEN.findall(text):
        if depth:
            depth += (token == '(') - (token == ')')
        elif token.startswith('@'):
            annotated = True
        elif annotated and token == '(':
            depth, annotated = 1, False
        elif token.startswith(('//', '/*')):
            kept.append(' ')
        else:
            annotated = annotated and token.isspace()
            kept.append(token)
    plain = ''.join(kept)
    if '<<' in plain or '*' in plain:
        raise ValueError('computed constants')
    return plain


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in what runs longer; without effect in other threads than the main."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(*_: Any) -> None:
        raise TimeoutError(f'it takes longer than {seconds:g} s')
    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)

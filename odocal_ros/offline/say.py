# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Output of the commands: the only access to the terminal, safe for untrusted names."""

import json
from shutil import get_terminal_size
import sys
import threading
from typing import Any

from odocal_ros.safe_io.text_formats import brief_line, for_terminal

BAR = '{desc:<26} {percentage:3.0f} % |{bar:24}| {elapsed}'
CLOCK = '{desc:<26} {elapsed}'


def say(text: str, end: str = '\n') -> None:
    """Print lines on stdout."""
    print(for_terminal(text), end=end)


def say_json(content: Any) -> None:
    say(json.dumps(content, indent=2, allow_nan=False))


def warn(text: str) -> None:
    """Print one line on stderr."""
    print(brief_line(text), file=sys.stderr)


class Phase:
    """
    A phase of the work, as a context; called with the fraction done, if known.

    title : of the work.   quiet : show nothing. Nothing is shown either if the error stream is no
    terminal.
    """

    def __init__(self, title: str, quiet: bool = False) -> None:
        self._title = title
        self._shown = not quiet and sys.stderr is not None and sys.stderr.isatty()
        self._over = threading.Event()

    def __enter__(self) -> 'Phase':
        if self._shown:
            from tqdm import tqdm
            columns, rows = get_terminal_size()     # 80, 24 if the terminal gives none
            self._bar = tqdm(total=1.0, desc=self._title, leave=False, file=sys.stderr,
                             bar_format=CLOCK, mininterval=0.0,
                             ncols=columns, nrows=rows)
            self._ticker = threading.Thread(target=self._tick, daemon=True)
            self._ticker.start()
        return self

    def __call__(self, share: float | None, title: str = '') -> None:
        """Set the fraction done, None if unknown, and the new title if there is one."""
        if self._shown:
            self._bar.bar_format = CLOCK if share is None else BAR
            if title:
                self._bar.set_description_str(title, refresh=False)
            self._bar.n = min(max(share or 0.0, 0.0), 1.0)
            self._bar.refresh()

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._over.set()
            self._ticker.join()
            self._bar.close()

    def _tick(self) -> None:
        tick_s = 0.5    # the clock of a phase runs without reports
        while not self._over.wait(tick_s):
            self._bar.refresh()

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Receivers of notes and progress: commands print them, other programs need not."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

# called with the fraction done, 0 to 1 or None if unknown, and the current stage
Progress = Callable[..., None]


class Listener:
    """Receive notes and phases of the work; this one ignores them."""

    def note(self, text: str) -> None:
        """Receive a note for the user."""

    def phase(self, title: str) -> AbstractContextManager[Progress]:
        """Return a context for a phase of the work; its value receives the fraction done."""
        return nullcontext(lambda share, stage='': None)


class Notes(Listener):
    """Store the notes, and forward everything."""

    def __init__(self, onward: Listener) -> None:
        self.said: list[str] = []
        self._onward = onward

    def note(self, text: str) -> None:
        """Store and forward a note."""
        self.said.append(text)
        self._onward.note(text)

    def phase(self, title: str) -> AbstractContextManager[Progress]:
        """Return the phase of the next listener."""
        return self._onward.phase(title)

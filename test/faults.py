"""A disk that refuses: one step, or every step from one on."""

import errno
import os

from odocal_ros import whole
from odocal_ros.bagio import segments
from odocal_ros.output import folder


class Refusing:
    """
    Counts the steps of ``whole.disk`` and refuses some.

    at : the first that is refused, 0 for none.   for_ever : so are those after it.
    """

    def __init__(self, at: int, code: int = errno.ENOSPC, for_ever: bool = False) -> None:
        self.at, self.code, self.for_ever, self.steps = at, code, for_ever, []

    def __call__(self, step, *values):
        self.steps.append(getattr(step, '__name__', str(step)))
        count = len(self.steps)
        if self.at and (count == self.at or self.for_ever and count > self.at):
            raise OSError(self.code, os.strerror(self.code), 'refused')
        return step(*values)

    def put_in(self, monkeypatch) -> 'Refusing':
        """Take the place of the disk."""
        for module in (whole, segments, folder):
            monkeypatch.setattr(module, 'disk', self)
        return self

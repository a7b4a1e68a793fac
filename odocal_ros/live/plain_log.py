# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node's log: lines in which nothing from outside steers the terminal they are read on."""

from typing import Any

from odocal_ros.outside.names import brief_line


class PlainLog:
    """A logger of rclpy, given one visible line at a time."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger

    # rclpy distinguishes callers by their lines, and wants one severity of each
    def debug(self, text: str) -> None:
        """Log for developers."""
        self._logger.debug(brief_line(text))

    def info(self, text: str) -> None:
        """Log what goes as it should."""
        self._logger.info(brief_line(text))

    def warning(self, text: str) -> None:
        """Log problems that the operator can fix."""
        self._logger.warning(brief_line(text))

    def error(self, text: str) -> None:
        """Log what failed."""
        self._logger.error(brief_line(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)

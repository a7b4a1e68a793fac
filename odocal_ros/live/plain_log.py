# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

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

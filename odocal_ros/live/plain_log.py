"""The node's log: lines in which nothing from outside steers the terminal they are read on."""

from odocal_ros.outside.names import one_line


class PlainLog:
    """A logger of rclpy, given one visible line at a time."""

    def __init__(self, logger) -> None:
        self._logger = logger

    # rclpy tells callers apart by their lines, and wants one severity of each
    def debug(self, text: str) -> None:
        """Log for developers."""
        self._logger.debug(one_line(text))

    def info(self, text: str) -> None:
        """Log what goes as it should."""
        self._logger.info(one_line(text))

    def warning(self, text: str) -> None:
        """Log what the operator may mend."""
        self._logger.warning(one_line(text))

    def error(self, text: str) -> None:
        """Log what failed."""
        self._logger.error(one_line(text))

    def __getattr__(self, name: str):
        return getattr(self._logger, name)

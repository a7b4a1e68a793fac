# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Main function of all nodes: command line, start, spin, signals, end.

A node that cannot start prints one line with cause and action in place of a traceback.
"""

from collections.abc import Callable
import os
import signal
import sys
import tempfile
from typing import Any

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args

from odocal_ros import __version__
from odocal_ros.errors import BadConfig, OdocalError
from odocal_ros.live.console import PlainLog
from odocal_ros.live.worker import limit_kept_memory
from odocal_ros.safe_io.text_formats import brief_line, error_text

NAME_CHECK_PERIOD_S = 5.0      # judgement: s between searches for another node of the same name


class CheckedNode(Node):
    """Base of the nodes, which create their parts in ``_build``; BadConfig: a wrong parameter."""

    default_name = ''

    def __init__(self, node_name: str = '', **kwargs: Any) -> None:
        try:
            super().__init__(node_name or self.default_name, **kwargs)
            try:
                self._build()
                self._name_timer = self.steady_timer(NAME_CHECK_PERIOD_S, self._check_name)
            except Exception:
                self.destroy_node()  # type: ignore[no-untyped-call]
                raise
        except (ParameterException, InvalidQosOverridesError) as error:
            raise BadConfig(f'{error_text(error)}; correct the parameter and restart') from None

    def _build(self) -> None:
        raise NotImplementedError

    def steady_timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Create a timer that also runs while /clock is paused or missing."""
        return self.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def spin(self, executor: Executor) -> None:
        executor.spin()

    def _check_name(self) -> None:
        """Log once if another node has the same name."""
        own_name = self.get_name(), self.get_namespace()
        if self.get_node_names_and_namespaces().count(own_name) > 1:
            self._name_timer.cancel()
            self.get_logger().warning(
                f'another node is called {self.get_fully_qualified_name()}: services, parameters '
                'and topics conflict; stop one, or rename it with -r __node:=NAME')

    def get_logger(self) -> PlainLog:
        return PlainLog(super().get_logger())  # type: ignore[no-untyped-call]


def run(kind: type[CheckedNode], about: str, args: list[str] | None = None) -> int:
    """
    Run a node until it must stop.

    kind : class of the node; its default name is that of the command.   about : text of --help.

    Returns 0 after SIGINT, SIGTERM or a shutdown of the context, and after printing help or
    version; 1 if it cannot start, with the cause in one line.
    """
    limit_kept_memory()
    name = kind.default_name
    # rclpy's handler ends the context on either signal, and calls this one: no KeyboardInterrupt
    signal.signal(signal.SIGINT, lambda *_: None)
    try:
        arguments = remove_ros_args(args)[1:]
        if {'-h', '--help'} & set(arguments):
            print(about)
            return 0
        if '--version' in arguments:
            print(f'odocal_ros {__version__}')
            return 0
        if arguments:
            return print_error(name, f'{arguments[0]} is unknown: settings are ROS parameters '
                               f'after --ros-args (see {name} --help)')
        _init(args)
    except Exception as error:
        text = error_text(error).split(', at /')[0]
        return print_error(name, f'{text}; write parameters as --ros-args -p name:=value, remaps '
                           'as -r from:=to')
    return _spin(kind)


def _spin(kind: type[CheckedNode]) -> int:
    """Run a node until it must stop; return the exit code."""
    executor, node, code = SingleThreadedExecutor(), None, 0
    try:
        node = kind()
        executor.add_node(node)
        node.spin(executor)
    except ExternalShutdownException:
        pass
    except OdocalError as error:
        code = print_error(kind.default_name, str(error))
    except Exception as error:
        # during a shutdown, the publisher of a callback may be destroyed already
        code = print_error(kind.default_name, error_text(error)) if rclpy.ok() else 0
    finally:
        executor.shutdown()
        if node is not None:
            node.destroy_node()  # type: ignore[no-untyped-call]
        rclpy.try_shutdown()
    if getattr(node, 'has_running_thread', False):
        # Python aborts if it ends while a thread runs C++ code; the files on disk are complete
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def _init(args: list[str] | None) -> None:
    """Start rclpy; an error raises an exception, without rcl's own line on stderr."""
    sys.stderr.flush()
    stderr = os.dup(2)
    with tempfile.TemporaryFile() as buffer:
        os.dup2(buffer.fileno(), 2)
        try:
            rclpy.init(args=args)
            buffer.seek(0)
            os.write(stderr, buffer.read())
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


def print_error(name: str, text: str) -> int:
    """Print the cause of a command's failure on stderr; return its exit code."""
    print(brief_line(f'{name}: {text}'), file=sys.stderr)
    return 1

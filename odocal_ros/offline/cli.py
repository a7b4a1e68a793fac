# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The odocal command: imports and runs the module of a subcommand.

Every error ends as one line on stderr and an exit code. Text goes to the terminal through
``print_text`` and ``warn``, since names in bags are untrusted. ``OdocalCommand`` is the same
command as an extension of ros2cli, ``ros2 odocal``.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
import importlib
import json
import os
from shutil import get_terminal_size
import sys
import tempfile
import threading
from types import ModuleType
from typing import Any, NoReturn

from odocal_ros import __version__
from odocal_ros.errors import BadTopics, BadUsage, OdocalError, unknown_name
from odocal_ros.safe_io.text_formats import brief_line, for_terminal

COMMANDS = {      # name: (its module, or the package that has it as an entry point; description)
    'try': ('odocal_ros.offline.try_bag', 'inspect a bag, calibrate, open the report'),
    'replay': ('odocal_ros.offline.replay', 'calibrate from recorded bags'),
    'fleet': ('odocal_ros.fleet.command', 'calibrate many vehicles from many bags in parallel'),
    'inspect': ('odocal_ros.offline.inspect_bag', 'show the content of a bag and what is missing '
                'for a calibration'),
    'simulate': ('odocal_ros.offline.simulate', 'write a bag with known truth'),
    'plan': ('odocal_ros.offline.plan', 'predict the uncertainties of a planned drive'),
    'watch': ('odocal_ros.live.node_commands', 'show the progress of a running node'),
    'doctor': ('odocal_ros.offline.doctor', 'show the installation, for bug reports'),
    'compare': ('odocal_ros.offline.compare', 'show changes between calibrations'),
    'paper': ('odocal_reproductions', 'reproduce tables 1-4 of Shi et al. 2015, two-point method'),
    'patent': ('odocal_reproductions', 'compute the example of patent CN104359492A'),
}
OK, REJECTED, WRONG_USE, INTERNAL, INTERRUPTED = 0, 1, 2, 3, 130    # definition: exit codes
# formats of tqdm for a phase with and without a known fraction
BAR = '{desc:<26} {percentage:3.0f} % |{bar:24}| {elapsed}'
CLOCK = '{desc:<26} {elapsed}'


class OdocalCommand:
    """Calibrate a vehicle's odometer against IMU and GNSS, from recorded bags."""

    NAME = 'odocal'
    EXTENSION_POINT_VERSION = '0.1'

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Declare that all arguments after the command belong to odocal."""
        parser.add_argument('argv', nargs=argparse.REMAINDER, metavar='COMMAND ...',
                            help=f'a command of odocal and its options; {cli_name} COMMAND --help')
        parser.epilog = 'commands:\n' + '\n'.join(
            f'  {name:<10}{about}' for name, (_, about) in COMMANDS.items())

    def main(self, *, parser: argparse.ArgumentParser, args: argparse.Namespace) -> int:
        return main(args.argv)


class _Parser(argparse.ArgumentParser):
    """Reports errors in one line, without the whole usage."""

    def error(self, message: str) -> NoReturn:
        """Raise an error that ``main`` reports in one line, with exit code 2."""
        raise _Usage(f'{self.prog}: {message} (see {self.prog} --help)')

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown arguments here: the parser of the command names its own help."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            options = [word for word in unknown if word.startswith('-')] or unknown
            similar = get_close_matches(options[0], self._option_string_actions, 1, 0.75)
            self.error(f'unrecognized arguments: {" ".join(options)}'
                       + ''.join(f'; did you mean {name}?' for name in similar))
        return parsed, unknown


class _Usage(OdocalError):
    """The command line cannot be parsed."""


def _parser(command_name: str) -> argparse.ArgumentParser:
    """Return the parser, with the options of one command: only its module is imported."""
    parser = _Parser(prog='odocal', description="Calibrate a vehicle's odometer against IMU and "
                     'GNSS: scale factor and yaw mounting angle, with reliable uncertainties.')
    parser.add_argument('--version', action='version', version=f'odocal_ros {__version__}')
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', parser_class=_Parser)
    for name, (_, help_line) in COMMANDS.items():
        sub = commands.add_parser(name, help=help_line, description=help_line)
        if name == command_name:
            command = _module_of(name)
            command.add_arguments(sub)
            sub.set_defaults(run=command.run)
    return parser


def _module_of(name: str) -> ModuleType:
    """Return the module of a command, which has ``add_arguments`` and ``run``."""
    origin = COMMANDS[name][0]
    if origin.startswith('odocal_ros.'):
        return importlib.import_module(origin)
    from importlib.metadata import entry_points
    for entry in entry_points(group='odocal.commands', name=name):
        module: ModuleType = entry.load()
        return module
    raise BadUsage(f'{name} is a command of {origin}, which is not installed; install it from a '
                   'checkout of odocal_ros: pip install ./reproductions')


def main(argv: list[str] | None = None) -> int:
    """Run a command and return its exit code; errors are lines on stderr."""
    if sys.stdout is None:       # closed by the parent process
        sys.stdout = open(os.devnull, 'w', encoding='utf-8')     # noqa: SIM115 until exit
    for stream in (sys.stdout, sys.stderr):      # a terminal without ± shows ? instead
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors='replace')
    try:
        return _run(sys.argv[1:] if argv is None else list(argv))
    except KeyboardInterrupt as stopped:
        warn(f'odocal: interrupted, {str(stopped) or "nothing written"}')
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except Exception as error:     # noqa: BLE001 users get a line and a file, no trace
        for line in _error_lines(error):
            warn(line)
        return WRONG_USE if isinstance(error, OdocalError | OSError | MemoryError) else INTERNAL


def _run(argv: list[str]) -> int:
    if argv and argv[0] not in COMMANDS and not argv[0].startswith('-'):
        raise _Usage(f'odocal: no command {argv[0]!r}; {unknown_name(argv[0], COMMANDS)} '
                     '(see odocal --help)')
    parser = _parser(argv[0] if argv else '')
    args = parser.parse_args(argv)
    if args.command is None:
        parser.print_help()
        return WRONG_USE
    code: int = args.run(args)
    sys.stdout.flush()       # here, where a full disk can still be reported
    return code


def _error_lines(error: Exception) -> list[str]:
    """Return the text on an error; the trace of an internal error is in the file it names."""
    if isinstance(error, OdocalError):
        text = f'{error}' if isinstance(error, _Usage) else f'odocal: {error}'
        return text.split('\n') if isinstance(error, BadTopics) else [text]
    if isinstance(error, OSError):       # a full disk, a closed stream
        return [f'odocal: {error.filename or "output"}: {error.strerror or error}']
    if isinstance(error, MemoryError):
        return ['odocal: out of memory; close other programs, or replay a shorter bag or a '
                'section (--leg A:B)']
    import traceback
    path = trace_file(''.join(traceback.format_exception(error)))
    first = (str(error).splitlines() or [''])[0][:200]
    return [f'odocal: internal error ({type(error).__name__}: {first}); please report it with '
            f'{path}']


def trace_file(text: str) -> str:
    """Write a trace for developers to a new file; return its path."""
    with tempfile.NamedTemporaryFile('w', prefix='odocal_trace_', suffix='.txt', delete=False,
                                     encoding='utf-8', errors='backslashreplace') as f:
        f.write(f'odocal_ros {__version__}, Python {sys.version}\n{" ".join(sys.argv)}\n\n{text}')
    return f.name


def print_text(text: str, end: str = '\n') -> None:
    print(for_terminal(text), end=end)


def print_json(content: Any) -> None:
    print_text(json.dumps(content, indent=2, allow_nan=False))


def warn(text: str) -> None:
    """Print one line on stderr."""
    print(brief_line(text), file=sys.stderr)


@contextmanager
def show_phase(title: str, quiet: bool = False) -> Iterator[Callable[..., None]]:
    """
    Show title and clock of a phase of the work, on a terminal only; yield ``set_progress``.

    set_progress(fraction, title) : fraction done, None if unknown, and a new title, if any.
    """
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield lambda fraction, title='': None
        return
    from tqdm import tqdm
    columns, rows = get_terminal_size()     # 80, 24 if the terminal gives none
    with tqdm(total=1.0, desc=title, leave=False, file=sys.stderr, bar_format=CLOCK,
              mininterval=0.0, ncols=columns, nrows=rows) as bar:
        def set_progress(fraction: float | None, title: str = '') -> None:
            bar.bar_format = CLOCK if fraction is None else BAR
            if title:
                bar.set_description_str(title, refresh=False)
            bar.n = min(max(fraction or 0.0, 0.0), 1.0)
            bar.refresh()

        def tick() -> None:
            tick_s = 0.5    # the clock runs without reports
            while not is_over.wait(tick_s):
                bar.refresh()

        is_over, ticker = threading.Event(), threading.Thread(target=tick, daemon=True)
        ticker.start()
        try:
            yield set_progress
        finally:
            is_over.set()
            ticker.join()


if __name__ == '__main__':
    sys.exit(main())

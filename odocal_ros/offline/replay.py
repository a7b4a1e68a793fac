# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal replay: calibrate from recorded bags as the node does; options shared by commands."""

import argparse
from contextlib import AbstractContextManager
import os
from pathlib import Path
from shutil import get_terminal_size
import sys
from textwrap import fill
from typing import Any, TYPE_CHECKING

from odocal_ros.data.inputs import INPUTS, topic_option, TOPICS
from odocal_ros.errors import BadUsage
from odocal_ros.library.arguments import legs_of, Listener, Progress
from odocal_ros.offline.cli import print_json, print_text, show_phase, warn
from odocal_ros.safe_io.text_formats import one_line

if TYPE_CHECKING:
    from odocal_ros.calib.result import Calibration as Combined
    from odocal_ros.library.calibration import Calibration
    from odocal_ros.settings.config import Config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('bags', nargs='+', metavar='BAG', help='bag folder or file; several: legs of one vehicle')
    add_calibration_arguments(parser)
    add('--holdout', action='store_true', help='exclude the last fifth of each leg from the fit '
        'and check the correction on it')
    add('--mark', action='append', type=float, default=[], metavar='T', dest='marks',
        help='the robot stands on a point of reference.points at T seconds from the first '
        'message; repeatable, in the order of the points')
    add('--output', metavar='DIR', help='folder for the results (default ./odocal_<bag>)')
    add('--export', metavar='FILES', action='append', default=[],
        help='time series files, separated by commas or repeatable: trajectory.tum, states.csv, '
        'residuals.parquet, track.kml, scale_by_speed.png, debug.mcap, drive.rrd ...')
    add('--force', action='store_true', help='replace an existing calibration.json')
    parser.set_defaults(brief=False)      # only ``odocal try`` prints the short form
    add('--json', action='store_true', help='print calibration.json on stdout, nothing else')
    add('--quiet', action='store_true', help='print only errors, and with --accept its line')


def add_input_arguments(parser: argparse.ArgumentParser,
                        default: str = 'the only topic of a fitting type') -> None:
    """Declare the options for settings and topics; default: text on the topic used without one."""
    add_settings_arguments(parser)
    for slot in TOPICS:
        parser.add_argument(topic_option(slot), metavar='TOPIC', dest=f'{slot}_topic',
                            help=f'topic of the {INPUTS[slot].label}; default: {default}')


def add_settings_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--config', metavar='FILE', help='ROS parameter file, the same YAML as '
                        'for the node')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE',
                        dest='settings', help='any setting by its parameter name; repeatable')


def add_calibration_arguments(parser: argparse.ArgumentParser, **topics: str) -> None:
    """Declare the calibration options; topics: ``default`` of ``add_input_arguments``, if any."""
    add_input_arguments(parser, **topics)
    add = parser.add_argument
    add('--leg', action='append', default=[], metavar='A:B',
        help='seconds from the first message (or since 1970); A/B for ISO 8601 dates; each-stop: '
        'a leg between each two stops; repeatable')
    add('--method', choices=('auto', 'two_point', 'wheels', 'smoother', 'all', 'patent'),
        help='method that gives the result (wheels: alias of smoother; patent: smoother, plus '
        'the search of two wheels; all: each method)')
    add('--accept', action='append', default=[], metavar='NAME=LOW:HIGH',
        help='acceptance limits for value plus and minus 2 sigma, such as '
        'yaw_mounting_angle_deg=-0.5:0.5; repeatable; prints one line of JSON per vehicle')
    add('--strict', action='store_true', help='a caution does not pass; exit code 1')


def run(args: argparse.Namespace) -> int:
    """Replay bags; return 0 accepted or caution (with --accept: pass), else 1."""
    config, listener = config_from_arguments(args), _TerminalListener(args)
    if args.marks:
        config['reference.marks'] = tuple(args.marks)
    legs_of(args.leg)
    exports = [name.strip() for name in ','.join(args.export).split(',') if name.strip()]
    if exports:
        from odocal_ros.library.export import check_names
        check_names(exports)
    output = output_folder(args.output, args.bags[0], args.force)
    from odocal_ros.calib.result import traces
    from odocal_ros.library.calibrate_bag import calibrate_bag
    from odocal_ros.offline.cli import trace_file
    calibration = calibrate_bag(args.bags, topics_from_arguments(args), config, args.leg,
                                holdout=args.holdout, listener=listener)
    for name, trace in traces(calibration.result.legs):
        warn(f'odocal: method {name} failed with an internal error; please report it with '
             f'{trace_file(trace)}')
    code = _report(calibration, output, args, listener)
    if exports:
        exported = calibration.export(*(output / name for name in exports))
        listener.note(f'exported: {", ".join(map(str, exported))}')
    return code


def output_folder(name: str | None, bag: str, force: bool) -> Path:
    """Return the folder for the results; BadUsage if it has results and ``force`` is false."""
    output = Path(name or f'odocal_{one_line(Path(bag).stem)}')
    if (output / 'calibration.json').exists() and not force:      # before the long computation
        raise BadUsage(f'{output}/calibration.json already exists; give --force to replace it, '
                       'or another --output')
    return output


class _TerminalListener(Listener):
    """Prints notes on stderr, and shows the progress of each phase of the calibration."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._prints_notes, self._shows_phases = not args.quiet, not (args.quiet or args.json)

    def note(self, text: str) -> None:
        if self._prints_notes:
            warn(f'odocal: {text}')

    def phase(self, title: str) -> AbstractContextManager[Progress]:
        return show_phase(title, quiet=not self._shows_phases)


def config_from_arguments(args: argparse.Namespace) -> dict[str, Any]:
    """
    Return the requested settings; an invalid one raises an OdocalError.

    --set takes precedence over --config; --accept, --strict and --method over both.
    """
    from odocal_ros.settings.config import Config, with_settings
    from odocal_ros.settings.config_groups import parse_accept
    settings = settings_from_arguments(args)
    for text in args.accept:
        settings |= parse_accept(text)
    if args.strict:
        settings['accept.strict'] = True
    if args.method:
        settings['method'] = args.method
    with_settings(Config(), settings)
    return settings


def settings_from_arguments(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of --config and --set; the latter take precedence."""
    from odocal_ros.settings.config_file import parse_set, read_config_file
    settings = read_config_file(Path(args.config)) if args.config else {}
    return settings | dict(parse_set(text) for text in args.settings)


def topics_from_arguments(args: argparse.Namespace) -> dict[str, str]:
    return {slot: topic for slot in TOPICS if (topic := getattr(args, f'{slot}_topic'))}


def _terminal_size(stream: Any) -> tuple[int, int | None]:
    """Return columns, at most 98, and rows of a terminal; None rows without a terminal."""
    if not stream.isatty():
        return 98, None
    columns, rows = get_terminal_size()      # 80, 24 if unknown
    return max(40, min(98, columns)), rows


def _report(calibration: 'Calibration', output: Path, args: argparse.Namespace,
            listener: Listener) -> int:
    """Write and print the result; return the exit code."""
    from odocal_ros.output.files import Results
    from odocal_ros.output.stored import objection_to_folder, stored_in
    from odocal_ros.output.summary import sentence
    existing = stored_in(output)
    results = Results(calibration.result, calibration.config, output, list(calibration.inputs),
                      calibration.created)
    with results.name_results_when_interrupted():
        with listener.phase('writing the results'):
            written = results.write(args.force)
        if worse := objection_to_folder(existing, output):
            listener.note(f'{output}: --force replaced a better calibration: {worse}')
        write_error = None if args.quiet or args.json else _show(calibration.result, args)
        with listener.phase('drawing the report'):
            report_error = results.draw()
        if write_error:
            raise write_error
        if report_error:
            listener.note(f'{results.report[0]}: could not be drawn: {report_error}')
        if args.json:
            print_json(calibration.to_dict())
        elif not args.quiet:
            _show_files(output, written, results.report * (not report_error))
            if not args.brief:
                print_text(sentence(calibration.result))      # again: the first has scrolled away
        return _exit_code(calibration.result, calibration.config, args)


def _exit_code(calibration: 'Combined', config: 'Config', args: argparse.Namespace) -> int:
    """Return the exit code, after printing the decision on the acceptance limits, if any."""
    from odocal_ros.offline.cli import OK, REJECTED
    from odocal_ros.output.value_text import accept_line, accept_words
    from odocal_ros.pipeline.acceptance import accept, Decision
    from odocal_ros.reasons import Verdict
    acceptance = accept(calibration, config)
    if acceptance is None:
        failing_verdicts = [Verdict.REJECTED, *([Verdict.CAUTION] if config.accept.strict else [])]
        return REJECTED if calibration.verdict in failing_verdicts else OK
    if not (args.quiet or args.json):
        print_text('\n' + '\n'.join(accept_words(acceptance)))
    if not args.json:
        print_text(accept_line(calibration, acceptance, config))
    return OK if acceptance.decision is Decision.PASS else REJECTED


def _show(calibration: 'Combined', args: argparse.Namespace) -> OSError | None:
    """Print the result before the report is drawn; return an error of the stream, or None."""
    from odocal_ros.output.summary import screen
    columns, rows = _terminal_size(sys.stdout)
    styled = (sys.stdout.isatty() and 'NO_COLOR' not in os.environ
              and os.environ.get('TERM') != 'dumb')
    lines_below = 9      # files, report and verdict, printed afterwards
    try:
        print_text(screen(calibration, styled, columns, rows and rows - lines_below, args.brief))
        if args.holdout:
            print_text('\ntrack against fixes: last fifth of each leg, excluded from the fit')
        sys.stdout.flush()
    except OSError as error:
        return error
    return None


def _show_files(output: Path, written: list[Path], report: list[Path]) -> None:
    """Print the names of the written files, and of the report if it was drawn."""
    columns, rows = _terminal_size(sys.stdout)
    text = f'written: {output}/ ({", ".join(p.name for p in written)})'
    print_text('\n' + (fill(text, columns, subsequent_indent='  ', break_long_words=False,
                            break_on_hyphens=False) if rows else text))
    for path in report:
        print_text(f'report:  {path}')

"""odocal replay: the node's pipeline over recorded bags."""

from datetime import datetime, UTC
import json
import os
from pathlib import Path
from shutil import get_terminal_size
import sys
from textwrap import fill

from odocal_ros.errors import BadUsage, OdocalError
from odocal_ros.offline.say import say, warn
from odocal_ros.outside.names import one_line

NAMED = {'m/pulse': 'm/pulse (a counter)', 'm/rad': 'm/rad (a joint)', '1': 'm per m (a speed)'}


class LegDropped(BadUsage):
    """A journal holds a leg that the operator dropped."""


def add_arguments(parser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add('bags', nargs='+', metavar='BAG', help='bag folder or file; several: legs of one vehicle')
    add('--config', metavar='FILE', help='ROS parameter file, the very YAML the node takes')
    add('--set', action='append', default=[], metavar='KEY=VALUE', dest='settings',
        help='any setting by its parameter name; repeatable')
    for slot, name in (('imu', 'imu'), ('odometer', 'odometer'), ('fix', 'fix'),
                       ('heading', 'heading'), ('odometer_right', 'odometer-right'),
                       ('fix_velocity', 'fix-velocity')):
        add(f'--{name}-topic', metavar='TOPIC', dest=f'{slot}_topic',
            help=f'topic of the {name.replace("-", " ")}; found by its type where there is one')
    add('--leg', action='append', default=[], metavar='A:B',
        help='seconds from the first message (or since 1970), A/B for ISO 8601 dates, or '
        'each-stop; repeatable')
    add('--method', choices=('auto', 'two_point', 'wheels', 'smoother', 'all', 'patent'),
        help='method whose figures are the result')
    add('--holdout', action='store_true', help='keep the last fifth of each leg back and check '
        'the correction on it')
    add('--output', metavar='DIR', help='folder for the results (default ./odocal_<bag>)')
    add('--force', action='store_true', help='replace an existing calibration.json')
    add('--json', action='store_true', help='print calibration.json on stdout, nothing else')
    add('--quiet', action='store_true', help='print nothing but errors')


def run(args) -> int:
    """Replay bags; return 0 accepted or caution, 1 rejected."""
    from odocal_ros.offline.legs import EACH_STOP, parse_leg
    config = _config(args)
    asked = [text if text == EACH_STOP else parse_leg(text) for text in args.leg]
    output = Path(args.output) if args.output else Path(
        f'odocal_{one_line(Path(args.bags[0]).stem)}')
    if (output / 'calibration.json').exists() and not args.force:     # said before the work
        raise BadUsage(f'{output}/calibration.json is there already; give --force to replace it, '
                       'or another --output')
    from odocal_ros.calib.failed import traces
    from odocal_ros.offline.bags import about, look_at_all, once, told_apart, unlike_settings
    from odocal_ros.offline.cli import trace_file
    from odocal_ros.offline.journal import journal_notes
    from odocal_ros.output.frames import framed
    from odocal_ros.output.stored import known_imu
    from odocal_ros.pipeline.calibrate import combine
    imu = known_imu(_config(args))
    paths, again = once([Path(bag) for bag in args.bags])
    for path in again:
        _tell(args, f'{path} is given twice: it is read once')
    if len(paths) > 1:
        look_at_all(paths, lambda path: _look(path, args))
    done, dropped, imu_frame, unit = [], None, '', None
    for path in paths:
        journal = journal_notes(path)
        own = _config(args, journal)
        try:
            new, described, frame, unit = _legs_of(path, args, asked, own, journal, unit)
        except LegDropped as error:
            dropped = error
            if len(paths) > 1:
                _tell(args, str(error))
            continue
        except OdocalError as error:
            if len(paths) == 1:
                raise
            raise BadUsage(about(path, error)) from None
        done.append((path, own, new, described))
        imu_frame = imu_frame or frame
    if dropped and not done:
        raise dropped
    used, configs, legs, inputs = (list(column) for column in zip(*done, strict=True))
    config = configs[-1]
    if unlike := unlike_settings(configs):
        _tell(args, f'{", ".join(unlike)}: not the same in all journals; each leg is computed '
              f'with its own, limits and files are by those of {used[-1].name}')
    legs, inputs = told_apart(used, legs, inputs)
    for name, trace in traces(legs):
        warn(f'odocal: method {name} broke; please report it with {trace_file(trace)}')
    calibration, config = framed(combine(legs, config, imu=imu), config, imu_frame)
    return _report(calibration, config, inputs, output, args)


def _look(path, args) -> None:
    """Open a bag and see that it has what a replay wants of it."""
    from odocal_ros.bagio.read import open_bag
    from odocal_ros.offline.journal import journal_notes
    journal = journal_notes(path)
    with open_bag(path) as bag:
        _readers(bag, args, _config(args, journal), journal)


def _tell(args, note: str) -> None:
    if not args.quiet:
        warn(f'odocal: {note}')


def _config(args, journal=None):
    """Return defaults < a journal's settings < --config < --set, each checked."""
    from odocal_ros.settings.config import Config, with_settings
    from odocal_ros.settings.config_file import parse_set, read_config_file
    config = with_settings(Config(), journal.settings if journal else {})
    if args.config:
        config = with_settings(config, read_config_file(Path(args.config)))
    config = with_settings(config, dict(parse_set(text) for text in args.settings))
    return with_settings(config, {'method': args.method}) if args.method else config


def _readers(bag, args, config, journal):
    """Return slot -> topic of a bag, and topic -> reader."""
    from odocal_ros.messages.decode import make_reader
    from odocal_ros.offline.topics import choose_topics
    overrides = {slot: getattr(args, f'{slot}_topic') for slot in (
        'imu', 'odometer', 'odometer_right', 'fix', 'heading', 'fix_velocity')}
    overrides = {slot: topic for slot, topic in overrides.items() if topic}
    if journal:
        overrides = journal.topics_in(bag.topics) | overrides
    topics = choose_topics(bag.topics, config, overrides)
    return topics, {topic: make_reader(slot, bag.topics[topic].msgtype, config)
                    for slot, topic in topics.items()}


def _legs_of(path, args, asked, config, journal, unit):
    """
    Return the results of a bag's legs, its entry for calibration.json, the Imu's frame, the unit.

    unit : of the scale in the bags before, None for the first; another one is refused.
    """
    from concurrent.futures import ThreadPoolExecutor

    from odocal_ros.bagio.read import bag_sha256, open_bag
    from odocal_ros.data.leg import LegRecorder
    from odocal_ros.offline.legs import (
        dropped_legs,
        find_legs,
        marked_legs,
        open_ended,
        OPEN_LEG,
    )
    from odocal_ros.offline.phases import Phase
    quiet = args.quiet or args.json
    # the hash costs as long as reading the file: beside the decoding, which holds one core
    with open_bag(path) as bag, ThreadPoolExecutor(1) as beside:
        name = one_line(bag.name)
        if journal:
            _tell(args, f'{bag.name} is a journal: settings and topics from {journal.path}; '
                  'options go before them')
        topics, readers = _readers(bag, args, config, journal)
        digest = beside.submit(bag_sha256, bag)
        recorder = LegRecorder()
        with Phase(f'reading {name}', quiet) as phase:
            bag.read(readers, recorder.feed, phase)
        recorder.form = readers[topics['odometer']].form or recorder.form
        if recorder.form.scale_unit != (unit or recorder.form.scale_unit):
            raise BadUsage(f'{path}: the scale of its odometer {topics["odometer"]} is in '
                           f'{NAMED[recorder.form.scale_unit]}, that of the bags before in '
                           f'{NAMED[unit]}: there is no mean of them; calibrate them apart, or '
                           'name topics of one kind')
        if 'odometer_right' in topics:
            recorder.form_right = readers[topics['odometer_right']].form
        marks = [] if asked else marked_legs(bag)
        if journal and not (marks or asked) and dropped_legs(bag):
            raise LegDropped(f'{bag.name}: its leg was cancelled or undone, so it is not '
                             'replayed; give --leg : to replay it all the same')
        if any(not stop for _, stop in marks):
            _tell(args, f'{bag.name}: {OPEN_LEG}')
        spans = find_legs(recorder, bag, asked, marks, config)
        seen = tuple(n for n in bag.notes if not isinstance(n, str))
        notes = [seen + note for note in open_ended(spans, marks)]
        for note in bag.notes:
            if isinstance(note, str):
                _tell(args, note)
        results = _calibrated(recorder, spans, config, notes, name, args)
        if config.leg.automatic and not (marks or asked):
            results = _worth_keeping(results, args)
        with Phase(f'checksum of {name}', quiet):
            described = {'bag': name, 'sha256': digest.result(), 'topics': topics}
        frame = next((m.header.frame_id for _, m in bag.messages(topics['imu'])), '')
    return results, described, frame, recorder.form.scale_unit


def _calibrated(recorder, spans, config, notes, name, args):
    from dataclasses import replace

    from odocal_ros.offline.phases import Phase
    from odocal_ros.pipeline.parts import calibrate_parts
    results = []
    with Phase('calibrating', args.quiet or args.json) as phase:
        for number, (start_ns, stop_ns) in enumerate(spans, 1):
            which = f'leg {number} of {len(spans)}: ' if len(spans) > 1 else 'calibrating: '
            leg = recorder.close(start_ns, stop_ns, config.leg.preroll)
            parts = calibrate_parts(
                leg, config, notes=notes[number - 1], holdout=args.holdout,
                progress=lambda share, stage, done=number - 1, which=which: phase(
                    (done + share) / len(spans), which + stage))
            results += [replace(one, bag=name) for one in parts]
    return results


def _worth_keeping(results, args):
    """Return legs found by themselves but for those that are no good, as the node has it."""
    from odocal_ros.pipeline.automatic import refusal
    why = [refusal(leg) for leg in results]
    if all(why):
        return results
    for leg, reason in zip(results, why, strict=True):
        if reason:
            start = datetime.fromtimestamp(leg.start_ns // 10**9, UTC)
            _tell(args, f'the leg of {start:%Y-%m-%d %H:%M:%S} UTC is not used: '
                  f'{reason.code.name}: {reason.text}')
    return [leg for leg, reason in zip(results, why, strict=True) if not reason]


def _styled(stream) -> bool:
    """Tell whether a stream is a terminal that takes colours."""
    return stream.isatty() and 'NO_COLOR' not in os.environ and os.environ.get('TERM') != 'dumb'


def _size(stream) -> tuple[int, int | None]:
    """Return the columns, 98 at most, and the rows of a terminal; no rows for what is none."""
    if not stream.isatty():
        return 98, None
    columns, rows = get_terminal_size()      # 80, 24 where it tells none
    return max(40, min(98, columns)), rows


def _report(calibration, config, inputs, output, args) -> int:
    from odocal_ros.offline.cli import OK, REJECTED
    from odocal_ros.offline.phases import Phase
    from odocal_ros.output.files import as_json, said_when_interrupted, write_results
    from odocal_ros.output.worse import replacing, stored_in
    from odocal_ros.reasons import Verdict
    created = datetime.now(UTC).isoformat(timespec='seconds')
    old = stored_in(output)
    troubles: list[str] = []
    with Phase('writing the results', args.quiet or args.json):
        written = write_results(calibration, config, output, inputs, created, force=args.force,
                                tell=troubles.append)
    try:
        for trouble in troubles:
            _tell(args, trouble)
        if worse := replacing(old, output):
            _tell(args, f'{output}: a better calibration was replaced, as --force asks: {worse}')
        if args.json:
            json.dump(as_json(calibration, config, inputs, created), sys.stdout, indent=2)
            say('')
        elif not args.quiet:
            _show(calibration, output, written, args, drawn=not troubles)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(said_when_interrupted(output)) from None
    return REJECTED if calibration.verdict is Verdict.REJECTED else OK


def _show(calibration, output, written, args, drawn) -> None:
    """Print the result and where it is."""
    from odocal_ros.output.report import NAME as REPORT
    from odocal_ros.output.summary import screen, sentence
    columns, rows = _size(sys.stdout)
    say(screen(calibration, _styled(sys.stdout), columns, rows and rows - 9))
    if args.holdout:
        say('\ntrack against fixes: on the last fifth of each leg, held back from the fit')
    others = ', '.join(p.name for p in written if p.name != REPORT)
    text = f'written: {output}/ ({others})'
    say('\n' + (fill(text, columns, subsequent_indent='  ', break_long_words=False,
                     break_on_hyphens=False) if rows else text))
    if output / REPORT in written and drawn:
        say(f'report:  {output / REPORT}')
    say(sentence(calibration))      # what scrolled away, once more

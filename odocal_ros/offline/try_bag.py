# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
odocal try: calibrate a bag with one command, without knowledge of its topics.

It inspects the bag, prints the selected topics and settings with reasons, runs odocal replay with
them, and opens the report in a browser.
"""

import argparse
from collections.abc import Collection
from itertools import chain
import os
from pathlib import Path
import shlex
import sys
from typing import Any, NamedTuple, TYPE_CHECKING

from odocal_ros.data.inputs import INPUTS, topic_option
from odocal_ros.errors import BadData
from odocal_ros.offline import replay
from odocal_ros.offline.cli import print_text
from odocal_ros.safe_io.text_formats import for_shell

if TYPE_CHECKING:
    from odocal_ros.bagio.read import Bag
    from odocal_ros.settings.config import Config

SETTING_REASONS = {      # why the inspection suggests a setting; imu.mounting_rpy has its own text
    'imu.accel_scale': 'the mean specific force is about 1, so its unit is g',
    'imu.gyro_scale': 'turn rates exceed those of a vehicle in rad/s, so their unit is deg/s',
    'gnss.max_sigma': 'the stated sigma of most fixes exceeds the limit',
    'odometer.field': 'this value grows with the distance between the fixes',
    'odometer.quantity': 'with this meaning the value grows with the distance between the fixes',
    'odometer.wrap': 'the counter restarts from 0 at this value',
    'odometer.reversed': 'the counts decrease on most of the drive'}
BY_TOPIC_NAME = 'the names of two topics only differ in left and right'
BY_MOTION = 'it moves as a wheel; its side is known from its name or from the gyro'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options: the calibration options of replay, and --no-browser."""
    add = parser.add_argument
    add('bag', metavar='BAG', help='bag folder or file')
    replay.add_calibration_arguments(parser, default='the most likely one')
    add('--output', metavar='DIR', help='folder for the results (default ./odocal_<bag>)')
    add('--force', action='store_true', help='replace an existing calibration.json')
    add('--no-browser', action='store_true', help='do not open the report')


def run(args: argparse.Namespace) -> int:
    """Inspect a bag, replay it and open the report; return the exit code of the replay."""
    output = replay.output_folder(args.output, args.bag, args.force)
    content, choices = _inspect_with_choices(args)
    if not content['command']:
        from odocal_ros.offline.inspection_text import text
        # the error states the missing topics
        codes = {f'NO_{slot.upper()}' for slot in ('imu', 'odometer', 'fix')
                 if slot not in content['mapping']}
        print_text(text(content | {'replay_error': '', 'findings': [
            finding for finding in content['findings'] if finding['code'] not in codes]}))
        raise BadData(f'{args.bag}: ' + ' '.join(
            f'{finding["text"]}. {finding["remedy"]}' for finding in content['findings']
            if finding['code'] in codes))
    options = [*_suggested_options(content['command'], args), *_user_options(args)]
    print_text('\n'.join(_overview(content, choices, options, args.settings)))
    words = [args.bag, *chain.from_iterable(options), *['--strict'] * args.strict]
    parser = argparse.ArgumentParser()
    replay.add_arguments(parser)
    parser.set_defaults(brief=True)
    code = replay.run(parser.parse_args(words + ['--force'] * args.force))
    _open_report(output / 'report.html', args.no_browser)
    print_text('\nto repeat this calibration:\n'
               f'  {for_shell(["odocal", "replay", *words, "--force"])}')
    return code


class _Choice(NamedTuple):
    """The selected topic of a slot with several candidates."""

    slot: str
    topic: str
    other_candidates: list[str]
    reason: str


def _inspect_with_choices(args: argparse.Namespace) -> tuple[dict[str, Any], list[_Choice]]:
    """Return the result of inspect with the selected topics, and the choices."""
    from odocal_ros.bagio.read import open_bag
    from odocal_ros.offline.inspection import inspect
    from odocal_ros.settings.config import Config, with_settings
    config = with_settings(Config(), replay.config_from_arguments(args))
    topics = replay.topics_from_arguments(args)
    with open_bag(Path(args.bag)) as bag:
        content = inspect(bag, args.bag, config, topics)
        choices = _choices(bag, config, topics, content)
        if choices and sys.stdin and sys.stdin.isatty() and sys.stdout.isatty():
            choices = [_choice_of_user(bag, choice) for choice in choices]
            content = inspect(bag, args.bag, config, topics | {
                choice.slot: choice.topic for choice in choices})
        return content, choices


def _choices(bag: 'Bag', config: 'Config', topics: dict[str, str],
             content: dict[str, Any]) -> list[_Choice]:
    """Return the most likely topic of each slot with several candidates."""
    from odocal_ros.library.topics import candidates
    from odocal_ros.offline.suggest import likely_mapping, other_candidates
    mapping = content['mapping']
    unsuitable = [*content['not_following'], *content['partial_imus']]
    _, config = likely_mapping(bag.topics, config, topics, unsuitable)
    choices = []
    for slot in mapping.keys() - topics.keys():
        others, reason = other_candidates(bag.topics, slot, config, mapping, unsuitable)
        if others and mapping[slot] in candidates(bag.topics, slot, config, {}):
            choices.append(_Choice(slot, mapping[slot], others, reason))
    return sorted(choices, key=lambda choice: list(INPUTS).index(choice.slot))


def _choice_of_user(bag: 'Bag', choice: _Choice) -> _Choice:
    """Return the topic that the user selects at the terminal; an empty line: the first one."""
    names = [choice.topic, *choice.other_candidates]
    print_text(f'{len(names)} candidate topics for the {INPUTS[choice.slot].label}:')
    for number, name in enumerate(names, 1):
        info = bag.topics[name]
        print_text(f'  {number}  {name}  {info.msgtype}, {info.count} messages')
    while True:
        print_text(f'number of the topic? [1: {choice.reason}] ', end='')
        sys.stdout.flush()
        line = sys.stdin.readline()
        if not line:
            raise KeyboardInterrupt
        answer = line.strip() or '1'
        if answer == '1':
            return choice
        if answer.isdecimal() and 1 < int(answer) <= len(names):
            names.insert(0, names.pop(int(answer) - 1))
            return _Choice(choice.slot, names[0], names[1:], 'you selected it')
        print_text(f'enter a number from 1 to {len(names)}')


def _suggested_options(replay_command: str, args: argparse.Namespace) -> list[tuple[str, str]]:
    """Return (option, value) of the suggested command, without those that the user has set."""
    words = shlex.split(replay_command)[3:]      # after odocal replay BAG
    user_settings = {text.partition('=')[0] for text in args.settings}
    return [(option, value) for option, value in zip(words[::2], words[1::2], strict=True)
            if not (option == '--leg' and args.leg)
            and not (option == '--set' and value.partition('=')[0] in user_settings)]


def _user_options(args: argparse.Namespace) -> list[tuple[str, str]]:
    """Return (option, value) of the user, except topics: the suggested command has them."""
    return [(option, value) for option, values in (
        ('--config', [args.config]), ('--set', args.settings), ('--leg', args.leg),
        ('--method', [args.method]), ('--accept', args.accept), ('--output', [args.output]))
            for value in values if value]


def _overview(content: dict[str, Any], choices: list[_Choice], options: list[tuple[str, str]],
              user_settings: Collection[str]) -> list[str]:
    """Return the selected topics, settings and legs with reasons, as printed lines."""
    from odocal_ros.output.value_text import wrapped
    because = {choice.slot: f', because {choice.reason}; other candidates: '
               f'{", ".join(choice.other_candidates)} ({topic_option(choice.slot)})'
               for choice in choices}
    lines = ['topics']
    mapping = content['mapping']
    wheels = {'odometer': 0, 'odometer_right': 1}
    for slot in sorted(mapping, key=lambda slot: wheels.get(slot, 2)):
        left = 'left ' * (slot == 'odometer' and 'odometer_right' in mapping)
        lines += wrapped(f'{left}{INPUTS[slot].label}: {mapping[slot]}{because.get(slot, "")}')
    for note in content['topic_notes']:
        lines += wrapped(f'note: {note}')
    settings = [value for option, value in options if option == '--set']
    lines += ['settings'] * bool(settings)
    for setting in settings:
        lines += wrapped(f'{setting}: {_setting_reason(setting, content, user_settings)}')
    legs = [value for option, value in options if option == '--leg'] or [
        f'{leg["start"]:.1f}:{leg["stop"]:.1f}' for leg in content['legs']]
    lines += ['legs, seconds from the first message'] * bool(legs)
    return [*lines, *wrapped(', '.join(legs)), '']


def _setting_reason(setting: str, content: dict[str, Any], user_settings: Collection[str]) -> str:
    """Return the reason why a setting has its value for this bag."""
    name, _, value = setting.partition('=')
    if setting in user_settings:
        return 'given by --set'
    if name != 'imu.mounting_rpy':
        return SETTING_REASONS.get(name) or (BY_TOPIC_NAME if value == 'topic' else BY_MOTION)
    from odocal_ros.offline.inspection_text import whole_degrees
    mounting = content['mounting']
    if mounting['assumed_forward']:
        return 'up is measured from gravity; x is assumed to be forward'
    return ('up is measured from gravity, forward from accelerations and turns '
            f'(1 sigma: {whole_degrees(mounting["forward_sigma"])} deg)')


def _open_report(report: Path, no_browser: bool) -> None:
    import webbrowser
    if no_browser or not report.exists():
        return
    # without a display, a text browser would take over the terminal
    display = sys.platform != 'linux' or any(
        os.environ.get(name) for name in ('DISPLAY', 'WAYLAND_DISPLAY', 'BROWSER'))
    if not (display and webbrowser.open(report.resolve().as_uri())):
        print_text(f'no browser can be started; open {report.resolve()}')

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Selection of the wheels among the values of a message, if no setting names them.

Joints are selected by name: wheels, steering and arm joints have typical names. A left and a right
one are a pair. Of several axles, the one that does not steer is used, otherwise the rear one.
Without typical names, two values of unknown sides give their mean, more are refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import re

WORD = re.compile(r'[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+')
WHEEL_WORDS_IN_NAME = ('wheel', 'whl', 'tire', 'tyre')
DRIVE_WORDS_IN_NAME = ('track', 'tread', 'drive', 'motor', 'traction', 'hub', 'encoder')
STEERING_WORDS = ('steer', 'swivel', 'pivot', 'kingpin')
EXCLUDED_WORDS = (*STEERING_WORDS, 'caster', 'castor', 'susp', 'shock', 'spring', 'damper', 'drop',
                  'brake', 'bogie', 'rocker', 'camber')
# parts of a body or a machine: only as whole words, since they occur in other words
EXCLUDED_WHOLE_WORDS = (
    'arm', 'shoulder', 'elbow', 'wrist', 'finger', 'gripper', 'hand', 'head', 'neck', 'torso',
    'waist', 'hip', 'knee', 'ankle', 'leg', 'pan', 'tilt', 'lift', 'servo', 'camera', 'mast',
    'boom', 'bucket', 'door', 'throttle', 'pedal', 'flipper', 'lidar', 'laser', 'hinge', 'slider',
    'yaw', 'pitch', 'roll')
REAR, FRONT = ('rear', 'back', 'aft'), ('front', 'fore')
AXLE_LETTERS = {'f': 'front', 'r': 'rear', 'b': 'rear', 'm': 'middle', 'c': 'middle'}

MAX_SHOWN_KEYS = 12      # judgement: in a text


@dataclass(frozen=True)
class WheelChoice:
    """The selected values (joint names or indices), left before right if ``sides_known``."""

    keys: tuple[str, ...]
    sides_known: bool
    explanation: str      # text for the user; '' if there was no choice


def select_wheels(names: Sequence[str], count: int) -> WheelChoice | str:
    """Return the wheels among ``count`` values, or why they are unclear; names : [] if none."""
    names = list(names[:count])
    keys = names or [str(k) for k in range(count)]
    if not keys:
        return 'the list is empty'
    if len(set(keys)) < len(keys):
        return f'two joints with the same name in {_list_text(keys)}'
    selected = _select_by_name(names) if names else tuple(keys)
    if len(keys) == 1 and not selected:
        return (f'its only joint, {keys[0]}, does not have a wheel name; select it with '
                'odometer.field')
    if isinstance(selected, WheelChoice):
        return selected
    if len(selected) == 1:
        return WheelChoice(selected, True, '' if len(keys) == 1 else (
            f'joints {_list_text(keys)}: only {selected[0]} is used, selected by name'))
    if len(selected) == 2:
        noun = 'joints' if names else 'values'
        first, second = selected
        return WheelChoice(selected, False, (
            f'{noun} {_list_text(keys)}: the mean of {first} and {second} is used. Left and right '
            'cannot be decided from the data; below, the first is called left'))
    noun = f'the joints {_list_text(keys)}' if names else f'a list of {count} values'
    return (f'the wheels among {noun} are not clear: set odometer.wheels'
            f'{"" if names else " (indices from 0)"}, or odometer.field for one; '
            'odocal inspect shows how each value moves')


def key_on_side(choice: WheelChoice, side: str) -> str:
    """Return the key of the wheel on one side, 'left' or 'right'; '' if sides are unknown."""
    if len(choice.keys) == 1:
        return choice.keys[0]
    left, right = choice.keys
    return (left if side == 'left' else right) if choice.sides_known else ''


def _select_by_name(names: Sequence[str]) -> WheelChoice | tuple[str, ...]:
    """Return the pair selected by name, otherwise all possible wheels."""
    not_excluded = [name for name in names if not _contains(name, EXCLUDED_WORDS)]
    candidates = [name for name in not_excluded if _contains(name, WHEEL_WORDS_IN_NAME)]
    if not candidates:
        not_excluded = [name for name in not_excluded
                        if not set(_words(name)) & set(EXCLUDED_WHOLE_WORDS)]
        candidates = [name for name in not_excluded
                      if _contains(name, DRIVE_WORDS_IN_NAME)] or not_excluded
    # name -> side and rest, which is equal in a pair
    parts = {name: _side_and_rest(name) for name in candidates}
    left, right = ([name for name, (name_side, _) in parts.items() if name_side == side]
                   for side in ('left', 'right'))
    pairs = [(a, b) for a in left for b in right if parts[a][1] == parts[b][1]]
    if len(left) == len(right) == 1:
        pairs = [(left[0], right[0])]
    if 2 * len(pairs) != len({name for pair in pairs for name in pair}):
        return tuple(candidates)                      # one wheel in two pairs
    if len(pairs) == 1:
        return WheelChoice(pairs[0], True, _selection_text(names, pairs[0], ''))
    steered_axles = {_axle(_side_and_rest(name)[1]) for name in names
                     if _contains(name, STEERING_WORDS)} - {''}
    not_steered = [pair for pair in pairs
                   if steered_axles and _axle(parts[pair[0]][1]) not in steered_axles]
    rear = [pair for pair in pairs if _axle(parts[pair[0]][1]) == 'rear']
    for axle_pairs, reason in ((not_steered, ', axle that does not steer'), (rear, ', rear axle')):
        if len(axle_pairs) == 1:
            wheels = ', '.join(name for pair in pairs for name in pair)
            return WheelChoice(axle_pairs[0], True, (
                f'{_selection_text(names, axle_pairs[0], reason)}; for all wheels set '
                f'odometer.wheels to [{wheels}]'))
    # of two wheels in line, as of a bicycle, the front one steers
    rear_wheels = [name for name, (_, rest) in parts.items() if _axle(rest) == 'rear']
    return tuple(rear_wheels if len(candidates) == 2 and len(rear_wheels) == 1 else candidates)


def _selection_text(names: Sequence[str], pair: tuple[str, str], reason: str) -> str:
    rest = '' if len(names) == 2 else f'joints {_list_text(names)}: '
    return (f'{rest}{pair[0]} is used as left wheel, {pair[1]} as right wheel (selected by '
            f'name{reason})')


def _words(name: str) -> list[str]:
    """Return the words of a name; adjacent single letters are one word: r_l is rl."""
    words: list[str] = []
    for word in (w.lower() for w in WORD.findall(name)):
        if len(word) == 1 and words and len(words[-1]) == 1 and (words[-1] + word).isalpha():
            words[-1] += word
        else:
            words.append(word)
    return words


def _side_and_rest(name: str) -> tuple[str, tuple[str, ...]]:
    """Return the side in a name ('' none or both), and the rest of the name."""
    sides, rest = set(), []
    for word in _words(name):
        axle, side = _axle_and_side(word)
        if side:
            sides.add(side)
            rest += [axle] * bool(axle)
            continue
        for side in ('left', 'right'):
            if side in word and word != 'upright':
                sides.add(side)
                word = word.replace(side, '')
        rest += [word] * bool(word)
    return (sides.pop() if len(sides) == 1 else ''), tuple(rest)


def _axle_and_side(word: str) -> tuple[str, str]:
    """Return axle and side of an abbreviation: l, rh, fl, rr; '' if there is none."""
    side = {'l': 'left', 'r': 'right'}
    if word in side or word in ('lh', 'rh'):
        return '', side[word[0]]
    for axle, letter in zip(word, word[::-1], strict=True) if len(word) == 2 else ():
        if axle in AXLE_LETTERS and letter in side:
            return AXLE_LETTERS[axle], side[letter]
    return '', ''


def _axle(rest: Sequence[str]) -> str:
    text = ' '.join(rest)
    return 'rear' if _contains(text, REAR) else 'front' if _contains(text, FRONT) else ''


def _contains(name: str, words: Sequence[str]) -> bool:
    return any(word in name.lower() for word in words)


def _list_text(keys: Sequence[str]) -> str:
    hidden_count = len(keys) - MAX_SHOWN_KEYS
    return ', '.join(keys[:MAX_SHOWN_KEYS]) + (
        f' and {hidden_count} more' if hidden_count > 0 else '')

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Text of ``odocal inspect``: the content of a bag as one screen."""

from collections.abc import Callable, Iterable, Iterator
import math
from typing import Any

from odocal_ros.data.samples import LOCAL_STATUS
from odocal_ros.output.value_text import counted, wrapped
from odocal_ros.safe_io.text_formats import for_shell, one_line

STATUS = {'-1': 'no fix', '0': 'fix', '1': 'SBAS', '2': 'GBAS/RTK',
          str(LOCAL_STATUS): 'positions in a local frame'}


def text(content: dict[str, Any]) -> str:
    """Return the text on the content of a bag, the result of ``inspection.inspect``."""
    roles = {topic: slot for slot, topic in content['mapping'].items()}
    blocks = [_head(content), _topics(content, roles)]
    blocks += [_details(topic, roles) for topic in content['topics']
               if {'timing', 'motions', 'fields', 'error'} & topic.keys()]
    blocks += [_drive(content), _findings(content), _command(content)]
    return '\n\n'.join('\n'.join(block) for block in blocks if block)


def _head(content: dict[str, Any]) -> list[str]:
    lines = [one_line(content['path']),
             f'  {content["duration"]:.1f} s from {content["start_utc"]}, {content["messages"]} '
             f'messages in {counted(len(content["files"]), "file")}']
    return lines + [line for note in (*content['notes'], *content['topic_notes'])
                    for line in wrapped(f'note: {note}')]


def _topics(content: dict[str, Any], roles: dict[str, str]) -> list[str]:
    name_width = max((len(topic['name']) for topic in content['topics']), default=0)
    types = {topic['type']: topic['type'].replace('/msg/', '/') for topic in content['topics']}
    type_width = max(map(len, types.values()), default=0)
    lines = []
    for topic in content['topics']:
        name, msgtype = one_line(topic['name']), one_line(types[topic['type']])
        rate = '' if topic['count'] < 2 else (
            f'{topic["rate_hz"]:8.2f} Hz' if topic['rate_hz'] else f'{"unknown":>8} Hz')
        role = f'<- {roles[topic["name"]]}' if topic['name'] in roles else ''
        if str(LOCAL_STATUS) in topic.get('fix', {}).get('status', ()):
            role += ' (position reference)' if role else 'position reference, if GNSS is not used'
        lines.append(f'  {name:{name_width}}  {msgtype:{type_width}} '
                     f'{topic["count"]:8d} {rate:11}  {role}'.rstrip())
    return ['topics', *lines]


def _details(topic: dict[str, Any], roles: dict[str, str]) -> list[str]:
    """Return the name of a topic and statements on it, only the first ones if it is unused."""
    statements = [statement for key, describe in STATEMENTS.items() if topic.get(key)
                  for statement in describe(topic, topic[key])]
    if topic['name'] not in roles and not any('warning:' in text for text in statements):
        statements = statements[:2 + len(topic.get('motions', ()))]
    return [one_line(topic['name']), *(line for text in statements for line in wrapped(text))]


def _field_statements(topic: dict[str, Any], fields: dict[str, Any]) -> Iterator[str]:
    """Return a statement for each field of an unknown type that follows the path of the fixes."""
    for field in fields['found']:
        unit = 'm/count' if field['is_integer'] and field['quantity'] != 'rate' else 'm per unit'
        relation = {'rate': f'is proportional to the speed, {field["scale"]:.3g} m/s per unit',
                    'cumulative': f'grows with distance, {field["scale"]:.3g} {unit}',
                    'increment': f'grows with distance, {field["scale"]:.3g} {unit} (counts since '
                                 'the previous message)'}[field['quantity']]
        options = [word for setting in field['settings'] for word in ('--set', setting)]
        yield f'{topic["name"]}.{field["path"]} {relation}: {for_shell(options)}'
    if not fields['found']:
        yield (f'no numeric field grows with the distance between the fixes ({fields["tried"]} '
               'tried)')


def _imu_statements(_topic: dict[str, Any], imu: dict[str, Any]) -> Iterator[str]:
    unit = imu['force_unit']
    if not imu['gravity']:
        yield 'no specific force: no accelerometer, or its data is not published'
    else:
        orientation = {'+z': 'the IMU z axis points up', '-z': 'the IMU z axis points down'}.get(
            imu['gravity_axis'], 'the IMU is mounted on its side')
        yield (f'specific force {imu["gravity"]:.3f} {"" if unit == "unknown" else unit} along '
               f'{imu["gravity_axis"]} (within {math.degrees(imu["tilt_from_axis"]):.1f} deg): '
               f'{orientation}')
        if unit != 'm/s^2':
            yield 'warning: specific force is not in m/s^2' + ' but in g' * (unit == 'g')
        if imu['not_finite']:
            yield f'warning: {counted(imu["not_finite"], "message")} with NaN or Inf'
    if not imu['orientation']:
        yield 'no orientation' + (
            ' (covariance -1)' if imu['orientation_refused'] > 0.5 else ' (always the identity)')
    elif imu['yaw_sigma'] is None:
        yield 'the IMU publishes an orientation of unknown covariance'
    else:
        yield ('the IMU publishes an orientation, stated yaw sigma '
               f'{math.degrees(imu["yaw_sigma"]):.2f} deg')


def _odometer_statements(_topic: dict[str, Any], odometer: dict[str, Any]) -> Iterator[str]:
    is_angle = odometer['scale_unit'] == 'm/rad'
    quantity = {'cumulative': 'running angle' if is_angle else 'running count', 'rate': 'speed',
                'increment': 'counts since the previous message'}[odometer['quantity']]
    unit = {'m/pulse': 'pulses', 'm/rad': 'rad', '1': 'm'}[odometer['scale_unit']]
    unit += '/s' * (odometer['quantity'] == 'rate')
    if odometer['minimum'] is None:
        yield 'warning: no valid value'
        return
    if odometer['quantity'] == 'rate' and odometer.get('not_following'):
        quantity = 'one component of a velocity, not the speed along the path of the fixes'
    digits = 5 if odometer['quantity'] == 'rate' else 6 if is_angle else 12
    minimum, maximum = (f'{odometer[key]:.{digits}g}' for key in ('minimum', 'maximum'))
    yield f'{quantity}: {minimum} to {maximum} {unit}'
    if odometer['meaning']:
        yield f'its values follow the fixes only as a {quantity}: --set {odometer["meaning"]}'
    if odometer['not_finite']:
        yield f'warning: {counted(odometer["not_finite"], "message")} with NaN or Inf'


def _fix_statements(topic: dict[str, Any], fix: dict[str, Any]) -> Iterator[str]:
    status = ', '.join(f'{count} {STATUS.get(value, "status " + value)}'
                       for value, count in fix['status'].items())
    if fix['sigma']:
        median, least, most = (f'{fix["sigma"][key]:.2f}'
                               for key in ('median', 'minimum', 'maximum'))
        sigma = f'stated sigma {median} m' + f' ({least} to {most})' * (least != most)
        if fix['covariance_known'] < topic['count']:
            sigma += f', covariance in {fix["covariance_known"]} of {topic["count"]}'
    else:
        sigma = 'no covariance'
    yield f'status: {status}; {sigma}'
    if without_position := topic['count'] - fix['positions']:
        yield f'warning: {counted(without_position, "message")} without a position'
    if fix['position_step'] and fix['position_step'] > 0.05:
        yield f'position resolution {fix["position_step"]:.2f} m'


def _timing_statements(topic: dict[str, Any], timing: dict[str, Any]) -> Iterator[str]:
    if timing['headerless']:
        jitter = timing['arrival_jitter']
        yield 'no header: arrival time (bag time) is used as stamp' + (
            '' if jitter is None else f'; arrival jitter {1e3 * jitter:.1f} ms')
    elif abs(delay := timing['header_to_bag'] or 0.0) > 0.5e-3:     # None: no row has a stamp
        order = 'after' if delay > 0 else 'before'
        yield (f'messages are recorded {abs(delay):.3f} s {order} the time in their header '
               f'(1 sigma: {timing["header_to_bag_spread"]:.3f} s)')
    if timing['whole_seconds']:
        yield ('warning: all stamps are whole seconds, without the fraction: correct the driver, '
               'or use arrival times (such as odometer.arrival_time)')
    stamp_faults = [f'{timing[key]} {fault}' for key, fault in (
        ('zero_stamps', 'without a stamp'), ('repeated_stamps', 'with the previous stamp'),
        ('backward_steps', 'with a stamp before the previous one')) if timing[key]]
    if stamp_faults:
        yield f'warning: of {topic["count"]} messages, {", ".join(stamp_faults)}'
    if timing['gap_count']:
        longest = max(timing['gaps'], key=lambda gap: gap['length'])
        yield (f'warning: {counted(timing["gap_count"], "gap")}, the longest of '
               f'{longest["length"]:.2f} s at t = {longest["at"]:.2f} s')


# key of a topic's facts: function of the topic and of these facts that yields statements on them
STATEMENTS: dict[str, Callable[[dict[str, Any], Any], Iterable[str]]] = {
    'fields': _field_statements, 'imu': _imu_statements, 'chosen': lambda _topic, chosen: [chosen],
    'motions': lambda _topic, motions: motions, 'odometer': _odometer_statements,
    'fix': _fix_statements, 'timing': _timing_statements,
    'error': lambda _topic, error: [error]}


def _drive(content: dict[str, Any]) -> list[str]:
    drive = content['drive']
    if not drive:
        return []
    lines = ['drive (seconds from the first message)']
    if drive['usable_fixes']:
        lines.append(f'  path length {drive["distance"]:.0f} m from the fixes, '
                     f'{drive["chord"]:.0f} m from first to last; speed {drive["slowest"]:.1f} to '
                     f'{drive["fastest"]:.1f} m/s')
    if drive['rough_scale'] and drive['scale_unit'] != '1':
        lines.append(f'  scale factor about {drive["rough_scale"]:.4g} {drive["scale_unit"]}')
    stops = content['standstills']
    times = ', '.join(f'{begin:.1f} to {end:.1f}' for begin, end in stops[:8])
    lines += wrapped(f'standstills: {times}{", ..." * (len(stops) > 8)} s' if stops
                     else 'standstills: none')
    lines += _legs(content['legs'])
    if len(content['each_stop']) > 1:
        lines.append(f'  --leg each-stop: {len(content["each_stop"])} legs, '
                     + ', '.join(f'{leg["distance"]:.0f} m' for leg in content['each_stop'][:8])
                     + ', ...' * (len(content['each_stop']) > 8))
    lines += [f'  straight: {_leg(leg)}' for leg in content['straight'][:3]]
    return lines + _mounting(content['mounting'])


def _legs(legs: list[dict[str, Any]]) -> list[str]:
    """Return a line for each leg, or a table of many legs."""
    if not legs:
        return []
    origin = 'marked by the node' if legs[0]['marked'] else 'used by replay'
    if len(legs) <= 3:
        return [f'  leg {origin}: {_leg(leg)}' for leg in legs]
    return [f'  {len(legs)} legs {origin}, s and m', '    '
            f'{"leg":>3}{"from":>10}{"to":>10}{"length":>8}{"start to end":>14}'] + [
        f'    {i:>3}{leg["start"]:>10.1f}{leg["stop"]:>10.1f}{leg["distance"]:>8.0f}'
        f'{leg["chord"]:>14.0f}' for i, leg in enumerate(legs, 1)]


def _leg(leg: dict[str, Any]) -> str:
    return (f'{leg["start"]:.1f} to {leg["stop"]:.1f} s, path length {leg["distance"]:.0f} m, '
            f'start to end {leg["chord"]:.0f} m')


def _mounting(mounting: dict[str, Any]) -> list[str]:
    """Return the orientation of the IMU in the vehicle, and the data that determine it."""
    if not mounting['accelerometer']:
        return wrapped('axes: an upright IMU is assumed, as there is no accelerometer; if it is '
                        'not upright, set imu.mounting_rpy')
    if mounting['rpy'] is None:
        return wrapped(f'axes: {mounting["unclear"]}')
    rpy = ', '.join(f'{x:.10g}' for x in mounting['rpy'])
    degrees = ', '.join(f'{math.degrees(x):.0f}' for x in mounting['rpy'])
    if mounting['assumed_forward']:
        source = 'level from gravity; the drive does not determine forward, x is assumed'
    else:
        uncertainty = whole_degrees(mounting['forward_sigma'])
        source = ('forward direction from accelerations and turns, uncertainty '
                  f'{uncertainty} deg (1 sigma); the measured mounting differs from these quarter '
                  f'turns by {math.degrees(mounting["deviation"]):.1f} deg')
    action = 'set imu.mounting_rpy to' if mounting['needed'] else \
        'imu.mounting_rpy is correct to the nearest quarter turn:'
    return wrapped(f'axes: {action} [{rpy}] rad (roll, pitch, yaw {degrees} deg; {source})')


def whole_degrees(angle: float) -> str:
    """Return an uncertainty, rad, in whole degrees; below half a degree with one digit."""
    degrees = math.degrees(angle)
    return f'{degrees:.0f}' if degrees >= 0.5 else f'{degrees:.1g}'


def _findings(content: dict[str, Any]) -> list[str]:
    if not content['findings']:
        return ['all data for a calibration is available'] if content['command'] else []
    lines = []
    for method, title in ((None, 'before calibrating (counts: the time that all topics cover)'), (
            'two_point', 'for the two-point method only; the smoother is not affected')):
        reasons = [reason for reason in content['findings'] if reason['method'] == method]
        lines += [title] * bool(reasons)
        for reason in reasons:
            lines += wrapped(f'{reason["code"]}: {reason["text"]}. {reason["remedy"]}')
    return lines


def _command(content: dict[str, Any]) -> list[str]:
    lines = []
    if content['replay_error']:
        lines.append('odocal replay without options stops with:')
        lines += [part for line in content['replay_error'].split('\n')
                  for part in wrapped(line.strip(), '  ' + '  ' * line.startswith(' '))]
    if content['command']:
        lines += ['suggested command', f'  {content["command"]}']
    return lines

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The summary: numbers, screen text, sentence and error budget."""

from dataclasses import replace
import math
import re

from calibration_parts import GAP
import numpy as np
import pytest

from odocal_ros.calib.result import Calibration, Estimate, Source, TrackCheck
from odocal_ros.output.report_tables import value_rows
from odocal_ros.output.summary import screen, sentence
from odocal_ros.output.tables import budget_lines, pooled_check, source_label
from odocal_ros.output.value_text import (
    deviation_text,
    duration_text,
    join_same_reasons,
    length_text,
    with_sigma,
    wrapped,
)
from odocal_ros.reasons import Code, Reason

pytestmark = pytest.mark.core
TABLE = {'fix_end': {'scale_factor': 4e-5, 'yaw_mounting_angle': 3e-3, 'shared': False},
         'initial_heading': {'scale_factor': 0.0, 'yaw_mounting_angle': 4e-3, 'shared': True},
         'quantisation': {'scale_factor': 1e-9, 'yaw_mounting_angle': 0.0, 'shared': False}}


@pytest.mark.parametrize(('others', 'percent'), [(9e-6, 58), (11e-6, 48)])
def test_the_largest_error_source_is_given_with_its_share_of_the_variance(good, others, percent):
    method = good.methods['two_point']
    sources = [Source('fixes', np.array([[1.5e-5], [0.0]])),        # 2.25 against 1.62 and 2.42
               *(Source(name, np.array([[others], [0.0]])) for name in ('slip', 'quantisation'))]
    text = screen(replace(good, methods={'two_point': replace(method, sources=tuple(sources))}))
    assert f'  largest error       scale: fixes ({percent} %)' in text


@pytest.mark.parametrize(('value', 'sigma', 'text'), [
    (0.0500123456, 1.23e-6, '0.0500123 ± 0.0000012'),
    (19.995, 0.00048, '19.99500 ± 0.00048'),
    (1234.5, 56.0, '1234 ± 56'),
    (1234.5, 5.6, '1234.5 ± 5.6'),
    (0.5, 0.0, '0.500000 ± 0.000000'),
    (0.5, None, '0.5'),
    (0.5, math.nan, '0.5'),
    (math.nan, 0.1, 'unknown')])
def test_values_have_as_many_digits_as_their_sigma(value, sigma, text):
    assert with_sigma(value, sigma) == text


def test_numbers_have_the_required_digits_signs_and_units():
    assert with_sigma(0.0174533, 5e-5, math.degrees(1), signed=True) == '+1.0000 ± 0.0029'
    assert with_sigma(-0.0174533, None, math.degrees(1), signed=True) == '-1'
    assert [length_text(x) for x in (11200.3, 1004.2, 12.345, 0.09, 0.0, math.nan)] == [
        '11.20 km', '1004 m', '12.35 m', '90 mm', '0 m', 'unknown']
    assert [duration_text(t) for t in (59.96, 600.0, 3600.0, 7325.0)] == [
        '60.0 s', '10 min 00 s', '1 h 00 min', '2 h 02 min']
    assert with_sigma(-32050.0, 15191.0) == '-32000 ± 15000'
    assert with_sigma(-1e-4, 0.5) == '0.00 ± 0.50'
    assert with_sigma(1234.5, 560.0) == '1230 ± 560'
    assert deviation_text(0.968, 0.0152) == '-3.2 ± 1.5 %'
    assert deviation_text(1.065044, 78e-6) == '+6.5044 ± 0.0078 %'
    assert deviation_text(1.005044, 78e-6) == '+5044 ± 78 ppm'
    assert deviation_text(1.1, None) == '+10 %'


def test_lines_fit_a_narrow_terminal_and_keep_numbers_with_their_units(good):
    text = 'uncertainty is 21 %, too large; the limit is 5 %, after 16.5 m, ± 0.2 m/s at t = 7 s'
    for width in range(12, 60):
        lines = wrapped(text, width=width)
        assert not any(line.lstrip()[0] in '%m0=7' for line in lines), width
        assert ' '.join(line.strip() for line in lines) == text
    text = screen(whole(good), width=80)
    assert max(len(line) for line in text.splitlines()) <= 80
    for part in ('0.0500000 ± 0.0000012 m/pulse', '-1.0000 ± 0.0029 deg', 'wheels', 'WHEEL_SLIP',
                 'error budget', 'TOPIC_GAP: a gap of 3 s', '08:53:20', 'track width'):
        assert part in text, part


def test_the_screen_shows_all_values_in_fewer_than_30_lines(good):
    text = screen(good)
    for part in ('ACCEPTED', '1 leg, 11.20 km in 10 min 00 s',
                 '0.0500000 ± 0.0000012 m/pulse   (24 ppm)',
                 '20.00000 ± 0.00048 pulses/m',
                 '1.250000 ± 0.000030   (+25.0000 ± 0.0030 %)',
                 '-1.0000 ± 0.0029 deg   (-0.017453 ± 0.000050 rad)',
                 'pitch mounting      not determined', 'roll, pitch, yaw 0.000, 0.000, -1.000 deg',
                 '08-02 08:53:20', '1500 m', '0.10 m', 'TOPIC_GAP: odometer gap of 1.2 s',
                 '-> Use positions with height: ellipsoidal height of a receiver, or z.'):
        assert part in text, part
    assert len(text.splitlines()) < 30
    assert max(len(line) for line in text.splitlines()) <= 98


def test_the_most_severe_reasons_come_first(rejected):
    text = screen(rejected)
    assert text.index('REJECTED: do not use') < text.index('rejected because')
    assert text.index('GYRO_SIGN') < text.index('notes') < text.index('TOPIC_GAP')


def test_the_sentence_is_one_line_with_the_values(good, rejected):
    text = sentence(good)
    assert text == (
        'accepted: scale factor 0.0500000 ± 0.0000012 m/pulse (20.00000 ± 0.00048 pulses/m), '
        'yaw mounting -1.0000 ± 0.0029 deg, pitch mounting not determined; 1 of 1 leg usable')
    assert sentence(rejected).startswith('rejected: scale factor 0.05')


def test_colours_are_used_only_if_requested(good):
    assert '\x1b' not in screen(good)
    assert screen(good, styled=True).startswith('\x1b[1;32mACCEPTED\x1b[0m: ready to use')
    assert screen(good, styled=True).count('\x1b') == 2


def test_several_methods_are_shown_side_by_side(good):
    assert 'method  ' not in screen(good)
    other = replace(good.methods['two_point'], name='smoother', estimates={
        'scale_factor': Estimate(0.05001, 2e-6, 'm/pulse')})
    text = screen(replace(good, methods=good.methods | {'smoother': other}))
    rows = [line.split() for line in text.splitlines()
            if line.startswith(('  two_point', '  smoother'))]
    assert rows == [
        ['two_point', '0.0500000', '±', '0.0000012', '-1.0000', '±', '0.0029', '-', 'accepted'],
        ['smoother', '0.0500100', '±', '0.0000020', '-', '-', 'accepted']]


def test_pulses_per_metre_are_not_shown_for_speeds(good):
    speed = good.estimates | {'scale_factor': Estimate(0.98, 1e-3, '1')}
    calibration = replace(good, estimates=speed)
    assert 'scale factor 0.9800 ± 0.0010, yaw' in sentence(calibration)
    assert 'pulses/m' not in screen(calibration)
    joint = replace(good, estimates=good.estimates | {
        'scale_factor': Estimate(0.5, 1e-3, 'm/rad')})
    assert '2.0000 ± 0.0040 rad/m' in screen(joint)


def test_undetermined_values_are_shown_without_nan(nothing, good):
    empty = Calibration((), {}, {}, ())
    broken = replace(good, estimates=good.estimates | {
        'scale_factor': Estimate(math.nan, math.nan, 'm/pulse'),
        'yaw_mounting_angle': Estimate(0.0, math.nan, 'rad')})
    for calibration in (nothing, empty, broken):
        for text in (screen(calibration), sentence(calibration)):
            assert not re.search(r'\bnan\b|None', text)
    assert 'scale factor not determined' in sentence(nothing)
    assert '0 of 1 leg usable' in sentence(nothing)


def test_checks_of_legs_are_pooled_by_their_number_of_fixes():
    a, b = TrackCheck(1.0, 5.0, 0.5, 2.0, 0.1), TrackCheck(3.0, 4.0, 1.5, 3.0, 0.05)
    both = pooled_check([(a, 3), (None, 100), (b, 1)])
    assert both.rms == pytest.approx(math.sqrt((3 * 1.0 + 9.0) / 4), rel=1e-15)
    assert both.mean == pytest.approx((3 * 0.5 + 1.5) / 4, rel=1e-15)
    assert (both.max, both.end, both.percent_of_distance) == (5.0, 3.0, 0.1)
    assert pooled_check([(None, 5)]) is None
    assert pooled_check([]) is None


def test_the_coordinates_of_a_lever_arm_are_on_one_line(good):
    arm = {f'odometer_lever_arm_{axis}': Estimate(value, sigma, 'm') for axis, value, sigma in (
        ('x', -0.0058, 0.0031), ('y', None, None), ('z', 0.25, 0.06))}
    lines = screen(replace(good, estimates=dict(good.estimates) | arm)).splitlines()
    assert [line for line in lines if 'odometer at' in line or 'lever' in line] == [
        '  odometer at x, z    -0.0058 ± 0.0031, +0.250 ± 0.060 m   (assumes no sideslip)']


def whole(good):
    """Return a calibration with all that a screen can show, and many reasons."""
    found = good.methods['two_point']
    budget = {name: {'scale_factor': size, 'yaw_mounting_angle': size, 'shared': True}
              for name, size in (('accelerometer_bias_walk', 1e-4), ('fixes', 9e-5),
                                 ('heading', 1e-9))}
    methods = {name: replace(found, name=name, details=found.details | {'budget': budget})
               for name in ('two_point', 'wheels', 'smoother')}
    notes = tuple(Reason(Code.TOPIC_GAP, f'a gap of {n} s in what the odometer sent, and more '
                         'words than fit on a line') for n in range(4))
    return replace(good, methods=methods, reasons=(Reason(Code.WHEEL_SLIP, 'it spun'), *notes),
                   estimates=good.estimates | {
                       'track_width': Estimate(1.52, 0.01, 'm', 'smoother')})


def test_a_terminal_with_few_rows_omits_details_that_the_report_has(good):
    full = screen(whole(good), width=80).splitlines()
    fits = {rows: screen(whole(good), width=80, rows=rows) for rows in (99, len(full) - 1, 30)}
    assert fits[99].splitlines() == full
    assert 'under 1 %' in fits[99]
    assert 'under 1 %' not in fits[len(full) - 1]
    assert 'TOPIC_GAP: a gap' in fits[len(full) - 1]
    assert len(fits[30].splitlines()) <= 30
    assert 'notes, see the report: TOPIC_GAP' in fits[30]
    assert 'error budget' not in fits[30]
    assert 'Drive gently' in fits[30], 'what to do is never left out'


def test_a_brief_screen_omits_details_and_only_names_the_notes(good):
    full, brief = screen(whole(good)), screen(whole(good), brief=True)
    assert len(brief.splitlines()) < len(full.splitlines()) - 15
    for part in ('error budget', 'under 1 %', 'method  ', 'leg  start', 'TOPIC_GAP: a gap'):
        assert part in full
        assert part not in brief
    for part in ('0.0500000 ± 0.0000012 m/pulse', 'Drive gently', 'notes, see the report: TOPIC'):
        assert part in brief
    several = replace(whole(good), legs=good.legs * 2)
    assert 'leg  start' in screen(several, brief=True)


def test_a_tracked_point_replaces_the_antenna_in_a_local_frame(good):
    arms = {f'antenna_lever_arm_{axis}': Estimate(0.5, 0.01, 'm', 'two_point') for axis in 'xyz'}
    seen = replace(whole(good), estimates=good.estimates | arms)
    note = (Reason(Code.LOCAL_FRAME, 'north is unknown'),)
    local = replace(seen, legs=tuple(replace(leg, reasons=leg.reasons + note)
                                     for leg in good.legs))
    assert '  antenna at x, y, z  +0.50' in screen(seen)
    assert '  tracked point at    x, y, z: +0.500 ± 0.010, ' in screen(local)
    assert 'antenna' not in screen(local)
    assert [row['name'] for row in value_rows(local)[-3:]] == [
        f'tracked point lever arm {axis}' for axis in 'xyz']
    assert source_label('antenna_lever_arm') == 'antenna lever arm'


def test_the_same_reason_of_many_legs_is_one_line(good):
    """Many legs are too short, each with another length: one line names all of them."""
    reasons = [Reason(Code.LEG_TOO_SHORT, f'leg {n}: {60 + n} m between the marks')
               for n in range(1, 36) if n not in (4, 30)]
    reasons += [Reason(Code.WHEEL_SLIP, f'leg {n}: slip of {n} m') for n in (2, 9)]
    reported = [r.text for r in join_same_reasons((*reasons, GAP))]
    assert reported == ['legs 1 to 3, 5 to 29 and 31 to 35; of leg 1: 61 m between the marks',
                        'leg 2: slip of 2 m', 'leg 9: slip of 9 m', GAP.text]


@pytest.mark.parametrize(('error', 'sigma', 'shown'), [
    (0.012, 4e-4, 'gyro scale z        0.98800 ± 0.00040'), (0.004, 4e-4, None),
    (0.012, 5e-3, None)])
def test_a_gyro_scale_far_from_1_is_shown(good, error, sigma, shown):
    """A gyro that reads 1.2 % too much needs a factor of 0.988; near 1 or uncertain: not shown."""
    method = good.methods['two_point']
    method = replace(method, details=method.details | {
        'gyro_scale_z': {'value': error, 'sigma': sigma}})
    text = screen(replace(good, methods={'two_point': method}))
    assert (shown in text) if shown else ('gyro scale' not in text)


def test_the_path_ratio_is_compared_with_the_scale_or_the_factor_as_sent(good):
    assert 'path ratio' not in screen(good)
    legs = tuple(replace(good.legs[0], path_ratio=ratio, distance=distance)
                 for ratio, distance in ((0.0505, 1000.0), (0.0508, 2000.0)))
    line = next(x for x in screen(replace(good, legs=legs)).splitlines() if 'path ratio' in x)
    assert line.split()[2:4] == ['0.05070', 'm/pulse']
    assert line.endswith('fixes / odometer, +1.4 % from the scale factor')
    # the path ratio of whole km/h is 0.9947, the factor as sent, 0.8 % above the exact one
    estimates = {'scale_factor': Estimate(0.9867, 3e-4, '1'),
                 'scale_factor_as_sent': Estimate(0.9947, 3e-4, '1')}
    text = screen(replace(good, estimates=good.estimates | estimates,
                          legs=(replace(good.legs[0], path_ratio=0.9947, distance=1000.0),)))
    line = next(x for x in text.splitlines() if 'path ratio' in x)
    assert line.endswith('0.9947   fixes / odometer, +0.0 % from the factor of the raw speed')


def test_each_error_source_is_shown_with_size_and_share():
    head, fix, heading, small = budget_lines(TABLE, 0.02, 0.01)
    assert head.split() == ['error', 'budget', 'scale,', 'ppm', 'yaw,', 'deg', 'pitch,', 'deg']
    # 4e-5 of 0.02 is 2000 ppm; 3e-3 rad is 0.17 deg and 9 of 25 parts of the variance
    assert fix.split() == ['fix', 'end', '2000', '100%', '0.17', '36%', '-']
    assert heading.split() == ['initial', 'heading', '-', '0.23', '64%', '-', 'shared', 'by',
                               'all', 'legs']
    assert small.split() == ['under', '1', '%:', 'quantisation']
    # an undetermined value has no number
    lines = budget_lines(TABLE, 0.02, 0.01, {'yaw_mounting_angle'})
    assert '0.17' not in ''.join(lines)
    assert 'initial heading' in lines[-1]
    assert budget_lines({}, 1.0, 0.01) == budget_lines(None, 1.0, 0.01) == []

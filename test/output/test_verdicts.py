# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Verdicts in the table of methods: a method is not better than its legs."""

from dataclasses import replace
import json

from calibration_parts import CREATED
import pytest

from odocal_ros.output import report_tables
from odocal_ros.output.files import as_json
from odocal_ros.output.report import report_html
from odocal_ros.output.summary import screen
from odocal_ros.output.tables import leg_verdicts, shown_verdict
from odocal_ros.output.value_text import accept_line, join_same_reasons
from odocal_ros.pipeline.acceptance import accept
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
DEAD = Reason(Code.WHEEL_DEAD, 'the left wheel does not count')
SLIP = Reason(Code.WHEEL_SLIP, 'a wheel spun')
FAR = Reason(Code.SCALE_FAR_FROM_NOMINAL, 'far off')


def later(leg, hours, **changes):
    shift = hours * 3600 * 10**9
    return replace(leg, start_ns=leg.start_ns + shift, stop_ns=leg.stop_ns + shift, **changes)


@pytest.mark.parametrize(('of_method', 'of_legs', 'shown'), [
    ((), [()], 'accepted'),
    ((), [(DEAD,)], 'rejected (leg)'),
    ((FAR,), [(DEAD,)], 'rejected (leg)'),
    ((DEAD,), [(DEAD,)], 'rejected'),
    ((), [(SLIP,)], 'caution (leg)'),
    ((FAR,), [(SLIP,)], 'caution'),
    ((), [(DEAD,), ()], 'accepted'),            # only the good leg is used
    ((), [(DEAD,), (SLIP,)], 'caution (legs)'),
    ((), [(DEAD,), (DEAD,)], 'rejected (legs)')])
def test_the_verdict_of_a_method_is_not_better_than_its_legs(good, of_method, of_legs, shown):
    method = replace(good.methods['two_point'], reasons=of_method)
    legs = tuple(later(good.legs[0], k, reasons=reasons) for k, reasons in enumerate(of_legs))
    assert shown_verdict(method, legs) == shown


def test_screen_and_report_show_the_verdict_of_the_legs(good):
    method = good.methods['two_point']
    methods = {'two_point': method, 'smoother': replace(method, name='smoother')}
    leg = replace(good.legs[0], reasons=(DEAD,), methods=methods)
    calibration = replace(good, reasons=(DEAD,), methods=methods, legs=(leg,))
    text = screen(calibration)
    rows = [line for line in text.splitlines() if line.startswith(('  two_point', '  smoother'))]
    assert [row.endswith('rejected (leg)') for row in rows] == [True, True]
    assert '0.0500000 ± 0.0000012' in rows[0]
    assert report_tables.method_table(methods, (leg,))['verdicts'] == ['rejected (leg)'] * 2
    both = replace(calibration, legs=(leg, later(leg, 1, reasons=())))
    page = report_html(both, Config(), as_json(both, Config(), [], CREATED))
    assert page.count('<td>rejected (leg)</td>') == 2      # in the table of the first leg


def test_a_drive_given_twice_is_not_used_and_its_data_do_not_count(good):
    leg = good.legs[0]
    legs = (leg, replace(leg, reasons=(SLIP,), bag='copy'))
    assert shown_verdict(good.methods['two_point'], legs) == 'accepted'
    assert leg_verdicts(legs) == ['accepted', 'not used']
    text = screen(replace(good, legs=legs))
    first, second = (line for line in text.splitlines() if '08-02 08:53:20' in line)
    assert first.endswith('accepted')
    assert second.endswith('not used')
    assert '\n  leg 1: drive; leg 2: copy\n' in text


def test_one_bag_is_not_named_and_long_names_keep_the_width(good):
    assert 'drive' not in screen(good)
    names = ['rosbag2_of_a_very_long_drive_2026_11_22-02_11', 'rosbag2_of_a_long_drive_2026_11_23']
    text = screen(replace(good, legs=tuple(later(good.legs[0], k, bag=names[k % 2])
                                           for k in range(3))))
    assert max(map(len, text.splitlines())) <= 98
    assert f'legs 1 and 3: {names[0]}; leg 2:' in text


def test_the_same_reason_of_several_legs_is_shown_once():
    slip, dead = Code.WHEEL_SLIP, Code.WHEEL_DEAD
    reasons = (Reason(slip, 'leg 1: it spun'), Reason(slip, 'leg 3: it spun'),
               Reason(slip, 'leg 2: it slid'), Reason(slip, 'it spun'),
               Reason(dead, 'leg 2: it spun'), Reason(slip, 'leg 4: it spun'))
    assert [(r.code, r.text) for r in join_same_reasons(reasons)] == [
        (slip, 'legs 1, 3 and 4: it spun'), (slip, 'leg 2: it slid'), (slip, 'it spun'),
        (dead, 'leg 2: it spun')]


def test_the_line_of_a_decision_names_each_reason_once(good):
    reasons = [Reason(Code.ODOMETER_STILL, 'one'), Reason(Code.NO_FIX, 'two'),
               Reason(Code.ODOMETER_STILL, 'three')]
    config = with_settings(Config(), {'accept.scale_ratio_min': 0.9})
    result = replace(good, reasons=tuple(reasons))
    line = json.loads(accept_line(result, accept(result, config), config))
    assert line['reasons'] == ['ODOMETER_STILL', 'NO_FIX']

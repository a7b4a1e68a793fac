"""A method's row follows the leg: its figures are shown, but not as good."""

from dataclasses import replace

import pytest

from odocal_ros.config import Config
from odocal_ros.output import report_tables
from odocal_ros.output.files import as_json
from odocal_ros.output.report import report_html
from odocal_ros.output.summary import screen
from odocal_ros.output.verdicts import shown_verdict
from odocal_ros.reasons import Code, Reason

DEAD = Reason(Code.WHEEL_DEAD, 'the left wheel does not count')
SLIP = Reason(Code.WHEEL_SLIP, 'a wheel spun')
FAR = Reason(Code.SCALE_FAR_FROM_NOMINAL, 'far off')


@pytest.mark.parametrize(('of_method', 'of_legs', 'shown'), [
    ((), [()], 'accepted'),
    ((), [(DEAD,)], 'rejected (leg)'),
    ((FAR,), [(DEAD,)], 'rejected (leg)'),
    ((DEAD,), [(DEAD,)], 'rejected'),
    ((), [(SLIP,)], 'caution (leg)'),
    ((FAR,), [(SLIP,)], 'caution'),
    ((), [(DEAD,), ()], 'accepted'),            # the good leg alone is in the figures
    ((), [(DEAD,), (SLIP,)], 'caution (legs)'),
    ((), [(DEAD,), (DEAD,)], 'rejected (legs)')])
def test_the_row_is_no_better_than_its_legs(good, of_method, of_legs, shown):
    method = replace(good.methods['two_point'], reasons=of_method)
    legs = tuple(replace(good.legs[0], reasons=reasons) for reasons in of_legs)
    assert shown_verdict(method, legs) == shown


def test_screen_and_report_show_it(good):
    method = good.methods['two_point']
    methods = {'two_point': method, 'smoother': replace(method, name='smoother')}
    leg = replace(good.legs[0], reasons=(DEAD,), methods=methods)
    calibration = replace(good, reasons=(DEAD,), methods=methods, legs=(leg,))
    text = screen(calibration)
    rows = [line for line in text.splitlines() if line.startswith(('  two_point', '  smoother'))]
    assert [row.endswith('rejected (leg)') for row in rows] == [True, True]
    assert '0.0500000 ± 0.0000012' in rows[0]
    assert report_tables.method_table(methods, (leg,))['verdicts'] == ['rejected (leg)'] * 2
    both = replace(calibration, legs=(leg, replace(leg, reasons=())))
    page = report_html(both, Config(), as_json(both, Config(), [], ''))
    assert page.count('<td>rejected (leg)</td>') == 2      # in the table of the first leg

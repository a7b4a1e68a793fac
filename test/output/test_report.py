# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""report.html: complete, valid, self-contained, with every number."""

from dataclasses import replace
from html import unescape
import math
import re

from calibration_parts import CREATED
import numpy as np
import pytest
from report_pages import drawn, evidence, INPUTS, page_of, three_methods

from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.calib.scale_variation import Sections
from odocal_ros.output import report
from odocal_ros.output.files import as_json, write_results
from odocal_ros.output.report import report_or_error_page
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow
MADE = '2026-01-02 03:04:05 UTC'
FIGURES = ('Track', 'Residuals', 'Scale by section', 'Speed and turn rate', 'Fix quality')


def test_the_report_of_a_leg_is_complete(good):
    page, text, parsed = page_of(drawn(good))
    assert 'accepted : ready to use; scale factor 0.0500000 ± 0.0000012 m/pulse' in text
    for part in ('20.00000 ± 0.00048 pulses/m', '24 ppm', '+25.0000 ± 0.0030 %',
                 '-1.0000 ± 0.0029 deg', '-0.017453 ± 0.000050 rad', 'not determined',
                 'TOPIC_GAP', 'odometer gap of 1.2 s', 'Check the sender',
                 '1500 m', '0.10 m', '2018-08-02 08:53:20 UTC', 'ab' * 32, '/imu/data',
                 '1 of 202 fixes status below 0; first at t = 7.0 s', MADE, *FIGURES):
        assert part in text, part
    assert parsed.tags['svg'] == parsed.tags['figure'] == 5
    for words in ('east of the start, km', 'along, m', 'scale minus result, ppm', 'speed, km/h',
                  'turn rate, deg/s', 'sigma of a fix, m', 'distance driven, km'):
        assert words in text, words


def test_every_number_of_the_result_has_all_digits_in_the_report(good):
    third = {name: replace(e, value=e.value and e.value / 3, sigma=e.sigma and e.sigma / 3)
             for name, e in good.estimates.items()}
    good = replace(good, estimates=third)
    content = as_json(good, Config(), INPUTS, CREATED)
    _, text, _ = page_of(good)
    numbers = [x for entry in content['result'].values() for x in entry.values()]
    numbers = [x for group in numbers for x in (group if isinstance(group, list) else [group])]
    numbers = [x for x in numbers if isinstance(x, float)]
    assert len(numbers) > 10
    for number in numbers:
        assert repr(number) in text, number


def test_methods_are_shown_side_by_side(good):
    _, text, parsed = page_of(three_methods(good))
    assert 'Methods and legs side by side' in text
    assert 'method two point smoother wheels' in text, 'the result is of the first'
    for part in ('1.520 ± 0.010 m', '+12.0 ± 3.0 ms', 'track width', 'Error budget of the method '
                 'wheels', 'leg 2, wheels', 'all legs, smoother'):
        assert part in text, part
    assert parsed.tags['svg'] == 2 * 5 + 1


def test_the_method_that_gave_the_result_comes_first(good):
    result = {n: replace(e, method='smoother') for n, e in good.estimates.items()}
    base = good.methods['two_point']
    both = replace(good, estimates=result, methods={
        'two_point': base, 'smoother': replace(base, name='smoother')})
    _, text, _ = page_of(both)
    assert 'method smoother two point' in text
    budgets = re.findall(r'Error budget of the method (\w+)', text)
    assert budgets == sorted(budgets, key=['smoother', 'two'].index)
    assert 'roll, pitch, yaw 0.000, -0.000' not in page_of(replace(
        good, imu_rotation_rpy=(0.0, -1e-9, 0.0)))[1]
    assert 'as configured), about fixed axes' in page_of(good)[1]


def test_each_panel_of_the_comparison_has_the_rows_that_have_a_value(good):
    page, _, _ = page_of(three_methods(good))
    (panels,) = re.findall(r'<svg[^>]*aria-label="Side by side.*?</svg>', page, re.DOTALL)
    # scale: three methods, of all and of two legs; yaw: not by the wheels
    assert len(re.findall('>leg [12], wheels<', panels)) == 2
    assert len(re.findall('>leg [12], smoother<', panels)) == 4


def test_rejected_and_missing_values_are_rendered(rejected, nothing, good):
    _, text, _ = page_of(rejected)
    assert 'rejected : do not use these values' in text
    assert text.index('GYRO_SIGN') < text.index('TOPIC_GAP')
    _, text, _ = page_of(nothing, inputs=[])
    assert 'NO_FIX' in text
    assert 'No figures for this leg' in text
    broken = replace(good, estimates=good.estimates | {
        'scale_factor': Estimate(math.nan, math.nan, 'm/pulse'),
        'yaw_mounting_angle': Estimate(0.0, math.nan, 'rad'),
        'track_width': Estimate(1.5, None, 'm')})
    page_of(drawn(broken))
    page_of(Calibration((), {}, {}, ()), inputs=[])
    bare = replace(good.legs[0], track_n=None, before=None, after=None, evidence=None)
    _, text, parsed = page_of(replace(good, legs=(bare,)))
    assert parsed.tags['svg'] == 0
    assert 'No figures for this leg' in text
    assert '4 fixes see the reasons' in text


@pytest.mark.parametrize('rows', [0, 1, 2])
def test_evidence_of_very_few_rows_is_rendered(good, rows):
    few = evidence(max(rows, 1), 1)
    none = np.empty(0)
    few = replace(few, **{name: getattr(few, name)[:rows] for name in (
        't', 'distance', 'speed', 'yaw_rate', 'track_n', 'track_before_n')},
        t_excluded=none, excluded_because=(), excluded=0,
        sections=Sections(none, none, none, none))
    page_of(replace(good, legs=(replace(good.legs[0], evidence=few),)))


def test_untrusted_names_are_text_not_markup(good):
    evil = '<script>alert("x")</script>&amp;\'--><b>'
    inputs = [{'bag': evil, 'sha256': 'cd' * 32, 'topics': {'imu': f'/{evil}'}}]
    config = with_settings(Config(), {'odometer.field': evil, 'imu.grade': 'tactical'})
    page, text, parsed = page_of(drawn(good, bag=evil), config, inputs)
    assert parsed.tags['script'] == 0
    assert unescape('&lt;script&gt;alert("x")') in text
    assert 'imu.grade tactical consumer' in text


def test_the_report_of_many_legs_stays_within_the_size_limit(good, monkeypatch):
    # room for the figures of one leg and a half
    size = sum(len(figure.svg) for leg in report._with_figures(drawn(good))['legs']
               for figure in leg['figures'])
    monkeypatch.setattr(report, 'MAX_BYTES', 3 * size // 2)
    leg = replace(good.legs[0], evidence=evidence())
    legs = tuple(replace(leg, start_ns=leg.start_ns + k * 10**12) for k in range(3))
    _, text, _ = page_of(replace(good, legs=legs))
    assert 'figures of the newest legs only, none of legs 1, 2.' in text
    # the newest leg is always shown, whatever its size
    monkeypatch.setattr(report, 'MAX_BYTES', 10)
    variables = report._with_figures(replace(good, legs=legs))
    assert [bool(leg['figures']) for leg in variables['legs']] == [False, False, True]
    assert variables['without_figures'] == [1, 2]


def test_a_page_is_reproducible_and_does_not_change_matplotlib_settings(good):
    import matplotlib
    before = dict(matplotlib.rcParams)
    assert page_of(drawn(good))[0] == page_of(drawn(good))[0]
    assert dict(matplotlib.rcParams) == before


def test_the_report_is_written_last_and_only_if_configured(good, nothing, tmp_path):
    written = write_results(drawn(good), Config(), tmp_path, INPUTS, CREATED)
    assert (written[0].name, written[-1].name) == ('calibration.json', 'report.html')
    assert '<svg' in written[-1].read_text()
    assert 'evidence' not in written[0].read_text()
    config = with_settings(Config(), {'output.formats': ('params',)})
    write_results(nothing, config, tmp_path, INPUTS, CREATED, force=True)
    assert not (tmp_path / 'report.html').exists()


@pytest.mark.parametrize('error', [ImportError('no', name='matplotlib'), ValueError('<odd>')])
def test_a_failed_report_does_not_prevent_the_other_files(good, tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(report, 'report_html', fail)
    reported = []
    write_results(good, Config(), tmp_path, INPUTS, CREATED, warn=reported.append)
    assert (tmp_path / 'calibration.json').exists()
    assert len(reported) == 1
    assert 'report.html: could not be drawn' in reported[0]
    page, why = report_or_error_page(good, Config(), {})
    assert 'calibration.json' in page
    assert '<odd>' not in page
    assert why in reported[0]


def test_the_four_main_values_are_shown_below_the_verdict(good, nothing):
    page = page_of(good)[0]
    head = page.partition('class="headline"')[2].partition('</dl>')[0]
    assert re.findall(r'<dt>(.*?)</dt>', head)[:3] == [
        'scale factor', 'yaw mounting', 'pitch mounting']
    assert '0.0500000 ± 0.0000012 m/pulse<span class="other">± 24 ppm' in head
    assert '-1.0000 ± 0.0029 deg' in head
    assert 'not determined' in head
    assert page.index('class="headline"') > page.index('class="verdict')
    assert 'class="headline"' not in page_of(nothing)[0]

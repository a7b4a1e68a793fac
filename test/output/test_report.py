# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""report.html: whole, valid, alone, with every number, and as a browser shows it."""

from collections import Counter
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
import math
import re
import shutil
import subprocess

from conftest import CREATED
import numpy as np
import pytest

from odocal_ros.calib.evidence import Evidence
from odocal_ros.calib.result import Calibration, Estimate, MethodResult, Source
from odocal_ros.calib.scale_variation import Sections, SpeedScale
from odocal_ros.output import report, scale_plots
from odocal_ros.output.files import as_json, write_results
from odocal_ros.output.plot_style import apply_style
from odocal_ros.output.plots import _biases, leg_figures
from odocal_ros.output.report import report_html, report_or_error_page
from odocal_ros.output.scale_plots import by_speed, by_window
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow
MADE = '2026-01-02 03:04:05 UTC'
INPUTS = [{'bag': 'drive', 'sha256': 'ab' * 32, 'topics': {'imu': '/imu/data'}}]
VOID = {'meta', 'br', 'link', 'img', 'hr', 'input'}
ALL_ODD = ('fix not used', 'no IMU', 'no odometer', 'fitted to here', 'slip')
FIGURES = ('Track', 'Residuals', 'Scale by section', 'Speed and turn rate', 'Fix quality')


def evidence(rows=900, fixes=200):
    """Return evidence of a drive of 6 km along an arc, with two fixes left out."""
    t = np.linspace(0.0, 600.0, rows)
    track = np.stack([3000 * np.sin(t / 300), 3000 * (1 - np.cos(t / 300)), 0 * t], -1)
    k = np.linspace(0, rows - 1, fixes).astype(int)
    noise = np.random.default_rng(5).normal(0.0, 0.5, (fixes, 2))
    edge = np.linspace(0.0, 6000.0, 11)
    ratio = np.append(1 + 1e-4 * np.sin(np.arange(9)), np.nan)
    return Evidence(
        t, 10 * t, np.full(rows, 10.0), np.full(rows, 1 / 300), track, 1.02 * track, t[k],
        10 * t[k], track[k], np.full(fixes, 0.5), np.arange(fixes) % 4 - 1, noise,
        noise + (t[k] / 5)[:, None], Sections(edge[:-1], edge[1:], ratio, np.full(10, 2e-4)),
        np.array([7.0, 9.0]), ('status below 0', 'sigma above 3 m'), fixes, 2)


def drawn(calibration, **more):
    """Return the calibration with evidence in each of its legs."""
    return replace(calibration, legs=tuple(
        replace(leg, evidence=evidence(), **more) for leg in calibration.legs))


def three_methods(calibration):
    """Return a calibration of two legs by three methods, one of which has what others lack."""
    base = calibration.methods['two_point']
    wheels = MethodResult('wheels', (), {
        'scale_factor': Estimate(0.05001, 2e-6, 'm/pulse'),
        'scale_factor_left': Estimate(0.0499, 3e-6, 'm/pulse'),
        'track_width': Estimate(1.52, 0.01, 'm'), 'heading_error': Estimate(0.01, 0.001, 'rad'),
        'odometer_delay': Estimate(0.012, 0.003, 's')},
        ('scale_factor',), (Source('fixes', np.array([[2e-6]])),),
        {'budget': {'fixes': {'scale_factor': 2e-6, 'track_width': 0.01, 'shared': True}}})
    smoother = replace(base, name='smoother')
    methods = {'smoother': smoother, 'wheels': wheels, 'two_point': base}
    legs = tuple(replace(leg, methods=methods, evidence=evidence())
                 for leg in (*calibration.legs, *calibration.legs))
    return replace(calibration, methods=methods, legs=legs)


class Balance(HTMLParser):
    """Fails on tags that do not match, collects text and ids."""

    def __init__(self):
        super().__init__()
        self.open, self.text, self.ids, self.links, self.tags = [], [], [], [], Counter()

    def handle_starttag(self, tag, attrs):
        self._note(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self._note(tag, attrs)

    def _note(self, tag, attrs):
        self.tags[tag] += 1
        assert len(attrs) == len(dict(attrs)), f'{tag}: an attribute twice'
        for name, value in attrs:
            if name == 'id':
                self.ids.append(value)
            elif name in ('href', 'src', 'xlink:href', 'action', 'data', 'poster', 'srcset'):
                self.links.append(value)

    def handle_endtag(self, tag):
        assert self.open, f'</{tag}> closes nothing'
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ('style', 'script'):
            self.text.append(data)


def page_of(calibration, config=None, inputs=INPUTS):
    """Return the page, and what a parser makes of it; every page is held to the same rules."""
    config = config or Config()
    page = report_html(calibration, config, as_json(calibration, config, inputs, CREATED))
    parsed = Balance()
    parsed.feed(page)
    parsed.close()
    assert parsed.open == []
    assert len(parsed.ids) == len(set(parsed.ids)), 'an id twice'
    assert all(link.startswith('#') for link in parsed.links), parsed.links
    assert {link[1:] for link in parsed.links} <= set(parsed.ids)
    assert set(re.findall(r'url\(([^)]*)\)', page)) <= {f'#{i}' for i in parsed.ids}
    assert not re.search(r'https?:|@import|<script', page)
    assert not re.search(r'\bnan\b|\bNone\b', ' '.join(parsed.text))
    assert len(page.encode()) < 3_000_000
    return page, ' '.join(' '.join(parsed.text).split()), parsed


def test_a_leg_is_told_whole(good):
    page, text, parsed = page_of(drawn(good))
    assert 'accepted : ready to use; scale factor 0.0500000 ± 0.0000012 m/pulse' in text
    for part in ('20.00000 ± 0.00048 pulses/m', '24 ppm', '+250000 ± 30 ppm',
                 '-1.0000 ± 0.0029 deg', '-0.017453 ± 0.000050 rad', 'not determined',
                 'TOPIC_GAP', 'odometer gap of 1.2 s', 'Check the sender',
                 '1500 m', '0.10 m', '2018-08-02 08:53:20 UTC', 'ab' * 32, '/imu/data',
                 '1 of 202 fixes status below 0; first at t = 7.0 s', MADE, *FIGURES):
        assert part in text, part
    assert parsed.tags['svg'] == parsed.tags['figure'] == 5
    for words in ('east of the start, km', 'along, m', 'scale minus result, ppm', 'speed, km/h',
                  'turn rate, deg/s', 'sigma of a fix, m', 'distance driven, km'):
        assert words in text, words


def test_every_number_of_the_result_is_there_in_full(good):
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


def test_any_set_of_methods_stands_side_by_side(good):
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
    (panels,) = re.findall(r'<svg[^>]*aria-label="Bars: one sigma.*?</svg>', page, re.DOTALL)
    # scale: three methods, of all and of two legs; yaw: not by the wheels
    assert len(re.findall('>leg [12], wheels<', panels)) == 2
    assert len(re.findall('>leg [12], smoother<', panels)) == 4


def test_what_is_rejected_or_missing_renders_too(rejected, nothing, good):
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
def test_evidence_of_next_to_nothing_renders_too(good, rows):
    few = evidence(max(rows, 1), 1)
    none = np.empty(0)
    few = replace(few, **{name: getattr(few, name)[:rows] for name in (
        't', 'distance', 'speed', 'yaw_rate', 'track_n', 'track_before_n')},
        t_excluded=none, excluded_because=(), excluded=0,
        sections=Sections(none, none, none, none))
    page_of(replace(good, legs=(replace(good.legs[0], evidence=few),)))


def test_names_from_outside_are_text_not_markup(good):
    evil = '<script>alert("x")</script>&amp;\'--><b>'
    inputs = [{'bag': evil, 'sha256': 'cd' * 32, 'topics': {'imu': f'/{evil}'}}]
    config = with_settings(Config(), {'odometer.field': evil, 'imu.grade': 'tactical'})
    page, text, parsed = page_of(drawn(good, bag=evil), config, inputs)
    assert parsed.tags['script'] == 0
    assert unescape('&lt;script&gt;alert("x")') in text
    assert 'imu.grade tactical consumer' in text


def test_what_is_odd_is_marked_on_the_track(good):
    def words(found):
        smoothed = {'slips': [{'t': 50.0, 'duration': 1.0}]}
        with apply_style():
            return unescape(leg_figures(found, 'one', smoothed=smoothed)[0][2])
    plain = evidence()
    odd = replace(plain, gaps=(('IMU', 100.0, 103.0), ('odometer', 200.0, 201.0),
                               ('odometer', 300.0, 300.5)), t_fit=480.0)
    shown, usual = words(odd), words(plain)
    assert {text: shown.count(f'>{text}<') for text in ALL_ODD} == dict.fromkeys(ALL_ODD, 1)
    assert [text for text in ALL_ODD if f'>{text}<' in usual] == ['fix not used', 'slip']
    hole = (plain.t_fix < 100.0) | (plain.t_fix > 130.0)
    lost = replace(plain, **{name: getattr(plain, name)[hole] for name in (
        't_fix', 'fix_n', 'fix_distance', 'fix_sigma', 'fix_status', 'residual',
        'residual_before')})
    assert '>no fix used<' in words(lost)


def test_many_legs_stay_within_the_size(good, monkeypatch):
    # room for the figures of one leg and a half
    one = sum(len(drawing) for leg in report._draw_figures(drawn(good))[0]
              for *_, drawing in leg['figures'])
    monkeypatch.setattr(report, 'MOST_BYTES', 3 * one // 2)
    leg = replace(good.legs[0], evidence=evidence())
    legs = tuple(replace(leg, start_ns=leg.start_ns + k * 10**12) for k in range(3))
    _, text, _ = page_of(replace(good, legs=legs))
    assert 'figures of the newest legs only, none of legs 1, 2.' in text
    # one alone is shown however large it is: the newest
    monkeypatch.setattr(report, 'MOST_BYTES', 10)
    told, _, missing = report._draw_figures(replace(good, legs=legs))
    assert [bool(leg['figures']) for leg in told] == [False, False, True]
    assert missing == [1, 2]


def test_of_many_legs_the_newest_are_side_by_side(good, monkeypatch):
    monkeypatch.setattr(scale_plots, 'MOST_LEGS', 2)
    with apply_style():
        result = replace(good, legs=good.legs[:1] * 3)
        (_, says, drawing), = scale_plots.comparison_figure(result, 'all')
    assert 'Of 3 legs, the newest 2.' in says
    assert [f'leg {k}, two' in drawing for k in (1, 2, 3)] == [False, True, True]


def test_a_page_is_the_same_each_time_and_leaves_no_trace_in_matplotlib(good):
    import matplotlib
    before = dict(matplotlib.rcParams)
    assert page_of(drawn(good))[0] == page_of(drawn(good))[0]
    assert dict(matplotlib.rcParams) == before


def test_the_file_is_written_last_and_only_when_asked(good, nothing, tmp_path):
    written = write_results(drawn(good), Config(), tmp_path, INPUTS, CREATED)
    assert (written[0].name, written[-1].name) == ('calibration.json', 'report.html')
    assert '<svg' in written[-1].read_text()
    assert 'evidence' not in written[0].read_text()
    config = with_settings(Config(), {'output.formats': ('params',)})
    write_results(nothing, config, tmp_path, INPUTS, CREATED, force=True)
    assert not (tmp_path / 'report.html').exists()


@pytest.mark.parametrize('error', [ImportError('no', name='matplotlib'), ValueError('<odd>')])
def test_a_report_that_fails_costs_no_number(good, tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(report, 'report_html', fail)
    told = []
    write_results(good, Config(), tmp_path, INPUTS, CREATED, tell=told.append)
    assert (tmp_path / 'calibration.json').exists()
    assert len(told) == 1
    assert 'report.html: could not be drawn' in told[0]
    page, why = report_or_error_page(good, Config(), {})
    assert 'calibration.json' in page
    assert '<odd>' not in page
    assert why in told[0]


# ---- as a browser shows it -------------------------------------------------------------------

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which(
    'google-chrome')
FLAGS = ('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
         '--disable-background-networking', '--disable-component-update', '--disable-sync',
         '--hide-scrollbars', '--force-device-scale-factor=1')


def shown(page, folder, *asked):
    done = subprocess.run(
        [CHROMIUM, *FLAGS, f'--user-data-dir={folder / "profile"}', *asked, page.as_uri()],
        capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not CHROMIUM, reason='NO CHROMIUM FOUND: the report was not looked at in a '
                    'browser; apt-get install chromium')
def test_a_browser_shows_the_figures_and_nothing_sticks_out(good, tmp_path):
    page = tmp_path / 'report.html'
    html, _, _ = page_of(three_methods(good))
    # what only a browser knows: the layout, told in the title
    probe = ('<script>addEventListener("load", () => { document.title = JSON.stringify({'
             'wide: document.documentElement.scrollWidth, view: innerWidth,'
             'figures: [...document.querySelectorAll("figure svg")].map(s => '
             '[s.getBoundingClientRect().width, s.getBoundingClientRect().height]),'
             'out: [...document.querySelectorAll("figure svg")].filter(s => { const box = '
             's.getBoundingClientRect(); return [...s.querySelectorAll("text")].some(t => { const '
             'b = t.getBoundingClientRect(); return b.left < box.left - 2 || b.right > box.right '
             '+ 2 || b.top < box.top - 2 || b.bottom > box.bottom + 2; }); }).length,'
             'over: [...document.querySelectorAll("figure svg")].filter(s => { const b = '
             '[...s.querySelectorAll("text")].map(t => t.getBoundingClientRect()); return '
             'b.some((p, i) => b.some((q, k) => k > i && p.left < q.right - 1 && q.left < p.right '
             '- 1 && p.top < q.bottom - 1 && q.top < p.bottom - 1)); }).length }); })'
             '</script></body>')
    page.write_text(html.replace('</body>', probe))
    import json
    for width in (1280, 500):      # 500: the least that a headless window can be
        told = shown(page, tmp_path, f'--window-size={width},900', '--dump-dom')
        layout = json.loads(unescape(re.search(r'<title>(.*?)</title>', told).group(1)))
        assert layout['wide'] <= layout['view'], width
        assert len(layout['figures']) == 11
        assert min(w for w, _ in layout['figures']) > 0.8 * min(width, 1280 / 2.4) - 40
        assert layout['out'] == 0, 'text outside its figure'
        assert layout['over'] == 0, 'text over text'
    page.write_text(html)
    picture, paper = tmp_path / 'page.png', tmp_path / 'page.pdf'
    shown(page, tmp_path, '--window-size=900,3000', f'--screenshot={picture}')
    from PIL import Image  # matplotlib needs it too
    colours = np.asarray(Image.open(picture).convert('RGB')).reshape(-1, 3)[::2]
    for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):      # lines of the figures
        assert (np.abs(colours.astype(int) - colour).sum(axis=1) < 12).sum() > 200, colour
    shown(page, tmp_path, f'--print-to-pdf={paper}')
    sheets = len(re.findall(rb'/Type\s*/Page\b', paper.read_bytes()))
    assert 3 <= sheets <= 30


def test_the_four_most_important_values_stand_under_the_verdict_of_a_result(good, nothing):
    page = page_of(good)[0]
    head = page.partition('class="headline"')[2].partition('</dl>')[0]
    assert re.findall(r'<dt>(.*?)</dt>', head)[:3] == [
        'scale factor', 'yaw mounting', 'pitch mounting']
    assert '0.0500000 ± 0.0000012 m/pulse<span class="other">± 24 ppm' in head
    assert '-1.0000 ± 0.0029 deg' in head
    assert 'not determined' in head
    assert page.index('class="headline"') > page.index('class="verdict')
    assert 'class="headline"' not in page_of(nothing)[0]


def test_the_scale_against_speed_is_drawn_with_its_fit(good):
    bins = np.array([[5.0, 1.01, 1e-3, 12], [15.0, 0.99, 1e-3, 12]])
    found = SpeedScale(bins, (0.98, 1e-3), (0.14, 0.02), (-0.35, 0.03))
    with apply_style():
        title, says, drawn = by_speed(found, 'leg1')
    assert title == 'Scale against speed'
    assert 'the odometer reads 0.140 ± 0.020 m/s low and is 0.350 ± 0.030 s earlier' in says
    assert drawn.startswith('<svg')
    with apply_style():
        assert 'No fit: the speed varies too little' in by_speed(SpeedScale(bins), 'leg1')[1]


def test_the_scale_against_the_length_of_the_window_is_drawn():
    found = np.array([[2.0, 4e-3, 1e-3, 300], [20.0, 1e-3, 1e-3, 30], [200.0, 0.0, 1e-3, 12]])
    with apply_style():
        title, says, drawn = by_window(found, 'leg1')
    assert title == 'Scale against the length of the window'
    assert 'the fixes contain an odometer' in says
    assert all(f'>{length}<' in drawn for length in (2, 20, 200))


def test_a_panel_without_data_is_not_drawn():
    biases = np.stack([np.full((5, 3), 1e-4), np.zeros((5, 3))])
    with apply_style():
        assert 'accelerometer bias' not in _biases(np.arange(5.0), biases, 'leg1')[2]
        biases[1] += 0.01
        assert 'accelerometer bias' in _biases(np.arange(5.0), biases, 'leg1')[2]

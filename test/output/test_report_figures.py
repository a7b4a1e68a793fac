# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of the report: their marks and omissions, and the layout in a browser."""

from dataclasses import replace
from html import unescape
import re
import shutil
import subprocess

import numpy as np
import pytest
from report_pages import evidence, page_of, three_methods

from odocal_ros.calib.speed_scale import SpeedScale
from odocal_ros.output import scale_plots
from odocal_ros.output.plot_style import apply_style
from odocal_ros.output.plots import _biases, leg_figures
from odocal_ros.output.scale_plots import by_speed, by_window

pytestmark = pytest.mark.slow
ALL_ODD = ('fix not used', 'no IMU', 'no odometer', 'fitted to here', 'slip')
CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which(
    'google-chrome')
FLAGS = ('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
         '--disable-background-networking', '--disable-component-update', '--disable-sync',
         '--hide-scrollbars', '--force-device-scale-factor=1')


def test_gaps_and_unused_fixes_are_marked_on_the_track(good):
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


def test_the_newest_of_many_legs_are_shown_side_by_side(good, monkeypatch):
    monkeypatch.setattr(scale_plots, 'MAX_LEGS', 2)
    with apply_style():
        result = replace(good, legs=good.legs[:1] * 3)
        (_, says, drawing), = scale_plots.comparison_figure(result, 'all')
    assert 'Of 3 legs, the newest 2.' in says
    assert [f'leg {k}, two' in drawing for k in (1, 2, 3)] == [False, True, True]


def test_the_scale_is_drawn_against_speed_and_window_length(good):
    bins = np.array([[5.0, 1.01, 1e-3, 12], [15.0, 0.99, 1e-3, 12]])
    found = SpeedScale(bins, (0.98, 1e-3), (0.14, 0.02), (-0.35, 0.03))
    with apply_style():
        title, says, drawn = by_speed(found, 'leg1')
    assert title == 'Scale against speed'
    assert 'the odometer reads 0.140 ± 0.020 m/s low and is 0.350 ± 0.030 s earlier' in says
    assert drawn.startswith('<svg')
    with apply_style():
        assert 'No fit: the speed varies too little' in by_speed(SpeedScale(bins), 'leg1')[1]
    found = np.array([[2.0, 4e-3, 1e-3, 300], [20.0, 1e-3, 1e-3, 30], [200.0, 0.0, 1e-3, 12]])
    with apply_style():
        title, says, drawn = by_window(found, 'leg1')
    assert title == 'Scale in time windows of different length'
    assert 'the fixes contain an odometer' in says
    assert all(f'>{length}<' in drawn for length in (2, 20, 200))


def test_a_panel_without_data_is_not_drawn():
    biases = np.stack([np.full((5, 3), 1e-4), np.zeros((5, 3))])
    with apply_style():
        assert 'accelerometer bias' not in _biases(np.arange(5.0), biases, 'leg1')[2]
        biases[1] += 0.01
        assert 'accelerometer bias' in _biases(np.arange(5.0), biases, 'leg1')[2]


def shown(page, folder, *options):
    done = subprocess.run(
        [CHROMIUM, *FLAGS, f'--user-data-dir={folder / "profile"}', *options, page.as_uri()],
        capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not CHROMIUM, reason='NO CHROMIUM FOUND: the report was not looked at in a '
                    'browser; apt-get install chromium')
def test_a_browser_shows_the_figures_without_overflow(good, tmp_path):
    page = tmp_path / 'report.html'
    html, _, _ = page_of(three_methods(good))
    # the browser returns the layout in the title
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
    for width in (1280, 500):      # 500: smallest headless window
        reported = shown(page, tmp_path, f'--window-size={width},900', '--dump-dom')
        layout = json.loads(unescape(re.search(r'<title>(.*?)</title>', reported).group(1)))
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

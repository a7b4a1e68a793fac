# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pages of reports, checked by a parser, and calibrations with evidence for them."""

from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
import re

from calibration_parts import CREATED
import numpy as np

from odocal_ros.calib.evidence import Evidence
from odocal_ros.calib.result import Estimate, MethodResult, Source
from odocal_ros.calib.scale_variation import Sections
from odocal_ros.output.files import as_json
from odocal_ros.output.report import report_html
from odocal_ros.settings.config import Config

INPUTS = [{'bag': 'drive', 'sha256': 'ab' * 32, 'topics': {'imu': '/imu/data'}}]
VOID = {'meta', 'br', 'link', 'img', 'hr', 'input'}


def evidence(rows=900, fixes=200):
    """Return evidence of a drive of 6 km along an arc, with two unused fixes."""
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
    """Return a calibration of two legs by three methods, one of them with additional values."""
    base = calibration.methods['two_point']
    wheels = MethodResult('wheels', (), {
        'scale_factor': Estimate(0.05001, 2e-6, 'm/pulse'),
        'scale_factor_left': Estimate(0.0499, 3e-6, 'm/pulse'),
        'track_width': Estimate(1.52, 0.01, 'm'), 'odometer_delay': Estimate(0.012, 0.003, 's')},
        ('scale_factor',), (Source('fixes', np.array([[2e-6]])),),
        {'budget': {'fixes': {'scale_factor': 2e-6, 'track_width': 0.01, 'shared': True}}})
    smoother = replace(base, name='smoother')
    methods = {'smoother': smoother, 'wheels': wheels, 'two_point': base}
    legs = tuple(replace(leg, methods=methods, evidence=evidence())
                 for leg in (*calibration.legs, *calibration.legs))
    return replace(calibration, methods=methods, legs=legs)


class Balance(HTMLParser):
    """Parser that fails on unbalanced tags and collects text and ids."""

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
    """Return page, text and parser of a report; check the rules for all pages."""
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

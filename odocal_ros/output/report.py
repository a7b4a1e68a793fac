# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page report.html, which needs no network: figures and tables of a calibration, by jinja2."""

from collections import Counter
from html import escape
from importlib.resources import files
from typing import Any

from odocal_ros.calib import result
from odocal_ros.calib.choice import leg_estimates, REASON_ESTIMATES
from odocal_ros.output import report_tables as tables, value_text as texts
from odocal_ros.output.plot_style import apply_style, Drawing
from odocal_ros.output.summary import driven_text, MEANING, rotation_text, sentence
from odocal_ros.output.tables import before_label, check_table
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.safe_io.text_formats import date_text
from odocal_ros.settings.config import Config

NAME = 'report.html'
MAX_BYTES = 2_600_000     # judgement: size of all figures; with tables, a page has less than 3 MB


def report_html(calibration: result.Calibration, config: Config, content: dict[str, Any]) -> str:
    """
    Return the page of a calibration.

    calibration : the combination of all legs; missing parts (track, evidence) are left out.
    config : its settings.   content : of calibration.json, for bags and software.

    Raises ImportError: matplotlib or jinja2 is missing.
    """
    with_figures = _with_figures(calibration)
    # the track of the first leg is shown next to the verdict instead
    first_leg = (with_figures['legs'] or [{'figures': []}])[0]
    first_track, first_leg['figures'] = first_leg['figures'][:1], first_leg['figures'][1:]
    return render_page('output', NAME, first_track=first_track, **with_figures,
                       **_context(calibration, config, content))


def render_page(package: str, name: str, **content: Any) -> str:
    """Return the page of a template in ``templates`` of a package, with the style of reports."""
    from jinja2 import Environment, StrictUndefined
    home = files('odocal_ros')
    style = (home / 'output' / 'templates' / 'report.css').read_text(encoding='utf-8')
    template = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True,
                           lstrip_blocks=True).from_string(
        (home / package / 'templates' / name).read_text(encoding='utf-8'))
    return template.render(style=style, **content) + '\n'


def report_or_error_page(calibration: result.Calibration, config: Config,
                         content: dict[str, Any]) -> tuple[str, str]:
    """Return the report, or a page that states a drawing error, and the error: '' without one."""
    try:
        return report_html(calibration, config, content), ''
    except ImportError as error:
        cause = f'{error.name or error} cannot be imported; install matplotlib and jinja2'
    except Exception as error:     # noqa: BLE001 the numbers are written in any case
        cause = f'{type(error).__name__}: {error}; please report it'
    return ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>No report</title>'
            f'</head><body><p>The report could not be drawn: {escape(cause)}. All numbers are in '
            'calibration.json.</p></body></html>\n', cause)


def _context(calibration: result.Calibration, config: Config,
             content: dict[str, Any]) -> dict[str, Any]:
    """Return the variables of the template, except figures."""
    legs = calibration.legs
    methods = _by_number_of_values(calibration.methods, calibration.estimates)
    bags = list(dict.fromkeys(str(i['bag']) for i in content['inputs'] if i.get('bag')))
    return {
        'title': content['vehicle'] or ', '.join(bags) or 'live drive',
        'created': date_text(content['created']),
        'verdict': calibration.verdict.value, 'meaning': MEANING[calibration.verdict],
        'sentence': sentence(calibration).partition(': ')[2],
        'driven': driven_text(legs),
        'headline': tables.headline(calibration),
        'values': tables.value_rows(calibration), 'undetermined': tables.undetermined(calibration),
        'why': _main_reason(calibration.reasons), 'rotation': rotation_text(calibration),
        'reasons': texts.reason_groups(calibration.reasons), 'check': check_table(legs),
        'methods': tables.method_table(methods, legs), 'budgets': _budgets(methods, legs),
        'inputs': content['inputs'],
        'settings': tables.changed_settings(config),
        'versions': tables.versions(content['software']),
        'digits': tables.full_digits(content)}


def _main_reason(reasons: tuple[Reason, ...]) -> Reason | None:
    """Return the most severe reason against acceptance, or None; those on a value first."""
    for verdict, _, group in texts.reason_groups(reasons)[:1]:
        if verdict is not Verdict.ACCEPTED:
            return min(group, key=lambda reason: reason.code not in REASON_ESTIMATES)
    return None


def _by_number_of_values(methods: dict[str, result.MethodResult],
                         estimates: dict[str, result.Estimate]) -> dict[str, result.MethodResult]:
    """Return methods, first the one that gives most of the estimates."""
    count = Counter(estimate.method for estimate in estimates.values()
                    if estimate.value is not None)
    return dict(sorted(methods.items(), key=lambda item: -count[item[0]]))


def _budgets(methods: dict[str, result.MethodResult],
             legs: tuple[result.LegResult, ...]) -> list[tuple[str, dict[str, Any]]]:
    """Return (method, error budget) of the methods that have one."""
    local = result.has_local_fixes(legs)
    return [(tables.label(name), table) for name, method in methods.items()
            if (table := tables.budget_table(method, local))]


def _with_figures(calibration: result.Calibration) -> dict[str, Any]:
    """Return the variables with figures: legs, comparison of all, numbers without figures."""
    # if figures exceed MAX_BYTES, only those of the newest legs are shown
    from odocal_ros.output.plots import leg_figures
    from odocal_ros.output.scale_plots import comparison_figure
    numbered, size = list(enumerate(calibration.legs, 1)), 0
    figures: dict[int, list[Drawing]] = {}
    newest_first = sorted(numbered, key=lambda entry: entry[1].start_ns, reverse=True)
    with apply_style():
        comparison = comparison_figure(calibration, 'all')
        for number, leg in newest_first:
            if figures and size > MAX_BYTES:
                break
            if leg.evidence is None:
                continue
            scale = texts.finite_estimate(leg_estimates(leg), 'scale_factor')
            drawn = leg_figures(leg.evidence, f'leg{number}', scale.relative_sigma,
                                before_label([leg]), _smoother_details(leg))
            size += sum(len(figure.svg) for figure in drawn)
            if not figures or size <= MAX_BYTES:
                figures[number] = drawn
    legs = [_leg(number, leg, figures.get(number, []), several=len(numbered) > 1)
            for number, leg in numbered]
    # also of legs whose tracks were removed to save memory
    without_figures = [number for number, leg in numbered if number not in figures
                       and (leg.evidence is not None or leg.before is not None)]
    return {'legs': legs, 'comparison': comparison, 'without_figures': without_figures}


def _leg(number: int, leg: result.LegResult, figures: list[Drawing],
         several: bool) -> dict[str, Any]:
    """Return the section of a leg; several : the page has more legs."""
    rows, findings = tables.unused_data(leg)
    methods = _by_number_of_values(leg.methods, leg_estimates(leg))
    return {'number': number, 'bag': leg.bag, 'verdict': leg.verdict.value,
            'start': date_text(texts.iso(leg.start_ns)), 'stop': date_text(texts.iso(leg.stop_ns)),
            'figures': figures,
            'facts': (('distance', texts.length_text(leg.distance)),
                      ('duration', texts.duration_text(leg.duration)),
                      ('IMU samples', leg.imu_samples), ('odometer messages', leg.pulses),
                      ('fixes', leg.fixes), ('fixes not used', leg.rejected_fixes)),
            'methods': tables.method_table(methods, (leg,)),
            'budgets': _budgets(methods, (leg,)) if several else [],
            'check': check_table((leg,)),
            'reasons': texts.reason_groups(leg.reasons) if several else [],
            'unused_data': rows, 'findings': findings,
            'normalised': _smoother_details(leg).get('residuals', {}).get('normalised')}


def _smoother_details(leg: result.LegResult) -> dict[str, Any]:
    """Return the details of the smoother's result, empty without one."""
    method = leg.methods.get('smoother')
    return method.details if method else {}

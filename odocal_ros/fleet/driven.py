# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The legs that a vehicle has driven: by time, their values, and which are rejected."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.combine import DRAWN_ANEW
from odocal_ros.calib.result import Estimate, LegResult
from odocal_ros.fleet.bags import FleetBag
from odocal_ros.fleet.changes import covariance, History, history
from odocal_ros.fleet.rows import legs_from, Row
from odocal_ros.fleet.tables import utc
from odocal_ros.library.calibrate_bag import unique_names
from odocal_ros.nav.angles import wrap
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import DAY_NS


@dataclass(frozen=True, eq=False)
class Driven:
    """A leg with what its bag is known for."""

    leg: LegResult
    odometer_km: float | None

    @cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Return its values, each by the method that gives it."""
        return leg_estimates(self.leg)


def driven_legs(rows: Sequence[Row], known: dict[str, FleetBag]) -> list[Driven]:
    """Return the legs of rows by time, with unique bag names as in replay."""
    legs = [legs_from(row.legs) for row in rows]
    entries = [{'bag': next((leg.bag for leg in some), row.bag)}
               for row, some in zip(rows, legs, strict=True)]
    named, _ = unique_names([Path(row.bag) for row in rows], legs, entries)
    km = [known[row.bag].odometer_km if row.bag in known else row.odometer_km
          for row, some in zip(rows, legs, strict=True) for _ in some]
    return sorted((Driven(leg, k) for leg, k in zip(named, km, strict=True)),
                  key=lambda one: one.leg.start_ns)


def history_of(name: str, driven: Sequence[Driven],
               config: Config) -> tuple[list[int], History, History]:
    """Return the legs that determine a value, its history over days, and over kilometres."""
    found = []
    for k, one in enumerate(driven):
        e = one.estimates.get(name)
        if one.leg.verdict is not Verdict.REJECTED and e is not None and e.value is not None:
            found.append((k, e.value, one.leg.methods[e.method]))
    if not found:
        return [], History(), History()
    scale = name == 'scale_factor'
    number, values, methods = (list(column) for column in zip(*found, strict=True))
    value = np.array(values)
    y = np.log(value / value[0]) if scale else np.asarray(wrap(value - value[0]))
    own, shared = _errors(name, methods)
    days = np.array([driven[k].leg.driven_ns for k in number]) / DAY_NS
    days -= days[0]
    V = covariance(own, shared, days, config.verdict.scale_drift_per_day if scale else 0.0)
    km = [driven[k].odometer_km for k in number]
    by_distance = History() if not scale or None in km else history(y, V, np.array(km) / 1000)
    year = 365.25    # days
    return number, history(y, V, days / year), by_distance


def _errors(name: str, methods: Sequence[Any]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the variance of what is each leg's own, and the effects of what legs share."""
    own = np.zeros(len(methods))
    shared: dict[tuple[Any, ...], np.ndarray] = {}
    for k, method in enumerate(methods):
        i = method.parameters.index(name)
        for source in method.sources:
            if not source.shared or source.name in DRAWN_ANEW:
                own[k] += source.effects[i] @ source.effects[i]
                continue
            effects = shared.setdefault((method.name, source.name, source.effects.shape[1]),
                                        np.zeros((len(methods), source.effects.shape[1])))
            effects[k] = source.effects[i]
    return own, list(shared.values())


def rejecting(leg: LegResult) -> list[Reason]:
    """Return the explanation why a leg is rejected, empty if it is not."""
    return [r for r in (*leg.reasons, *(r for m in leg.methods.values() for r in m.reasons))
            if r.code.gravity is Verdict.REJECTED and leg.verdict is Verdict.REJECTED]


def rejected_from(driven: Sequence[Driven]) -> int:
    """Return from which leg on all are rejected, their number where the last one is not."""
    return 1 + max((k for k, one in enumerate(driven)
                    if one.leg.verdict is not Verdict.REJECTED), default=-1)


def gone(lost: Sequence[Driven]) -> Reason:
    """Return the reason why the current state of a vehicle is unknown."""
    last = rejecting(lost[-1].leg)[0]
    since = f'{utc(lost[0].leg.start_ns):%Y-%m-%d}'
    return replace(last, text=f'the last {len(lost)} legs, since {since}, are all rejected: '
                   f'{last.text}')

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg's result as text and back, to the last bit: what a table keeps until legs are combined."""

from dataclasses import fields, is_dataclass
import json
from typing import Any

import numpy as np

from odocal_ros.calib.border import Border
from odocal_ros.calib.result import (
    Estimate,
    LegResult,
    MethodResult,
    PerDistance,
    Source,
    TrackCheck,
)
from odocal_ros.reasons import Code, Reason

KINDS = {kind.__name__: kind for kind in (
    Border, Estimate, LegResult, MethodResult, PerDistance, Reason, Source, TrackCheck)}
IS = '~'      # the key that says what an object is


def leg_text(legs: list[LegResult]) -> str:
    """Return legs as JSON, without the rows that only a report draws."""
    return json.dumps([_plain(leg.numbers()) for leg in legs], separators=(',', ':'))


def legs_from(text: str) -> list[LegResult]:
    """Return the legs of ``leg_text``."""
    legs: list[LegResult] = json.loads(text, object_hook=_built)
    return legs


def _plain(x: Any) -> Any:
    if is_dataclass(x):
        return {IS: type(x).__name__, **{f.name: _plain(getattr(x, f.name)) for f in fields(x)}}
    if isinstance(x, Code):
        return {IS: 'Code', 'of': x.name}
    if isinstance(x, np.ndarray):
        return {IS: 'array', 'of': x.ravel().tolist(), 'shape': x.shape}
    if isinstance(x, np.generic):
        return x.item()
    if isinstance(x, tuple):
        return {IS: 'tuple', 'of': [_plain(y) for y in x]}
    if isinstance(x, dict):
        if all(isinstance(key, str) and key != IS for key in x):
            return {key: _plain(y) for key, y in x.items()}
        return {IS: 'dict', 'of': [[_plain(key), _plain(y)] for key, y in x.items()]}
    return [_plain(y) for y in x] if isinstance(x, list) else x


def _built(x: dict[str, Any]) -> Any:
    kind = x.get(IS)
    if kind is None:
        return x
    if kind == 'array':
        return np.array(x['of']).reshape(x['shape'])
    if kind == 'tuple':
        return tuple(x['of'])
    if kind == 'dict':
        return dict(x['of'])
    if kind == 'Code':
        return Code[x['of']]
    return KINDS[kind](**{name: y for name, y in x.items() if name != IS})

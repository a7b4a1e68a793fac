# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exceptions of a method as part of its result; the command or the node writes them to a file."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
import traceback

import numpy as np

from odocal_ros.calib.result import LegResult, MethodResult
from odocal_ros.reasons import Code, Reason

TRACE = 'trace'      # key of the details: for a developer


def raised_if_wild() -> np.errstate:
    """Return a context in which overflow raises FloatingPointError instead of a warning."""
    return np.errstate(over='raise', divide='raise', invalid='raise')


def failed(unknown: Callable[[Reason], MethodResult], name: str,
           error: Exception) -> MethodResult:
    """Return the result of a method that raised: no values, the reason, and the trace."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    said = ' '.join(str(error).split())[:200]
    reason = Reason(Code.METHOD_FAILED, f'method {name} failed with an internal error: '
                    f'{type(error).__name__}{f" ({said})" if said else ""} in {where.name}, line '
                    f'{where.lineno}')
    return replace(unknown(reason), details={TRACE: ''.join(traceback.format_exception(error))})


def traces(legs: Iterable[LegResult]) -> Iterator[tuple[str, str]]:
    """Yield (method, trace) of each method that raised."""
    for leg in legs:
        for name, method in leg.methods.items():
            if TRACE in method.details:
                yield name, method.details[TRACE]

"""The methods of a leg: their order, and what becomes of one that breaks."""

import numpy as np

from odocal_ros.calib.failed import failed
from odocal_ros.calib.smoother.outcome import refused as smoother_refused
from odocal_ros.calib.two_point import unsolved
from odocal_ros.calib.wheels.result import refused as wheels_refused
from odocal_ros.errors import OdocalError
from odocal_ros.pipeline.coarse_odometer import held_steps
from odocal_ros.pipeline.no_force import upright
from odocal_ros.pipeline.slow_slip import held
from odocal_ros.pipeline.smoother_run import smoother
from odocal_ros.pipeline.two_point_run import two_point
from odocal_ros.pipeline.wheels_run import wheels
from odocal_ros.reasons import Code, Reason

# in order of running; two_point, the operator's own marks, is always computed and shown
METHODS = {'two_point': two_point, 'wheels': wheels, 'smoother': smoother}
# what each gives where it refuses: (inputs, reason) to MethodResult
UNKNOWN = {'two_point': lambda inputs, why: unsolved((why,), inputs.scale_unit),
           'wheels': wheels_refused,
           'smoother': lambda inputs, why: smoother_refused((why,), inputs.scale_unit)}


def run_method(name, run):
    """
    Run a method on a leg; what breaks in it costs this method, not the leg.

    run : LegRun, prepared.   Returns MethodResult, and the antenna's path, None where refused.
    """
    found = len(run.reasons)
    try:
        # what runs away is told by the number that is none, not by warnings and what follows
        with np.errstate(over='raise', divide='raise', invalid='raise'):
            method, path = METHODS[name](run)
            return upright(held_steps(held(method, run), run), run), path
    except (OdocalError, MemoryError):
        raise
    except FloatingPointError as error:
        del run.reasons[found:]
        return UNKNOWN[name](run.inputs, Reason(
            Code.NOT_CONVERGED, f'{name} ran away from any number ({error}); samples are wild or '
            'missing')), None
    except Exception as error:
        del run.reasons[found:]       # what it said of the data may be as wrong
        return failed(lambda why: UNKNOWN[name](run.inputs, why), name, error), None

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a planned drive will give by each method that is predicted, and which gives the result."""

from dataclasses import dataclass

from odocal_ros.calib.choice import choose, deciding, worth_saying
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.forecast.planned_smoother import predict_smoother
from odocal_ros.forecast.predict import predict, Prediction, Sigmas
from odocal_ros.reasons import Reason, Verdict, verdict_of


@dataclass(frozen=True, eq=False)
class Plan:
    """
    What a drive will give.

    two_point : the operator's own marks, with alignment and drive.
    methods : by name, those predicted; what each says of the alignment is said with it.
    estimates : each parameter by the method that will give it, as a result has it.
    deciding : the methods of ``methods`` that may give.
    """

    two_point: Prediction
    methods: dict[str, MethodResult]
    estimates: dict[str, Estimate]
    deciding: tuple[str, ...]

    def sigma(self, parameter: str) -> float | None:
        """Return the sigma that will be stated, relative or rad; None: not determined."""
        return self.estimates[parameter].sigma

    def by(self, parameter: str) -> str:
        """Return the method that will give a parameter, empty: none."""
        estimate = self.estimates[parameter]
        return estimate.method if estimate.value is not None else ''

    @property
    def giving(self) -> tuple[str, ...]:
        """Return the methods that will give any parameter of interest."""
        names = (self.by(p) for p in self.two_point.method.parameters)
        return tuple(dict.fromkeys(name for name in names if name))

    @property
    def verdict(self) -> Verdict:
        """Return the predicted verdict: of the drive and the best method."""
        order = list(Verdict)
        best = min((self._verdict_of(name) for name in self.deciding), key=order.index)
        return Verdict.worst([verdict_of(self.two_point.of_drive), best])

    def reasons_of(self, name: str) -> tuple[Reason, ...]:
        """Return the predicted reasons of a method; for two_point also those of its alignment."""
        if name != 'two_point':
            return self.methods[name].reasons
        return tuple(r for r in self.two_point.reasons if r not in self.two_point.of_drive)

    def _verdict_of(self, name: str) -> Verdict:
        return verdict_of(self.reasons_of(name))

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """
        Return the reasons of the prediction.

        Of the drive; of methods that give; and why the others that might have been the result
        give nothing, the smoother's refusals always.
        """
        said = list(self.two_point.of_drive)
        for name in self.methods:
            own = worth_saying(self.reasons_of(name), name, self.estimates)
            if name == 'smoother':
                own = tuple(r for r in self.reasons_of(name) if r in own
                            or r.code.name.endswith('_NOT_DETERMINED'))
            elif name not in self.giving:
                own = tuple(r for r in own if r.code.gravity is Verdict.REJECTED)
            said += [r for r in own if r not in said]
        return tuple(said)


def plan_methods(drive: PlannedDrive, sigmas: Sigmas, spacing: float | None = None) -> Plan:
    """
    Return the predictions of the configured methods for a drive.

    drive, sigmas : as for ``predict``.   spacing : as for ``predict_smoother``.

    Raises
    ------
    BadUsage
        The drive is shorter than one fix interval.

    """
    asked = sigmas.config.method
    two_point = predict(drive, sigmas)
    methods = {'two_point': two_point.method}
    if 'smoother' in deciding(asked):
        methods = {'smoother': predict_smoother(drive, sigmas, spacing)} | methods
    may_give = deciding(asked)
    estimates, _ = choose({name: methods[name] for name in may_give}, may_give)
    return Plan(two_point, methods, estimates, may_give)

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
State of the calibration node: the open leg, earlier legs, and the combined result.

It needs neither ROS nor files. A ``SessionView`` is a snapshot of it, the input of all texts.
"""

from dataclasses import dataclass, field, replace
from enum import Enum
from math import nan
from typing import Any

from odocal_ros.calib.marginal_information import CarriedInformation
from odocal_ros.calib.result import Calibration, Estimate, LegResult
from odocal_ros.errors import OdocalError
from odocal_ros.forecast.forecast import Forecast
from odocal_ros.forecast.quantities import Observability
from odocal_ros.output.summary import values_in_words
from odocal_ros.output.value_text import counted
from odocal_ros.pipeline.floor_marks import FloorMark, next_point
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.safe_io.text_formats import one_line
from odocal_ros.settings.config import Config, LegConfig

# judgement, to bound memory: number of newest legs that keep their tracks, for plots; with
# leg.automatic older legs are released, of the operator's legs those beyond the second number
LEGS_WITH_TRACKS, MAX_OPERATOR_LEGS = 20, 50


class CommandRefused(OdocalError):
    """A service was called in the wrong state; the text names the action."""


class State(Enum):
    """State of the node; ``waiting``, which is idle with a missing input, is not a member."""

    IDLE = 'idle'
    RECORDING = 'recording'
    COMPUTING = 'computing'
    CALIBRATED = 'calibrated'
    REJECTED = 'rejected'
    FAILED = 'failed'


@dataclass(frozen=True, eq=False)
class KeptLeg:
    """A leg that the combined result contains; times on the sensors' clock."""

    leg_id: int
    start_ns: int
    stop_ns: int
    results: tuple[LegResult, ...]      # one, or one per part if gaps of the IMU cut the leg


@dataclass(frozen=True, eq=False)
class RestoredResult:
    """Result of an earlier run, from the parameters ``result.*``; they lack the scale's unit."""

    estimates: dict[str, Estimate]
    leg_count: int
    is_valid: bool      # False: the calibration was rejected
    stamp: str          # date and time of the calibration
    vehicle: str = ''

    def as_text(self, unit: str) -> str:
        """Return the result as a sentence; ``unit`` is that of the scale factors, or empty."""
        estimates = {name: replace(e, unit=unit) if unit and name.startswith('scale_factor') else e
                     for name, e in self.estimates.items()}
        verdict_text = '' if self.is_valid else ', which was rejected'
        vehicle_text = f' of vehicle {one_line(self.vehicle)}' if self.vehicle else ''
        return (f'restored result of {self.stamp}{vehicle_text}{verdict_text}: '
                f'{values_in_words(estimates)}; from {counted(self.leg_count, "leg")}')


class Session:
    """
    The legs since the start or the last reset, and their combined result ``calibration``.

    ``leg_id``, ``start_ns``, ``stop_ns`` (0: open) and ``event`` belong to the leg that changed
    last. Every status contains them, and replay finds the marks there. Times are sensor stamps.
    """

    def __init__(self) -> None:
        self.state = State.IDLE
        self.leg_id = 0
        self.start_ns = self.stop_ns = 0
        self.event = ''      # started, stopped, cancelled or undone
        self.config = Config()      # in force at the start of the leg
        self.legs: list[KeptLeg] = []
        self.calibration: Calibration | None = None
        # from the parameters at start-up, in force while no leg is kept
        self.restored_result: RestoredResult | None = None
        self.failure = ''              # cause if the computation of the open leg failed
        self.drop_cause = ''           # cause if the last leg was dropped automatically
        self.is_automatic = False      # leg.automatic started the last leg
        self.unused_reason: Reason | None = None      # if the last automatic leg is not used
        # information of legs that are no longer kept, and of those of earlier runs of the node
        self.carried: CarriedInformation | None = None
        self.marks: list[FloorMark] = []       # on reference.points, since the last leg's pre-roll
        self._last_id = 0

    @property
    def is_busy(self) -> bool:
        """Return True while a leg runs or is computed: settings cannot change then."""
        return self.state in (State.RECORDING, State.COMPUTING)

    @property
    def has_open_leg(self) -> bool:
        """Return True if there is a leg that is neither kept nor dropped."""
        is_stopped = self.state in (State.COMPUTING, State.FAILED) and self.event == 'stopped'
        return self.state is State.RECORDING or is_stopped

    def start(self, mark_ns: int, config: Config, is_automatic: bool = False) -> None:
        """Open a leg at a mark, under the configuration in force."""
        if self.state is State.COMPUTING:
            raise CommandRefused(f'leg {self.leg_id} is being computed: call again when its '
                                 'result is on ~/status, or drop it with ~/cancel_leg')
        if self.has_open_leg:
            raise CommandRefused(f'leg {self.leg_id} failed and is kept: call ~/stop_leg to '
                                 'compute it again, or drop it with ~/cancel_leg')
        self._last_id += 1
        self.leg_id, self.start_ns, self.stop_ns = self._last_id, mark_ns, 0
        self.config, self.is_automatic = config, is_automatic
        self.state, self.event, self.failure, self.drop_cause = State.RECORDING, 'started', '', ''
        first_ns = mark_ns - round(config.leg.preroll * 1e9)
        self.marks = [mark for mark in self.marks if mark.stamp_ns >= first_ns]

    def marks_of_leg(self) -> list[FloorMark]:
        return [mark for mark in self.marks if mark.stamp_ns >= self.start_ns]

    def mark(self, stamp_ns: int, received_ns: int) -> FloorMark:
        """Record that the robot stands on the next of ``reference.points``."""
        if self.state is not State.RECORDING:
            raise CommandRefused('no leg is running: call ~/start_leg first, then ~/mark on each '
                                 'point')
        point = next_point(self.config, len(self.marks_of_leg()))
        self.marks.append(FloorMark(stamp_ns, point, received_ns))
        return self.marks[-1]

    def stop(self, mark_ns: int) -> None:
        """End the open leg at a mark; it is computed next."""
        if self.state is not State.RECORDING:
            raise CommandRefused('no leg is running: call ~/start_leg first')
        self.stop_ns = mark_ns
        self.state, self.event = State.COMPUTING, 'stopped'

    def retry(self, config: Config) -> None:
        """Compute a failed leg again, under the configuration now in force."""
        self.config, self.state, self.failure = config, State.COMPUTING, ''

    def finish(self, results: tuple[LegResult, ...], calibration: Calibration) -> None:
        """Keep the computed leg; ``calibration`` combines all kept legs."""
        self.legs.append(KeptLeg(self.leg_id, self.start_ns, self.stop_ns, results))
        if len(self.legs) > LEGS_WITH_TRACKS:
            k = -LEGS_WITH_TRACKS - 1      # the newest leg that loses its tracks
            self.legs[k] = replace(self.legs[k], results=tuple(
                result.without_plot_data() for result in self.legs[k].results))
        self.unused_reason = None
        self.set_result(calibration)

    def drop_unusable(self, reason: Reason) -> None:
        """Drop the computed automatic leg, which is not usable."""
        self.event, self.unused_reason = 'cancelled', reason
        self.set_result(self.calibration)

    def set_carried(self, carried: CarriedInformation | None, released_count: int) -> None:
        """Release some of the oldest kept legs; ``carried`` has their information."""
        self.carried, self.legs = carried, self.legs[released_count:]

    def fail(self, failure: str) -> None:
        """Record that the computation failed; the leg stays open."""
        self.state, self.failure = State.FAILED, failure

    def cancel(self, drop_cause: str = '') -> None:
        """Drop the open leg; ``drop_cause``: if it is dropped automatically."""
        if not self.has_open_leg:
            raise CommandRefused('no leg is running: nothing to cancel; ~/undo_leg drops the last '
                                 'kept leg')
        self.event, self.drop_cause = 'cancelled', drop_cause
        self.set_result(self.calibration)

    def begin_undo(self) -> list[KeptLeg]:
        """Drop the last kept leg and return those left, which must be combined again."""
        if self.has_open_leg:
            raise self._open_leg_refusal('~/undo_leg')
        if not self.legs:
            raise CommandRefused('no leg to undo')
        self.mark_undone(self.legs.pop())
        self.state = State.COMPUTING if self.legs else State.IDLE
        self.calibration, self.drop_cause = None, ''
        return self.legs

    def begin_reset(self) -> list[KeptLeg]:
        """Drop everything and return the legs that were kept."""
        if self.is_busy:
            raise self._open_leg_refusal('~/reset')
        dropped, self.legs = self.legs, []
        self.calibration, self.state, self.failure = None, State.IDLE, ''
        self.restored_result, self.drop_cause = None, ''
        self.carried = self.unused_reason = None
        return dropped

    def _open_leg_refusal(self, command: str) -> CommandRefused:
        return CommandRefused(f'leg {self.leg_id} is open: end it with ~/stop_leg or ~/cancel_leg '
                              f'before {command}')

    def mark_undone(self, leg: KeptLeg) -> None:
        """Make a dropped leg the last one that changed, so that the next status contains it."""
        self.leg_id, self.start_ns, self.stop_ns = leg.leg_id, leg.start_ns, leg.stop_ns
        self.event = 'undone'

    def restored_stamp(self) -> str:
        """Return the stamp of the restored result while it is in force, else empty."""
        is_replaced = self.calibration is not None or bool(self.legs)
        return '' if self.restored_result is None or is_replaced else self.restored_result.stamp

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Return the reasons of the combined result."""
        return self.calibration.reasons if self.calibration else ()

    def verdict(self) -> str:
        """Return the verdict in force, empty before the first."""
        return self.calibration.verdict.value if self.calibration else ''

    def set_result(self, calibration: Calibration | None) -> None:
        """Set the combined result of the kept legs, None without one; no leg is open then."""
        self.calibration, self.failure, self.state = calibration, '', State.IDLE
        if calibration is not None:
            is_rejected = calibration.verdict is Verdict.REJECTED
            self.state = State.REJECTED if is_rejected else State.CALIBRATED


@dataclass(frozen=True, eq=False)
class SessionView:
    """Snapshot of the node; in a leg, config is the one in force at its start."""

    session: Session
    config: Config
    missing_inputs: list[str] = field(default_factory=list)         # texts, one for each input
    duplicate_publishers: list[str] = field(default_factory=list)   # texts, one for each topic
    lost_messages: dict[str, int] = field(default_factory=dict)     # by topic, since the leg began
    # slot, and s that its clock is ahead of the IMU's
    clock_differences: list[tuple[str, float]] = field(default_factory=list)
    rates_hz: dict[str, float] = field(default_factory=dict)        # by slot of the input
    results: dict[str, Any] = field(default_factory=dict)           # result.* parameters
    restored_stamp: str = ''                    # date of the restored result, if in force
    distance_m: float = 0.0                     # path length of the leg so far
    duration_s: float = 0.0                     # of the leg
    max_speed: float = 0.0                      # m/s, in the leg
    still_s: float = 0.0                        # duration of the present standstill
    two_wheels: bool = False                    # True if left and right wheel are known
    observability: Observability | None = None  # of the recorded leg
    forecast: Forecast | None = None            # of the recorded or computed leg
    faults: tuple[Reason, ...] = ()             # of the recorded leg, most severe first
    forecast_age_s: float = nan                 # since its newest sample
    stage: Stage = Stage()                      # progress of the computation
    saved_folder: str = ''                      # of the newest saved result
    dropped_leg: str = ''                       # text on a leg that was dropped automatically
    save_error: str = ''                        # cause if the newest result is not saved
    journal_folder: str = ''                    # of the newest leg
    journal_error: str = ''                     # cause if it cannot be written
    has_received: bool = True                   # True after the first message of any topic
    is_local: bool = False                      # True if positions are in a local frame
    has_imu: bool = True                        # True if the IMU is needed or published

    @property
    def state(self) -> str:
        """Return the state as published: idle with an input missing is ``waiting``."""
        if self.session.state is State.IDLE and self.missing_inputs:
            return 'waiting'
        return self.session.state.value

    @property
    def leg(self) -> LegConfig:
        """Return the settings of the leg; its defaults are smaller in a local frame."""
        config = self.session.config
        return (config.in_local_frame() if self.is_local else config).leg

    @property
    def is_rejected_so_far(self) -> bool:
        """Return True if the current leg would be rejected now."""
        return any(r.code.severity is Verdict.REJECTED for r in self.faults)

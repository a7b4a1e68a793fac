# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is so just now: everything that status, hint and answers are made from."""

from dataclasses import dataclass, field
from math import nan
from typing import Any

from odocal_ros.forecast.ability import Ability
from odocal_ros.forecast.forecast import Forecast
from odocal_ros.live.session import Session, State
from odocal_ros.pipeline.prepared import Stage
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.settings.config import Config, LegConfig


@dataclass(frozen=True, eq=False)
class SessionView:
    """One moment of the node; in a leg the config is the one frozen into it."""

    session: Session
    config: Config
    missing: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)     # topics with several publishers
    lost_messages: dict[str, int] = field(default_factory=dict)      # topic -> since the leg began
    clocks: list[tuple[str, float]] = field(default_factory=list)
    rates_hz: dict[str, float] = field(default_factory=dict)
    results: dict[str, Any] = field(default_factory=dict)  # result.* parameters
    restored: str = ''                           # when they were made, of a saved result
    distance_m: float = 0.0
    duration_s: float = 0.0
    max_speed: float = 0.0
    still_s: float = 0.0
    two_wheels: bool = False                     # the right wheel has its own topic
    ability: Ability | None = None               # of the leg that is recorded
    forecast: Forecast | None = None               # of the leg that is recorded or computed
    faults: tuple[Reason, ...] = ()              # of the leg that is recorded, gravest first
    forecast_age_s: float = nan                   # since its newest sample
    computed: Stage = Stage()                    # how far the result of a leg is
    saved: str = ''
    lost: str = ''                               # a leg that nobody wanted dropped
    save_trouble: str = ''                       # why the newest result is in no folder
    journal: str = ''                            # folder of the newest leg's journal
    journal_trouble: str = ''                    # why it cannot be written
    received: bool = True                           # any message on any topic so far
    local: bool = False                          # positions are in a local frame
    imu: bool = True                             # the robot has one

    @property
    def state(self) -> str:
        """Return the state as published: idle with an input missing is ``waiting``."""
        if self.session.state is State.IDLE and self.missing:
            return 'waiting'
        return self.session.state.value

    @property
    def leg(self) -> LegConfig:
        """Return the limits of the leg."""
        config = self.session.config
        return (config.in_local_frame() if self.local else config).leg

    @property
    def lost_cause(self) -> bool:
        """Return True if the current leg would be rejected now."""
        return any(r.code.gravity is Verdict.REJECTED for r in self.faults)

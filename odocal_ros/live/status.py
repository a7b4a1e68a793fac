"""What ``~/status`` and ``/diagnostics`` say: keys for machines, a sentence for people."""

from dataclasses import dataclass, field
import math

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from odocal_ros.config import Config
from odocal_ros.live.health import Health
from odocal_ros.live.outlook import as_keys, Outlook
from odocal_ros.live.session import Session, State
from odocal_ros.reasons import Code, Verdict

NAME = 'calibrator: calibration'  # replay finds marks by this name
REST_S = 10.0                     # standstill that levels well and tells the gyro bias


@dataclass(frozen=True, eq=False)
class Situation:
    """Everything a status is made from."""

    session: Session
    config: Config
    missing: list[str] = field(default_factory=list)
    clocks: list[tuple[str, float]] = field(default_factory=list)
    rates_hz: dict[str, float] = field(default_factory=dict)
    results: dict = field(default_factory=dict)  # result.* parameters
    distance_m: float = 0.0
    duration_s: float = 0.0
    max_speed: float = 0.0
    still_s: float = 0.0
    outlook: Outlook | None = None               # of the leg that is recorded
    saved: str = ''
    journal: str = ''                            # folder of the newest leg's journal
    journal_trouble: str = ''                    # why it cannot be written
    heard: bool = True                           # any message on any topic so far


def calibration_status(now: Situation) -> DiagnosticStatus:
    """Return the one status of ``~/status``."""
    session, results = now.session, now.results
    text = hint(now)
    keys = {
        'state': state_name(now), 'leg_id': session.leg_id, 'leg_start_ns': session.start_ns,
        'leg_stop_ns': session.stop_ns, 'leg_event': session.event,
        'distance_m': now.distance_m, 'duration_s': now.duration_s,
        'imu_rate_hz': now.rates_hz.get('imu', 0.0),
        'odometer_rate_hz': now.rates_hz.get('odometer', 0.0),
        'fix_rate_hz': now.rates_hz.get('fix', 0.0),
        'scale_factor': results['result.scale_factor'],
        'scale_factor_sigma': results['result.scale_factor_sigma'],
        'yaw_mounting_angle_rad': results['result.yaw_mounting_angle'],
        'yaw_mounting_angle_sigma_rad': results['result.yaw_mounting_angle_sigma'],
        'pitch_mounting_angle_rad': results['result.pitch_mounting_angle'],
        'pitch_mounting_angle_sigma_rad': results['result.pitch_mounting_angle_sigma'],
        'verdict': session.verdict(), 'hint': text, 'legs': len(session.legs),
        'leg_ids': ','.join(str(leg.leg_id) for leg in session.legs),
        'standstill_s': now.still_s, 'max_speed_mps': now.max_speed,
        'missing': '; '.join(now.missing), 'reasons': _reason_codes(now), 'saved': now.saved,
        'journal': now.journal, 'journal_trouble': now.journal_trouble,
    } | as_keys(now.outlook)
    return DiagnosticStatus(
        level=level(now), name=NAME, message=sentence(now, text), hardware_id='odocal',
        values=[KeyValue(key=k, value=_bare(v)) for k, v in keys.items()])


def state_name(now: Situation) -> str:
    """Return the state as published: idle with an input missing is ``waiting``."""
    if now.session.state is State.IDLE and now.missing:
        return 'waiting'
    return now.session.state.value


def level(now: Situation) -> bytes:
    """Return STALE before anything came, ERROR for what needs the operator, WARN for doubts."""
    state = now.session.state
    if state in (State.FAILED, State.REJECTED):
        return DiagnosticStatus.ERROR
    if state is State.IDLE and not now.heard:
        return DiagnosticStatus.STALE
    doubtful = state is State.CALIBRATED and now.session.verdict() != Verdict.ACCEPTED.value
    doubtful = doubtful or bool(now.missing or now.clocks or now.journal_trouble)
    return DiagnosticStatus.WARN if doubtful else DiagnosticStatus.OK


def sentence(now: Situation, text: str) -> str:
    """Return one sentence: what is, and what to do next."""
    session = now.session
    seen = {
        'waiting': 'Waiting',
        'idle': 'Ready',
        'recording': f'Recording leg {session.leg_id}: {now.distance_m:.0f} m in '
                     f'{now.duration_s:.0f} s',
        'computing': f'Computing leg {session.leg_id}',
        'calibrated': f'Calibrated from {len(session.legs)} leg{"s" * (len(session.legs) != 1)}, '
                      f'{session.verdict()}',
        'rejected': 'Rejected',
        'failed': f'Failed: {session.trouble}',
    }[state_name(now)]
    trouble = now.journal_trouble
    journal = f'the journal cannot be written: {trouble}' if trouble else ''
    return '; '.join(filter(None, (seen, text, journal)))


def hint(now: Situation) -> str:
    """Return what is missing, in metres, seconds or manoeuvres, or what to do next."""
    session, state = now.session, now.session.state
    if state is State.COMPUTING:
        return 'the answer of ~/stop_leg comes in a moment'
    if state is State.FAILED:
        return ('call ~/stop_leg to compute the leg again, or ~/cancel_leg to drop it'
                if session.open_leg else 'call ~/reset')
    if now.missing:
        return now.missing[0]
    if now.clocks:
        return clocks_differ(now.clocks)
    if state is State.RECORDING:
        return _recording_hint(now)
    if state is State.IDLE:
        return _start_hint(now.still_s)
    reason = _gravest(session.calibration)
    lacking = now.config.verdict.min_legs - len(session.legs)
    if lacking > 0:
        return f'drive {lacking} more leg{"s" * (lacking > 1)}'
    return reason.remedy if reason else 'call ~/save, or drive another leg for a smaller sigma'


def clocks_differ(clocks: list[tuple[str, float]]) -> str:
    """Return the sentence about clocks that differ from the Imu's."""
    seen = ', '.join(f'{slot} stamps are {abs(s):.3g} s {"ahead of" if s > 0 else "behind"} the '
                     "Imu's" for slot, s in clocks)
    return f'CLOCKS_DIFFER: {seen}. {Code.CLOCKS_DIFFER.remedy}'


def _start_hint(still_s: float) -> str:
    if still_s < REST_S:
        return (f'stand still {REST_S:.0f} s before ~/start_leg ({still_s:.0f} s so far)')
    return 'call ~/start_leg'


def _recording_hint(now: Situation) -> str:
    leg, wants = now.session.config.leg, []
    if now.distance_m < leg.min_distance:
        wants.append(f'{leg.min_distance - now.distance_m:.0f} m more')
    if now.max_speed < leg.min_speed:
        wants.append(f'drive faster than {leg.min_speed:g} m/s')
    if wants:
        return ', '.join(wants)
    end = 'call ~/stop_leg' if now.still_s >= leg.standstill \
        else 'stand still at the end point, then call ~/stop_leg'
    if now.outlook is None:
        return end
    return now.outlook.words() + (f'; {end}' if now.outlook.complete else '')


def _gravest(calibration):
    order = list(Verdict)
    reasons = sorted(calibration.reasons if calibration else (),
                     key=lambda r: -order.index(r.code.gravity))
    return reasons[0] if reasons and reasons[0].code.gravity is not Verdict.ACCEPTED else None


def _reason_codes(now: Situation) -> str:
    calibration = now.session.calibration
    return ','.join(r.code.name for r in calibration.reasons) if calibration else ''


def _bare(value) -> str:
    """Return a value as PlotJuggler reads it: numbers without unit, every digit."""
    return repr(float(value)) if isinstance(value, float) else str(value)


def input_status(name: str, health: Health, why: str, now_ns: int) -> DiagnosticStatus:
    """Return the health of one input for ``/diagnostics``."""
    rate, silent = health.rate_hz(now_ns), health.silent_s(now_ns)
    if why:
        status = DiagnosticStatus.ERROR if health.heard_ns else DiagnosticStatus.STALE
        message = why
    elif health.fix_status is not None and health.fix_status < 0:
        status, message = DiagnosticStatus.WARN, f'no position yet, status {health.fix_status}'
    elif health.unusable:
        status = DiagnosticStatus.WARN
        message = f'{rate:.1f} Hz, {health.unusable} messages unreadable'
    else:
        status, message = DiagnosticStatus.OK, f'{rate:.1f} Hz'
    values = {'rate_hz': rate, 'age_s': silent if math.isfinite(silent) else -1.0,
              'messages': health.count, 'gaps': health.gaps, 'dropped': health.lost,
              'unreadable': health.unusable, 'stamp_delay_s': health.delay_s}
    if health.fix_status is not None:
        values['fix_status'] = health.fix_status
    return DiagnosticStatus(
        level=status, name=name, message=message, hardware_id='odocal',
        values=[KeyValue(key=k, value=_bare(v)) for k, v in values.items()])

# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of the output: files, journal, topics and frames."""

from dataclasses import dataclass

from odocal_ros.settings.setting import setting

FORMATS = ('params', 'autoware', 'transform', 'ros2_control', 'devices', 'covariance', 'imu',
           'track', 'legs', 'report')


@dataclass(frozen=True, kw_only=True)
class OutputConfig:
    directory: str = setting('', about='Folder of the results; empty: odocal/ and the full node '
                             'name in $ROS_HOME (~/.ros/odocal/calibrator).')
    autosave: bool = setting(True, about='Write the result files after every leg that is not '
                             'rejected.')
    automatic_kept: int = setting(100, '', 0, 10**6, about='Number of result folders kept with '
                                  'leg.automatic; the oldest are deleted first, but never the '
                                  'one that latest points to and the newest good one. 0: all.')
    formats: tuple[str, ...] = setting(FORMATS, choices=FORMATS, item=str, about=(
        'Files written in addition to calibration.json.'))


@dataclass(frozen=True, kw_only=True)
class JournalConfig:
    max_bytes: int = setting(10 * 2**30, 'bytes', 0, 2**62, about='Disk space for the journals '
                             'of legs (journal/ in output.directory); the oldest are deleted '
                             'first. 0: no journal.')


@dataclass(frozen=True, kw_only=True)
class PublishConfig:
    rate: float = setting(2.0, 'Hz', 0.1, 20.0, ro=True, about='Rate of the status message.')


@dataclass(frozen=True, kw_only=True)
class FramesConfig:
    base: str = setting('base_link', ro=True, frame=True,
                        about='Vehicle frame in the result files.')
    imu: str = setting('', ro=True, frame=True,
                       about='IMU frame; empty: frame of the IMU messages.')
    local: str = setting('odocal_enu', ro=True, frame=True,
                         about='Frame of the published paths.')


@dataclass(frozen=True, kw_only=True)
class UpdaterConfig:
    period: float = setting(1.0, 's', 0.1, 60.0, ro=True, about='Period of /diagnostics.')
    use_fqn: bool = setting(False, ro=True, about='Use the full node name in /diagnostics.')

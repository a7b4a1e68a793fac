# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The IMU's frame in the files for TF: as set, else as its messages say, where ROS takes that."""

from dataclasses import replace

from odocal_ros.calib.result import Calibration
from odocal_ros.outside.names import is_frame, one_line
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings

IMU_FRAME = 'imu_link'      # REP-145, where nobody names one


def framed(calibration: Calibration, config: Config, frame: str) -> tuple[Calibration, Config]:
    """
    Return both with the IMU's frame in force.

    frame : of the IMU's headers, as somebody sent it; a note says if it is not used.
    """
    if config.frames.imu or not frame:
        return calibration, config
    taken = frame.lstrip('/')       # as ROS 1 wrote it
    taken = taken if is_frame(taken) else IMU_FRAME
    if taken != frame:
        note = Reason(Code.FRAME_REPLACED, 'the frame of the IMU messages, '
                      f"'{one_line(frame[:60])}', is not valid in TF; {taken} is written")
        calibration = replace(calibration, reasons=(*calibration.reasons, note))
    return calibration, with_settings(config, {'frames.imu': taken})

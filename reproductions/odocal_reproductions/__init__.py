# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Published results that odocal_ros reproduces: the commands ``odocal paper`` and ``odocal patent``.

paper : tables 1 to 4 and figure 1 of Shi et al. 2015.   patent : the embodiment of CN104359492A.
"""

__version__ = '1.0.0'

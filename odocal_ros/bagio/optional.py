# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The package rosbags is optional: bags of standard message types are read without it."""

from collections.abc import Iterator
from contextlib import contextmanager

from odocal_ros.errors import BadUsage


@contextmanager
def rosbags_for(what: str) -> Iterator[None]:
    """Raise BadUsage if an import of rosbags fails; ``what`` names the feature that needs it."""
    try:
        yield
    except ModuleNotFoundError:
        raise BadUsage(f'{what} needs the Python package rosbags, which is not installed: '
                       'pip install rosbags') from None

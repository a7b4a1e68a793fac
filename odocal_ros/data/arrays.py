# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Names of array types; shapes and units are documented at each array."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Values = NDArray[np.int64] | NDArray[np.float64]     # raw values of an odometer
FloatOrFloats = TypeVar('FloatOrFloats', float, Floats)

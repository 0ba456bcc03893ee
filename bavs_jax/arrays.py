"""Types of arrays, and of functions of space."""

from collections.abc import Callable, Sequence

import jax
import numpy as np

Array = jax.Array | np.ndarray  # on the device or on the host, where either will do
Indices = Sequence[int] | np.ndarray  # a few whole numbers on the host
# Density [K], 1 / scene unit, at positions [K, 3], scene units; 0 where nothing is.
DensityFn = Callable[[Array], Array]

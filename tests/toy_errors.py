"""Errors and uncertainties of made-up views."""

from __future__ import annotations

import numpy as np

from bavs_jax.uncertainty.conformal_scale import ViewErrors


def alike_views(num_views, errors, uncertainty=None):
    """The same pixels in each view, of uncertainty 1 unless given."""
    errors = np.asarray(errors, float)
    return [ViewErrors(errors, np.ones(len(errors)) if uncertainty is None else uncertainty)] * (
        num_views
    )


def differing_views(rng, num_views, *, spread=1.0, num_pixels=30):
    """Views as loud as a factor of their own says, with errors that grow with the uncertainty.

    Views are i.i.d., so exchangeable; the pixels of one view share its loudness, so they are not.
    """
    views = []
    for loudness in np.exp(spread * rng.normal(size=num_views)):
        uncertainty = np.exp(rng.normal(size=num_pixels))
        errors = loudness * np.sqrt(uncertainty) * np.abs(rng.normal(size=num_pixels))
        views.append(ViewErrors(errors, uncertainty))
    return views

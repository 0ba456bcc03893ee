"""bavs_jax: batch active view selection for neural radiance fields by scene uncertainty."""

__version__ = "0.1.0"

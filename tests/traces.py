"""Counts what JAX traces, through its public monitoring events."""

import contextlib

import jax


@contextlib.contextmanager
def count_traces():
    """Yields a list that grows by one entry for each function that JAX traces."""
    events = []

    def listen(event, duration, **kwargs):
        if event.endswith("jaxpr_trace_duration"):
            events.append(kwargs.get("fun_name", event))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)

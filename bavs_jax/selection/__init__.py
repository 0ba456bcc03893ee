"""Which views to take next: distances (Fig 5), the table of policies, the batch selector (Eq 15).

`acquire` (`batch.py`) is the way in; `context.py` says what a policy may look at, and a new policy
is one new file in `policies/`.
"""


class SelectionError(ValueError):
    """A selection that cannot be made: one line that names the cause and the fix."""

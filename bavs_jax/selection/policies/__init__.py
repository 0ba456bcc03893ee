"""The table of policies: all that the `POLICIES` of the modules here hold.

To add a policy, write a file here with `POLICIES = (Policy(name=..., ...),)`. The command line, the
sweep, the report and the battery of tests then know it.
"""

import difflib

from bavs_jax.registry import collect
from bavs_jax.selection import SelectionError
from bavs_jax.selection.policy import Policy


def collect_policies() -> dict[str, Policy]:
    """Imports every module of this package; raises SelectionError at one without `POLICIES`."""
    try:
        return collect(__name__, __path__, "POLICIES", Policy)
    except ValueError as error:
        raise SelectionError(str(error)) from error


POLICIES: dict[str, Policy] = collect_policies()


def get_policy(name: str) -> Policy:
    """The policy of that name; raises SelectionError with the known names if there is none."""
    if name in POLICIES:
        return POLICIES[name]
    close = difflib.get_close_matches(name, POLICIES, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    raise SelectionError(f"policy: unknown name {name!r}; {hint}known: {', '.join(POLICIES)}")

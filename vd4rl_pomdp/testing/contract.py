"""What the contracts of all kinds share: how a check is run, and in which words a broken promise is told."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError

Check = Callable[..., None]
"""Called with a part's name and its options; the first line of its docstring is the promise that it checks."""


def run_check(kind: str, check: Check, name: str, **options: Any) -> None:
    """Check one promise of a part; the global generators of torch and numpy are left where they were.

    Args:
        kind: what the part is called, `method`.
        check: raises AssertionError, or anything that the part's own code raises.
        name: of the part.
        options: its options.

    Raises:
        AssertionError: the promise is broken; says which one, by what and of which part.
        UserError: there is no such part or option.
    """
    try:
        with _generators_kept():
            check(name, **options)
    except UserError:
        raise
    except Exception as error:  # other people's code may raise anything
        reason = str(error) if isinstance(error, AssertionError) else f"{type(error).__name__}: {error}"
        raise AssertionError(f"{kind} {name!r} breaks a promise.\n{promise(check)}\nBut: {reason}") from error


@contextmanager
def _generators_kept() -> Iterator[None]:
    """Leave the global generators of torch and numpy, which checks seed, where the caller had them."""
    drawn = np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng(devices=[]):
        try:
            yield
        finally:
            np.random.set_state(drawn)  # noqa: NPY002


def run_checks(kind: str, checks: Iterable[Check], name: str, **options: Any) -> None:
    """`run_check` for one check after the other."""
    for check in checks:
        run_check(kind, check, name, **options)


def promise(check: Check) -> str:
    """What a check is about, as one sentence."""
    return (check.__doc__ or "").partition("\n")[0]


def claim(holds: Any, otherwise: str) -> None:
    """Raise AssertionError, saying what is the case, unless something holds."""
    if not holds:
        raise AssertionError(otherwise)


def claim_close(found: Tensor, expected: Tensor, otherwise: str, tolerance: float | None = None) -> None:
    """Raise AssertionError, saying what is the case and by how much, unless two tensors agree.

    They do to a relative and absolute `tolerance`, by default to the precision of their dtype.
    """
    torch.testing.assert_close(
        found, expected, rtol=tolerance, atol=tolerance, msg=lambda difference: f"{otherwise}: {difference}"
    )


def shown(names: Iterable[str]) -> str:
    """Names as they stand in a message, in order."""
    return ", ".join(sorted(names)) or "none"

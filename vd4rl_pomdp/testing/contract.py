"""Helpers shared by all conformance checks: run checks and report broken promises."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError

Check = Callable[..., None]
"""Called with a part's name and options; the first line of its docstring is the promise printed if it fails."""


def run_check(kind: str, check: Check, name: str, **options: Any) -> None:
    """Run one check on a part; the global random states of torch and numpy are restored afterwards.

    Args:
        kind: kind of part, such as "method".
        check: raises AssertionError, or any exception of the part's own code.
        name: name of the part.
        options: its options.

    Raises:
        AssertionError: the promise is broken; the message names the part, the promise and the reason.
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
    """Restore the global random states of torch and numpy, which checks seed."""
    drawn = np.random.get_state()  # noqa: NPY002
    with torch.random.fork_rng(devices=[]):
        try:
            yield
        finally:
            np.random.set_state(drawn)  # noqa: NPY002


def run_checks(kind: str, checks: Iterable[Check], name: str, **options: Any) -> None:
    """Run several checks with `run_check`."""
    for check in checks:
        run_check(kind, check, name, **options)


def promise(check: Check) -> str:
    """The promise that a check tests: the first line of its docstring."""
    return (check.__doc__ or "").partition("\n")[0]


def claim(holds: Any, otherwise: str) -> None:
    """Raise AssertionError with the message `otherwise` unless `holds`."""
    if not holds:
        raise AssertionError(otherwise)


def claim_close(found: Tensor, expected: Tensor, otherwise: str, tolerance: float | None = None) -> None:
    """Raise AssertionError with the message `otherwise` and the difference unless two tensors are close.

    `tolerance` is relative and absolute; default: torch.testing's for the dtype.
    """
    torch.testing.assert_close(
        found, expected, rtol=tolerance, atol=tolerance, msg=lambda difference: f"{otherwise}: {difference}"
    )


def shown(names: Iterable[str]) -> str:
    """Sorted names, joined for a message; "none" if there are none."""
    return ", ".join(sorted(names)) or "none"

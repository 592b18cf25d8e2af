"""Helpers shared by all conformance checks: run checks and report violated contracts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard
from vd4rl_pomdp.nn.encoder_folder import load_encoder, save_encoder

Check = Callable[..., None]
"""Called with a part's name and options; the first paragraph of its docstring is the promise printed if it fails."""


def run_check(kind: str, check: Check, name: str, **options: Any) -> None:
    """Run one check on a part of a kind such as "method"; torch's and numpy's global random states are restored.

    Raises:
        AssertionError: the promise is broken; the message names the part, the promise and the reason.
        UserError: there is no such part or option.
    """
    drawn = np.random.get_state()  # noqa: NPY002
    try:
        with torch.random.fork_rng(devices=[]):
            check(name, **options)
    except UserError:
        raise
    except Exception as error:  # other people's code may raise anything
        reason = str(error) if isinstance(error, AssertionError) else f"{type(error).__name__}: {error}"
        promise = " ".join((check.__doc__ or "").partition("\n\n")[0].split())
        raise AssertionError(f"{kind} {name!r} violates its contract.\nRequired: {promise}\nFound: {reason}") from error
    finally:
        np.random.set_state(drawn)  # noqa: NPY002


def run_checks(kind: str, checks: Iterable[Check], name: str, **options: Any) -> None:
    """Run several checks with `run_check`."""
    for check in checks:
        run_check(kind, check, name, **options)


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


def claim_equal(found: Mapping[str, Tensor], expected: Mapping[str, Tensor], otherwise: str) -> None:
    """Raise AssertionError with the message `otherwise` and the names of the tensors that differ, if any do."""
    differing = [key for key, value in found.items() if not torch.equal(value, expected[key])]
    claim(differing == [], f"{otherwise}: {listed(differing)}")


def claim_gradients(parameters: Iterable[tuple[str, Tensor]]) -> None:
    """Raise AssertionError unless every named parameter has a nonzero gradient."""
    without = [name for name, value in parameters if value.grad is None or not value.grad.any()]
    claim(without == [], f"none reaches {listed(without)}")


def weighted_sum(values: Tensor) -> Tensor:
    """Sum with random weights of the last dimension, since a layer norm makes the plain sum constant."""
    weights = torch.randn(values.shape[-1], generator=torch.Generator().manual_seed(0), dtype=values.dtype)
    return (values * weights).sum()


@torch.no_grad()
def streamed(encoder: Encoder, window: Windows) -> Tensor:
    """Representations (B, T, D) of windows, encoded row by row."""
    state, rows = encoder.initial_state(len(window.obs)), []
    for t in range(window.obs.shape[1]):
        z, state = encoder.step(window.obs[:, t], window.prev_action[:, t], state)
        rows.append(z)
    return torch.stack(rows, 1)


def reloaded(encoder: Encoder) -> Encoder:
    """The encoder from its folder; AssertionError if its config is another one."""
    with TemporaryDirectory() as folder:
        save_encoder(Path(folder), encoder, EncoderCard("mik+a", "", "", {"corruption": "none"}, 0, 0, "smoke"))
        loaded, _ = load_encoder(folder)
    claim(loaded.config == encoder.config, f"{encoder.config} came back as {loaded.config}")
    return loaded


def listed(names: Iterable[str]) -> str:
    """Sorted names, joined for a message; "none" if there are none."""
    return ", ".join(sorted(names)) or "none"

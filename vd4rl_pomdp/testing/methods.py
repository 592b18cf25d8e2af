"""Conformance checks of pretraining methods: loss, gradients, padding, streaming, resuming, visibility."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import fields
from typing import Any, cast

import torch

from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from pretrain.train import build_objective, build_target
from vd4rl_pomdp.core.options import check_options
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.types import StateWindows, Windows, previous
from vd4rl_pomdp.corruptions import CORRUPTIONS
from vd4rl_pomdp.nn.action_target import ACTION_TARGETS, CodeOptions, target_options
from vd4rl_pomdp.nn.objective import InverseObjective, Objective
from vd4rl_pomdp.nn.visibility import declared, dependence, response, wrong_pairs
from vd4rl_pomdp.runs.metrics import Means
from vd4rl_pomdp.testing.contract import (
    Check,
    claim,
    claim_close,
    claim_equal,
    claim_gradients,
    listed,
    run_checks,
    streamed,
)

ROWS, ACTIONS, STATE, POSE = 6, 2, 5, 3
_SMALL = {"max_k": 3, "feature_dim": 8, "hidden_dim": 7, "head_dim": 8}
_SMALLEST = {"max_k": ROWS - 1, "feature_dim": 6, "hidden_dim": 5, "head_dim": 32}
"""Sizes for visibility checks, which take a backward pass per pair; with fewer units all ReLUs of the head may be
zero."""
_PICTURE, _GRID = (9, 84), (9, 2)
"""Channels and image size: the benchmark's, and tiny ones for the frame encoder `flat`."""


def check_method(name: str, **settings: Any) -> None:
    """Run all checks on a method of `pretrain.objectives.METHODS`.

    `settings` are those of `vd4rl-pomdp pretrain`: the method's options, `history`, `frame_encoder`, ...
    """
    check_options(PretrainConfig.of("smoke", **({"method": name, "corruption": CORRUPTIONS[-1]} | settings)))
    run_checks("method", checks_of(name, **settings), name, **settings)


def checks_of(name: str, **settings: Any) -> tuple[Check, ...]:
    """Checks for a method: more of them if it is trained, and if it predicts actions."""
    trained = TRAINED if METHODS.named(name).trained else ()
    return (streaming_equals_batch, *trained, *(INVERSE if predicts_actions(name, **settings) else ()))


def predicts_actions(name: str, **settings: Any) -> bool:
    """Whether a method is trained as an inverse model."""
    return METHODS.named(name).trained and isinstance(build(name, **settings), InverseObjective)


def build(name: str, **settings: Any) -> Objective:
    """A small objective of a method, identical at every call; without convolutions, which all methods share."""
    return _build(name, _SMALL, _PICTURE, {"frame_encoder": "flat"} | settings)


def build_inverse(name: str, **settings: Any) -> InverseObjective:
    """An inverse model in float64, small enough to perturb each input; its default frame encoder is `flat`."""
    settings = {"frame_encoder": "flat"} | settings
    observation = _GRID if settings["frame_encoder"] == "flat" else _PICTURE
    return cast(InverseObjective, _build(name, _SMALLEST, observation, settings).double())


def _build(name: str, small: dict[str, int], observation: tuple[int, int], settings: dict[str, Any]) -> Objective:
    torch.manual_seed(0)
    config = PretrainConfig.of("smoke", method=name, **settings).with_known(**(small | settings))
    actions = torch.rand(50, ACTIONS) * 2 - 1
    states = StateScale(torch.zeros(STATE), torch.ones(STATE), POSE)
    return build_objective(config, ACTIONS, build_target(config, actions.numpy()), states, observation)


def batch(lengths: tuple[int, ...] = (ROWS, ROWS, 4), seed: int = 0, state: bool = False) -> Windows:
    """Windows of ROWS random images (or simulator states) and actions, with `lengths` real rows each, then padding."""
    g = torch.Generator().manual_seed(seed)
    shape = (STATE, 1, 1) if state else (9, 4, 4)
    obs = torch.randint(0, 256, (len(lengths), ROWS, *shape), generator=g, dtype=torch.uint8)
    if not state:  # blocks of 21 pixels, which remain recognisable under a shift
        obs = obs.repeat_interleave(21, -1).repeat_interleave(21, -2)
    length = torch.tensor(lengths)
    has_action = torch.arange(ROWS) < length[:, None] - 1
    action = (torch.rand(len(lengths), ROWS, ACTIONS, generator=g) * 2 - 1) * has_action[..., None]
    key = torch.arange(len(lengths) * ROWS).view(len(lengths), ROWS)
    return Windows(obs, previous(action), action, has_action, length, key)


def windows(name: str, lengths: tuple[int, ...] = (ROWS, ROWS, 4), seed: int = 0) -> Windows:
    """`batch` as the method sees it in training: with random simulator states if it regresses them."""
    plain = batch(lengths, seed)
    if not METHODS.named(name).regresses_state:
        return plain
    g = torch.Generator().manual_seed(seed)
    return StateWindows(**plain, state=torch.randn(len(lengths), ROWS, STATE, generator=g))


def streaming_equals_batch(name: str, **settings: Any) -> None:
    """Encoding row by row, as in the environment, equals encoding whole windows."""
    encoder = build(name, **settings).encoder.eval()
    window = batch((ROWS, ROWS), state=METHODS.named(name).reads_state)
    with torch.no_grad():
        whole = encoder.encode(window)
    shape = (2, ROWS, encoder.dim)
    claim(whole.shape == shape, f"windows are encoded as {tuple(whole.shape)}, not {shape}")
    claim_close(streamed(encoder, window), whole, "the two differ", 1e-5)


def a_loss_is_a_finite_scalar(name: str, **settings: Any) -> None:
    """The loss is a finite scalar; the logs are detached scalars and contain `loss`."""
    loss, logs = build(name, **settings).loss(windows(name), 0.0)
    claim(loss.shape == (), f"its shape is {tuple(loss.shape)}")
    claim(torch.isfinite(loss), f"it is {loss.item()}")
    for key, value in logs.items():
        claim(isinstance(value, torch.Tensor), f"{key} is logged as {type(value).__name__}: log a detached tensor")
        claim(value.numel() == 1, f"{key} is logged with shape {tuple(value.shape)}")
        claim(not value.requires_grad, f"{key} is logged with its graph: detach it")
    Means().add(logs)
    claim("loss" in logs, f"no `loss` is logged, only {listed(logs)}")
    claim(torch.equal(logs["loss"], loss.detach()), f"{logs['loss'].item()} is logged, the loss is {loss.item()}")


def a_loss_moves_the_whole_encoder(name: str, **settings: Any) -> None:
    """The loss has a gradient to every parameter of the encoder."""
    objective = build(name, **settings)
    objective.loss(windows(name), 0.0)[0].backward()
    claim_gradients(objective.encoder.named_parameters())


def steps_lower_the_loss(name: str, **settings: Any) -> None:
    """30 optimiser steps on one batch lower its loss by at least 3%."""
    objective = build(name, **settings)
    losses = _train(name, objective, torch.optim.Adam(objective.parameters(), lr=1e-3), [0] * 30)
    first, last = sum(losses[:5]) / 5, sum(losses[-5:]) / 5
    claim(last < 0.97 * first, f"the mean of the first five is {first}, of the last five {last}")


def _train(name: str, objective: Objective, optimiser: torch.optim.Optimizer, batches: Iterable[int]) -> list[float]:
    """Take one optimiser step per batch number; returns the losses."""
    losses = []
    for number in batches:
        loss, _ = objective.loss(windows(name, seed=number), 0.0)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        objective.after_step()
        losses.append(loss.item())
    return losses


def a_resumed_training_takes_the_same_steps(name: str, **settings: Any) -> None:
    """After restoring a checkpoint, training continues bit-identically, independent of torch's global random state."""
    here = build(name, **settings)
    optimiser = torch.optim.Adam(here.parameters(), lr=1e-3)
    _train(name, here, optimiser, range(2))
    there = build(name, **settings)
    with torch.no_grad():
        for parameter in there.parameters():
            parameter.add_(0.1)  # else parameters missing from the state_dict would match by the equal seed
    there.load_state_dict(copy.deepcopy(here.state_dict()))
    other = torch.optim.Adam(there.parameters(), lr=1e-3)
    other.load_state_dict(copy.deepcopy(optimiser.state_dict()))
    torch.manual_seed(1)
    losses = _train(name, here, optimiser, range(2, 5))
    torch.manual_seed(2)
    again = _train(name, there, other, range(2, 5))
    claim(
        losses == again,
        f"the losses are {losses} and {again}: keep what the loss reads as parameters or buffers, "
        "draw from nn.draws.Draws",
    )
    claim_equal(here.state_dict(), there.state_dict(), "these differ at the end")


def _trains(part: torch.nn.Module | torch.nn.Parameter) -> bool:
    """False for a frozen network, which an objective may keep to itself."""
    return any(p.requires_grad for p in ([part] if isinstance(part, torch.nn.Parameter) else part.parameters()))


def every_network_is_registered(name: str, **settings: Any) -> None:
    """Every network and parameter in a list, tuple or dict of an objective is registered with torch, unless frozen."""
    objective = build(name, **settings)
    known = {id(one) for one in (*objective.modules(), *objective.parameters())}
    for path, module in objective.named_modules():
        for key, value in vars(module).items():
            held = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
            loose = [one for one in held if isinstance(one, torch.nn.Module | torch.nn.Parameter) and _trains(one)]
            where = f"{path}.{key}".strip(".")
            claim(known.issuperset(map(id, loose)), f"those in `{where}` are not: use nn.ModuleList, ModuleDict, ...")


def padding_changes_no_loss(name: str, **settings: Any) -> None:
    """Rows beyond `real` do not change the loss, nor actions without `has_action`."""
    objective, window = build(name, **settings), windows(name, (4, 4, 4))
    noisy = window.replace(obs=window.obs.clone(), action=window.action.clone(), prev_action=window.prev_action.clone())
    # row 3, the last, has no action; the future encoder of MIK+A reads its zeros
    action = 4 if isinstance(objective, InverseObjective) else 3
    noisy.obs[:, 4:], noisy.action[:, action:], noisy.prev_action[:, action + 1 :] = 255, 7.0, 7.0
    if isinstance(noisy, StateWindows):
        noisy = noisy.replace(state=noisy.state.index_fill(1, torch.arange(4, ROWS), 7.0))
    again = copy.deepcopy(objective)
    expected, found = objective.loss(window, 0.0)[0], again.loss(noisy, 0.0)[0]
    claim_close(found, expected, "leave out rows beyond `real` and actions without `has_action`")


def every_action_target_is_accepted(name: str, **settings: Any) -> None:
    """A method that predicts actions has a finite loss with every action target."""
    for target in ACTION_TARGETS:
        read = {field.name for field in fields(target_options(target))}
        unread = {field.name for field in fields(CodeOptions)} - read
        chosen = {name: value for name, value in settings.items() if name not in unread} | {"action_target": target}
        loss, _ = build(name, **chosen).loss(batch(), 0.0)
        claim(torch.isfinite(loss), f"with {target} it is {loss.item()}")


def optional_terms_are_added(name: str, **settings: Any) -> None:
    """Self-prediction and the norm of states add to the loss with their weights; `--no-k-embedding` removes k from
    the head."""
    terms = {"self_prediction": 0.5, "l2_states": 0.1}
    rich = cast(InverseObjective, build(name, **(settings | terms | {"k_embedding": False})))
    plain = cast(InverseObjective, build(name, **(settings | dict.fromkeys(terms, 0.0) | {"k_embedding": False})))
    state = rich.state_dict()
    plain.load_state_dict({key: state[key] for key in plain.state_dict()})
    loss, logs = rich.loss(batch(), 0.25)
    expected = plain.loss(batch(), 0.25)[0] + 0.5 * logs["self_prediction"] + 0.1 * 0.75 * logs["l2_states"]
    claim_close(loss.detach(), expected.detach(), "the loss with these terms is not the loss without, plus the terms")
    claim(rich.head.k is None, "--no-k-embedding leaves k in the head")
    with_k = cast(InverseObjective, build(name, **(settings | {"k_embedding": True})))
    claim(with_k.head.k is not None, "--k-embedding gives the head no k")


def the_action_loss_is_that_of_each_pairs_first_action(name: str, **settings: Any) -> None:
    """`action_loss` is the mean of -log P(a_t | ...) over all real pairs (t, t+k), and `loss_kNN` the mean for one
    k."""
    objective, window = cast(InverseObjective, build(name, **settings)), batch()
    logits = copy.deepcopy(objective).action_logits(window)  # a copy, so that the loss below makes the same draws
    alone: dict[int, list[torch.Tensor]] = {}
    for p, (t, k) in enumerate(objective.pairs(ROWS).tolist()):
        for b, length in enumerate(window.length.tolist()):
            if t + k < length:
                alone.setdefault(k, []).append(objective.target.loss(logits[b, p], window.action[b, t]).detach())
    logs = objective.loss(window, 0.0)[1]
    whole = torch.stack([value for values in alone.values() for value in values]).mean()
    claim_close(logs["action_loss"], whole, "computed one by one they give another action_loss")
    for k, values in alone.items():
        claim_close(logs[f"loss_k{k:02d}"], torch.stack(values).mean(), f"one by one they give another loss_k{k:02d}")


def predictions_depend_on_what_is_declared(name: str, **settings: Any) -> None:
    """The prediction for each pair depends on exactly the inputs that `visible` and `visible_frames` declare."""
    for training in (False, True):  # batch norm mixes rows only in training mode
        claim_visibility(build_inverse(name, **settings).train(training), [ROWS, ROWS, 4], ROWS)
    if METHODS.named(name).past is not None and "m" not in settings:  # windows longer than the encoder's history
        claim_visibility(build_inverse(name, m=2, **settings), [ROWS, ROWS, 4], ROWS)


def claim_visibility(objective: InverseObjective, lengths: list[int], rows: int) -> None:
    """Raise AssertionError with the first failing pair unless the predictions depend on exactly what is declared."""
    for frames in (False, True):
        wrong = wrong_pairs(objective, lengths, rows, frames)
        if not wrong:
            continue
        b, t, k = wrong[0]
        found = {
            "has gradients to": dependence(objective, lengths, rows, frames)[b, t, k],
            "changes with": response(objective, lengths, rows, frames)[b, t, k],
            "is declared to see": declared(objective, t, k, lengths[b], b == 0, frames),
        }
        what = "frames" if frames else "rows"
        seen = "; ".join(f"{how} {what} {sorted(o)} and actions {sorted(a)}" for how, (o, a) in found.items())
        raise AssertionError(f"the prediction of a_{t} from rows {t} and {t + k} {seen} ({len(wrong)} pairs are wrong)")


TRAINED: tuple[Check, ...] = (
    every_network_is_registered,
    a_loss_is_a_finite_scalar,
    a_loss_moves_the_whole_encoder,
    steps_lower_the_loss,
    a_resumed_training_takes_the_same_steps,
    padding_changes_no_loss,
)
"""For trained methods."""
INVERSE: tuple[Check, ...] = (
    every_action_target_is_accepted,
    optional_terms_are_added,
    the_action_loss_is_that_of_each_pairs_first_action,
    predictions_depend_on_what_is_declared,
)
"""For methods that predict actions."""

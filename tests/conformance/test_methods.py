"""All registered methods satisfy the contract of methods; violations are caught."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from pretrain.objectives import METHODS, Method
from pretrain.objectives.masked_inverse import MaskedActionOptions, MaskedInverse
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.draws import Draws
from vd4rl_pomdp.nn.objective import InverseOptions, Objective, StateInverse
from vd4rl_pomdp.testing import check_method
from vd4rl_pomdp.testing import methods as checks
from vd4rl_pomdp.testing.contract import run_check

CASES = [(name, check) for name in METHODS for check in checks.checks_of(name)]


@pytest.mark.parametrize(("name", "check"), CASES, ids=lambda value: getattr(value, "__name__", value))
def test_method_conforms(name: str, check: Callable):
    run_check("method", check, name)


def test_inverse_loss_is_the_action_loss():
    """`check_method` tests the weighted terms."""
    loss, logs = checks.build("mik+a").loss(checks.batch(), 0.0)
    assert torch.equal(loss.detach(), logs["action_loss"])


def test_self_prediction_has_no_gradient_to_its_target():
    """||sg(s_{t+k}) - g(s_t, k)||^2: a window's last state is only a target and must receive no gradient."""
    objective, window = checks.build("mik+a", self_prediction=1.0), checks.batch((checks.ROWS, checks.ROWS))
    past, future = (x.detach().requires_grad_() for x in objective.representations(window))
    loss, logs = objective.loss_of(past, future, window, 0.0)
    loss.backward()
    assert (past.grad.abs().amax((0, 2)) > 0).tolist() == [True] * (checks.ROWS - 1) + [False]

    errors = []
    for t, k in objective.pairs(checks.ROWS).tolist():
        asked = torch.cat([past[:, t], torch.full((2, 1), k / objective.options.max_k)], dim=-1)
        errors.append((objective.predictor(asked) - past[:, t + k]).square().mean())
    torch.testing.assert_close(logs["self_prediction"], torch.stack(errors).mean().detach())


class Mean(Objective):
    """A valid method that pulls the mean of the features to 1; subclasses break the contract."""

    def __init__(self, encoder, target, options, seed):
        super().__init__()
        self.encoder = encoder
        self.steps = 0

    def loss(self, window, progress):
        error = (self.encoder.encode(window).mean(-1) - 1).square()
        loss = (error * window.real).sum() / window.real.sum()
        return loss, {"loss": loss.detach()}


class Diverged(Mean):
    def loss(self, window, progress):
        loss = super().loss(window, progress)[0] / 0
        return loss, {"loss": loss.detach()}


class Attached(Mean):
    def loss(self, window, progress):
        loss, _ = super().loss(window, progress)
        return loss, {"loss": loss}


class Misreported(Mean):
    def loss(self, window, progress):
        loss, _ = super().loss(window, progress)
        return loss, {"loss": loss.detach() + 1}


class Frozen(Mean):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.encoder.frame.project[0].bias.requires_grad_(False)


class Still(Mean):
    """Its gradient is unrelated to its value."""

    def loss(self, window, progress):
        loss = super().loss(window, progress)[0]
        loss = loss - loss.detach() + 1
        return loss, {"loss": loss.detach()}


class Counting(Mean):
    """Its loss depends on a counter that is not part of the state."""

    def loss(self, window, progress):
        self.steps += 1
        loss = super().loss(window, progress)[0] * self.steps
        return loss, {"loss": loss.detach()}


class Drawing(Mean):
    """Draws from torch's global generator."""

    def loss(self, window, progress):
        loss = super().loss(window, progress)[0] * torch.rand(())
        return loss, {"loss": loss.detach()}


class Listed(Mean):
    """Keeps a network in a list, where torch does not find it."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.heads = [nn.Linear(2, 2)]


class Teacher(Mean):
    """Keeps a frozen network to itself."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.teacher = [nn.Linear(2, 2).requires_grad_(False)]


class Named(Mean):
    def loss(self, window, progress):
        loss, logs = super().loss(window, progress)
        return loss, logs | {"eval/x": loss.detach()}


class Floating(Mean):
    def loss(self, window, progress):
        loss, logs = super().loss(window, progress)
        return loss, logs | {"error": loss.item()}


class Imagined(Mean):
    """Predicts the action of every real row; an episode's last has none."""

    def loss(self, window, progress):
        error = (self.encoder.encode(window).mean(-1) - window.action.mean(-1)).square()
        loss = (error * window.real).sum() / window.real.sum()
        return loss, {"loss": loss.detach()}


class Unmasked(Mean):
    def loss(self, window, progress):
        loss = (self.encoder.encode(window).mean(-1) - 1).square().mean()
        return loss, {"loss": loss.detach()}


class Looking(Mean):
    """Its encoder sees the window's last row in every row, which streaming cannot reproduce."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        encode = self.encoder.from_features
        self.encoder.from_features = lambda f, a: encode(f + f[:, -1:], a)


class DrawingInverse(StateInverse):
    """Predicts from noisy states with fresh draws in every call."""

    def __init__(self, encoder, target, options, seed):
        super().__init__(encoder, target, options, seed)
        self.draws = Draws(seed, "noise")

    def representations(self, window):
        past, future = super().representations(window)
        return past + self.draws.uniform(*past.shape), future


class Undeclared(StateInverse):
    def visible(self, t, k, rows):
        return {t, t + k - 1}, set()


MUTANTS = [
    (Diverged, checks.a_loss_is_a_finite_scalar, "it is inf"),
    (Attached, checks.a_loss_is_a_finite_scalar, "loss is logged with its graph"),
    (Misreported, checks.a_loss_is_a_finite_scalar, "is logged, the loss is"),
    (Floating, checks.a_loss_is_a_finite_scalar, "error is logged as float: log a detached tensor"),
    (Listed, checks.every_network_is_registered, "those in `heads` are not: use nn.ModuleList"),
    (Imagined, checks.padding_changes_no_loss, "actions without `has_action`"),
    (Frozen, checks.a_loss_moves_the_whole_encoder, "none reaches frame.project.0.bias"),
    (Still, checks.steps_lower_the_loss, "the mean of the first five is"),
    (Counting, checks.a_resumed_training_takes_the_same_steps, "keep what the loss reads as parameters"),
    (Drawing, checks.a_resumed_training_takes_the_same_steps, "draw from nn.draws.Draws"),
    (Unmasked, checks.padding_changes_no_loss, "leave out rows beyond `real`"),
    (Looking, checks.streaming_equals_batch, "the two differ"),
    (
        Undeclared,
        checks.predictions_depend_on_what_is_declared,
        "the prediction of a_0 from rows 0 and 1 has gradients to",
    ),
]


@pytest.mark.parametrize(("kind", "check", "reason"), MUTANTS, ids=lambda value: getattr(value, "__name__", ""))
def test_nonconforming_methods_are_caught(kind, check, reason):
    options = {"options": InverseOptions} if issubclass(kind, StateInverse) else {}
    METHODS.register("mine", Method(kind, **options))
    with pytest.raises(AssertionError, match=f"method 'mine' violates its contract(.|\n)*{reason}"):
        run_check("method", check, "mine")


class Distant(MaskedInverse):
    """Its future state reads the action five rows earlier: for k = 5 the one that it predicts."""

    def __init__(self, encoder, target, options, seed):
        super().__init__(encoder, target, options, seed)
        self.back = nn.Linear(encoder.config.action_dim, encoder.config.hidden_dim, bias=False)

    def representations(self, window):
        past, future = super().representations(window)
        earlier = F.pad(window.action, (0, 0, 5, 0))[:, : window.action.shape[1]]
        return past, future + self.back(earlier.to(future))


def test_leak_at_the_largest_gap_is_caught():
    METHODS.register("mine", Method(Distant, "gru", use_actions=True, options=MaskedActionOptions))
    with pytest.raises(AssertionError, match="the prediction of a_0 from rows 0 and 5 has gradients to"):
        run_check("method", checks.predictions_depend_on_what_is_declared, "mine")


def test_check_method_accepts_conforming_methods():
    METHODS.register("mine", Method(Mean))
    check_method("mine")
    check_method("mine", feature_dim=5)
    with pytest.raises(UserError, match="--max-k is not read by the method mine"):
        check_method("mine", max_k=2)
    METHODS.register("teacher", Method(Teacher))
    check_method("teacher")
    METHODS.register("named", Method(Named))
    with pytest.raises(UserError, match=r"a scalar of the loss is called 'eval/x', .*: rename it"):
        check_method("named")
    METHODS.register("drawing", Method(DrawingInverse, options=InverseOptions))
    check_method("drawing")
    with pytest.raises(UserError, match="unknown method 'yours'"):
        check_method("yours")

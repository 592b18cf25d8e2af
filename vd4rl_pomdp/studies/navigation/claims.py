"""What the paper says about the objectives, as statements that runs confirm or not, seed by seed.

Their wording and their bounds (half, three times) are this package's; some hold encoders against an untrained one,
which the paper's tables do not have.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import pandas as pd

from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.studies.navigation.measures import (
    UNTRAINED,
    Condition,
    Measure,
    held_out_loss,
    online_error,
    paper_number,
    refitted_error,
)
from vd4rl_pomdp.studies.navigation.runs import numbers_of

RECURRENT = ("ah", "ah+a", "fj", "fj+a", "mik", "mik+a")
NEAR_ZERO = 5.0
"""Action loss (nats x 100) that counts as near zero; guessing among 20 codes is 300."""
FEW = 15.0
"""State error (% of a standard deviation) below which a first person is said to know where it is."""
_RELATIONS = {">=": operator.ge, "<=": operator.le, "<": operator.lt, ">": operator.gt}
ClaimSide = tuple[Condition, Measure]
Numbers = Mapping[tuple[Any, ...], Mapping[int, float]]
"""What `numbers_of` returns."""


class Claim(NamedTuple):
    """`left` compared with `factor` times `right`; without a right side, with `factor` itself."""

    text: str
    left: ClaimSide
    relation: str
    factor: float
    right: ClaimSide | None = None

    def raw(self) -> Claim:
        """The same statement about errors in the simulator's units; itself where it names a bound in its own."""
        if self.right is None:
            return self
        left, right = ((condition, measure.raw()) for condition, measure in (self.left, self.right))
        return self._replace(left=left, right=right)

    def holds(self, left: float, right: float) -> bool:
        """Whether two numbers are in the relation."""
        return bool(_RELATIONS[self.relation](left, self.factor * right))


class Verdict(NamedTuple):
    """A claim and what the runs say."""

    claim: Claim
    left: float
    right: float
    """Means over the seeds for which both numbers exist; NaN while there is none."""
    seeds: int
    seeds_holding: int
    paper: tuple[float, float] | None
    """The paper's own two numbers, where it has them and the claim is in its units."""

    @property
    def holds(self) -> bool:
        """Whether it holds for the means over seeds."""
        return self.seeds > 0 and self.claim.holds(self.left, self.right)


def claims(maze: str) -> list[Claim]:
    """The claims about one maze: first whether training has gone far enough to compare, then the paper's statements."""

    def of(method: str, measure: Measure | str, max_k: int = 15, **options: bool) -> ClaimSide:
        named = refitted_error(measure) if isinstance(measure, str) else measure
        return Condition(maze, method, max_k, **options), named

    first, last = (of("mik+a", held_out_loss(k)) for k in (1, 15))
    best, literal = of("mik+a", "state", 1), of("mik+a", "state", 1, literal_future=True)
    recorder, slow, place = of("ah+a", "state", 1), of("mik+a", "velocity"), of("mik+a", "position")
    found = [
        Claim("gate: mik+a's action loss at k=1, of that at k=15", first, "<=", 0.85, last),
        Claim("no_history's velocity error, of mik+a's", of("no_history", "velocity"), ">=", 3, slow),
        Claim("K=1: ah+a's state error, of mik+a's", recorder, ">=", 2, best),
        Claim("K=1: ah+a's action loss is near zero", of("ah+a", held_out_loss(), 1), "<=", NEAR_ZERO),
        Claim("K=1: mik+a's state error with the literal future, of the default's", literal, ">=", 2, best),
        Claim("ah+a's position error, of mik+a's", of("ah+a", "position"), ">=", 1.5, place),
    ]
    if MAZES[maze].paper == "three_curtains":
        found += [
            Claim("mik's velocity error, of mik+a's", of("mik", "velocity"), ">=", 1.5, slow),
            Claim("ah's state error, of mik+a's", of("ah", "state"), ">", 1, of("mik+a", "state")),
        ]
    if MAZES[maze].paper == "first_person":  # the place is known where a picture does not tell it, by far
        for told, name in ((False, "mik+a"), (True, "mik+a with self-prediction")):
            ours = of("mik+a", "state", self_prediction=told)
            found += [
                Claim(f"state error of {name}, of the untrained one's", ours, "<", 0.5, of(UNTRAINED, "state")),
                Claim(f"state error of {name}", ours, "<", FEW),
                Claim(f"no_history's state error, of that of {name}", of("no_history", "state"), ">", 1, ours),
            ]
        found.append(
            Claim("ah+a's state error, of no_history's", of("ah+a", "state"), ">", 1, of("no_history", "state"))
        )
    for method in RECURRENT:
        text = f"{method}'s position error, of the untrained one's"
        found.append(Claim(text, of(method, "position"), "<", 0.5, of(UNTRAINED, "position")))
    return found


def judge(claim: Claim, numbers: Numbers) -> Verdict:
    """What the runs say of a claim, over the seeds that both sides have."""
    left = _by_seed(claim.left, numbers)
    right = dict.fromkeys(left, 1.0) if claim.right is None else _by_seed(claim.right, numbers)
    seeds = sorted(left.keys() & right.keys())
    holding = sum(claim.holds(left[seed], right[seed]) for seed in seeds)
    means = [sum(side[seed] for seed in seeds) / len(seeds) if seeds else math.nan for side in (left, right)]
    paper = [paper_number(*claim.left), 1.0 if claim.right is None else paper_number(*claim.right)]
    known = None if paper[0] is None or paper[1] is None else (paper[0], paper[1])
    return Verdict(claim, means[0], means[1], len(seeds), holding, known)


def _by_seed(side: ClaimSide, numbers: Numbers) -> Mapping[int, float]:
    condition, measure = side
    return numbers.get((*condition, *measure), {})


def verdict_lines(frame: pd.DataFrame) -> list[str]:
    """A section of a page: all statements about the mazes of some runs, whether they hold, and the paper's numbers."""
    numbers, mazes = numbers_of(frame), set(frame["maze"])
    pairs = [
        (maze, judge(claim, numbers), judge(claim.raw(), numbers))
        for maze in MAZES
        if maze in mazes
        for claim in claims(maze)
    ]
    judged = [percent for _, percent, _ in pairs if percent.seeds]
    printed = [raw for _, _, raw in pairs if raw.seeds and raw.paper]
    both = [(maze, percent, raw) for maze, percent, raw in pairs if raw.seeds and raw.claim != percent.claim]
    other = [f"{maze}: {percent.claim.text}" for maze, percent, raw in both if percent.holds != raw.holds]
    changes = f"{len(other)} change ({'; '.join(other)})" if other else "none changes"
    recorder = ", ".join(f"{number:.1f} ({maze})" for maze, number in _paper_positions())
    return [
        "## Which statements hold",
        "",
        f"{sum(v.holds for v in judged)} of {len(judged)} hold, {len(pairs) - len(judged)} wait for runs. "
        f"Of {len(both)} that are judged in both units, {changes}.",
        "Wording and bounds are this package's. "
        f"Of those for which the paper prints numbers, {sum(v.holds for v in printed)} of {len(printed)} hold.",
        "Means over seeds, held-out trajectories, probe refitted on frozen states; `seeds` says how many hold alone.",
        "",
        "| maze | statement | here, % of std | holds | seeds | here, raw x 100 | holds | the paper's numbers |",
        "|---|---|---|---|---|---|---|---|",
        *(_verdict_row(*pair) for pair in pairs),
        "",
        "That ah+a beats the untrained encoder is not to be expected: it tells an action from its record of past ones",
        f"and need not keep the state. In the paper its position error is {recorder}.",
        "",
    ]


def _paper_positions() -> Iterator[tuple[str, float]]:
    """The paper's position error of ah+a, by maze."""
    for maze in MAZES:
        if (number := paper_number(Condition(maze, "ah+a"), online_error("position").raw())) is not None:
            yield maze, number


def _verdict_row(maze: str, percent: Verdict, raw: Verdict) -> str:
    claim = percent.claim
    bound = f"{claim.relation} {claim.factor:g}" + (" x" if claim.right else "")
    columns = [maze, f"{claim.text} {bound}", "no run yet", "-", "-", "-", "-"]
    if percent.seeds:
        columns[2:5] = [*_answer(percent), f"{percent.seeds_holding} of {percent.seeds}"]
    if raw.claim == claim:
        columns[5:] = ["no error", "-"]
    elif raw.seeds:
        columns[5:] = _answer(raw)
    paper = f"{_sides(claim, *raw.paper)}: {'yes' if claim.holds(*raw.paper) else 'no'}" if raw.paper else "none"
    return f"| {' | '.join([*columns, paper])} |"


def _answer(verdict: Verdict) -> list[str]:
    return [_sides(verdict.claim, verdict.left, verdict.right), "**yes**" if verdict.holds else "**no**"]


def _sides(claim: Claim, left: float, right: float) -> str:
    return f"{left:.1f} / {right:.1f}" if claim.right else f"{left:.1f}"

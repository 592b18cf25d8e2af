"""What the paper says about the objectives, as statements that runs confirm or not, seed by seed.

Their wording and their bounds (half, three times) are this package's; some hold encoders against an untrained one,
which the paper's tables do not have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from vd4rl_pomdp.envs.mazes import MAZES, PAPER_MAZES
from vd4rl_pomdp.studies.navigation.grid import Condition, condition_of, paper_rows
from vd4rl_pomdp.studies.navigation.measures import Measure, held_out_loss, online_error, refitted_error
from vd4rl_pomdp.studies.navigation.methods import UNTRAINED, WITH_MEMORY
from vd4rl_pomdp.studies.navigation.runs import NavigationRun

RECURRENT = ("ah", "ah+a", "fj", "fj+a", "mik", "mik+a")
NEAR_ZERO = 5.0
"""Action loss (nats x 100) that counts as near zero; guessing among 20 codes is 300."""
FEW = 15.0
"""State error (% of a standard deviation) below which a first person is said to know where it is."""


@dataclass(frozen=True)
class Claim:
    """`left` compared with `factor` times `right`; without a right side, with `factor` itself."""

    text: str
    left: tuple[Condition, Measure]
    relation: str
    factor: float
    right: tuple[Condition, Measure] | None = None

    def raw(self) -> Claim:
        """The same statement about errors in the simulator's units; itself where it names a bound in its own."""
        if self.right is None:
            return self
        left, right = ((condition, measure.raw()) for condition, measure in (self.left, self.right))
        return replace(self, left=left, right=right)

    def holds(self, left: float, right: float) -> bool:
        """Whether two numbers are in the relation."""
        bound = self.factor * right
        return {">=": left >= bound, "<=": left <= bound, "<": left < bound, ">": left > bound}[self.relation]


@dataclass(frozen=True)
class Verdict:
    """A claim and what the runs say."""

    claim: Claim
    left: float
    right: float
    seeds: int
    """Seeds for which both numbers exist."""
    seeds_holding: int
    paper: tuple[float, float] | None
    """The paper's own two numbers, where it has them and the claim is in its units."""

    @property
    def holds(self) -> bool:
        """Whether it holds for the means over seeds."""
        return self.seeds > 0 and self.claim.holds(self.left, self.right)


def claims(maze: str) -> list[Claim]:
    """The claims about one maze: first whether training has gone far enough to compare, then the paper's statements."""

    best, best_1 = Condition(maze, "mik+a"), Condition(maze, "mik+a", 1)
    recorder, recorder_1 = Condition(maze, "ah+a"), Condition(maze, "ah+a", 1)
    literal = Condition(maze, "mik+a", 1, literal_future=True)
    state, position, velocity = (refitted_error(component) for component in ("state", "position", "velocity"))
    loss = held_out_loss
    found = [
        Claim("gate: mik+a's action loss at k=1, of that at k=15", (best, loss(1)), "<=", 0.85, (best, loss(15))),
        Claim(
            "no_history's velocity error, of mik+a's",
            (Condition(maze, "no_history"), velocity),
            ">=",
            3,
            (best, velocity),
        ),
        Claim("K=1: ah+a's state error, of mik+a's", (recorder_1, state), ">=", 2, (best_1, state)),
        Claim("K=1: ah+a's action loss is near zero", (recorder_1, loss(0)), "<=", NEAR_ZERO),
        Claim(
            "K=1: mik+a's state error with the literal future, of the default's",
            (literal, state),
            ">=",
            2,
            (best_1, state),
        ),
        Claim("ah+a's position error, of mik+a's", (recorder, position), ">=", 1.5, (best, position)),
    ]
    if MAZES[maze].paper == "three_curtains":
        found += [
            Claim("mik's velocity error, of mik+a's", (Condition(maze, "mik"), velocity), ">=", 1.5, (best, velocity)),
            Claim("ah's state error, of mik+a's", (Condition(maze, "ah"), state), ">", 1, (best, state)),
        ]
    if MAZES[maze].paper == "first_person":
        found += _first_person(maze, state)
    untrained = Condition(maze, UNTRAINED), position
    for method in RECURRENT:
        found.append(
            Claim(
                f"{method}'s position error, of the untrained one's",
                (Condition(maze, method), position),
                "<",
                0.5,
                untrained,
            )
        )
    return found


def _first_person(maze: str, state: Measure) -> list[Claim]:
    """That the place is known where a picture does not tell it: by far, and in the paper's order."""
    untrained, no_history, recorder = ((Condition(maze, name), state) for name in (UNTRAINED, "no_history", "ah+a"))
    found = []
    for told, name in ((False, "mik+a"), (True, "mik+a with self-prediction")):
        ours = Condition(maze, "mik+a", self_prediction=told), state
        found += [
            Claim(f"state error of {name}, of the untrained one's", ours, "<", 0.5, untrained),
            Claim(f"state error of {name}", ours, "<", FEW),
            Claim(f"no_history's state error, of that of {name}", no_history, ">", 1, ours),
        ]
    return [*found, Claim("ah+a's state error, of no_history's", recorder, ">", 1, no_history)]


def judge(claim: Claim, runs: Sequence[NavigationRun]) -> Verdict:
    """What the runs say of a claim, over the seeds that both sides have; NaN while there is none."""
    left = _by_seed(claim.left, runs)
    right = dict.fromkeys(left, 1.0) if claim.right is None else _by_seed(claim.right, runs)
    seeds = sorted(left.keys() & right.keys())
    holding = sum(claim.holds(left[seed], right[seed]) for seed in seeds)
    means = [sum(side[seed] for seed in seeds) / len(seeds) if seeds else math.nan for side in (left, right)]
    return Verdict(claim, means[0], means[1], len(seeds), holding, _paper_numbers(claim))


def _by_seed(side: tuple[Condition, Measure], runs: Sequence[NavigationRun]) -> dict[int, float]:
    condition, measure = side
    return {run.seed: run.values[measure] for run in runs if run.condition == condition and measure in run.values}


def _paper_numbers(claim: Claim) -> tuple[float, float] | None:
    left = paper_number(*claim.left)
    right = 1.0 if claim.right is None else paper_number(*claim.right)
    return None if left is None or right is None else (left, right)


def paper_number(condition: Condition, measure: Measure) -> float | None:
    """The paper's number for a condition of one of its own mazes and a measure in its units; None for all others."""
    for row in paper_rows() if condition.maze in PAPER_MAZES else ():
        if row["component"] == measure.paper and condition_of(row, condition.maze) == condition:
            return float(row[condition.maze])
    return None


def verdict_lines(runs: Sequence[NavigationRun]) -> list[str]:
    """A section of a page: all statements about the mazes of some runs, whether they hold, and the paper's numbers."""
    mazes = [maze for maze in MAZES if any(run.condition.maze == maze for run in runs)]
    pairs = [(maze, judge(claim, runs), judge(claim.raw(), runs)) for maze in mazes for claim in claims(maze)]
    judged = [percent for _, percent, _ in pairs if percent.seeds]
    printed = [raw for _, _, raw in pairs if raw.seeds and raw.paper]
    recorder = ", ".join(f"{_paper_position(maze):.1f} ({maze})" for maze in PAPER_MAZES)
    return [
        "## Which statements hold",
        "",
        f"{sum(v.holds for v in judged)} of {len(judged)} hold, {len(pairs) - len(judged)} wait for runs. "
        f"{_units_line(pairs)}",
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
        *_recorder_lines(runs),
        *_ceiling_lines(mazes, runs),
        "",
    ]


def _paper_position(maze: str) -> float:
    found = paper_number(Condition(maze, "ah+a"), online_error("position").raw())
    assert found is not None
    return found


def _recorder_lines(runs: Sequence[NavigationRun]) -> list[str]:
    """Whether ah+a has learned to record actions, beside the paper, whose table of action losses says it did."""
    loss, told = Measure("action_loss", "training", ""), []
    for maze in PAPER_MAZES:
        found = _by_seed((Condition(maze, "ah+a"), loss), runs).values()
        if found:
            told.append(f"{maze} {sum(found) / len(found):.1f} ({paper_number(Condition(maze, 'ah+a'), loss):.1f})")
    if not told:
        return []
    return [
        "",
        f"Its action loss at K = 15 (nats x 100, training averages; in brackets the paper's): {', '.join(told)}.",
        "Where it is far above the paper's, the recorder is not learned, and its state errors are no replication.",
    ]


def _units_line(pairs: Sequence[tuple[str, Verdict, Verdict]]) -> str:
    """What the raw units change: a sentence."""
    both = [pair for pair in pairs if pair[1].seeds and pair[2].seeds and pair[2].claim != pair[1].claim]
    missing = sum(bool(percent.seeds and not raw.seeds) for _, percent, raw in pairs)
    unknown = f" For {missing} it is not known: their runs kept no raw numbers." if missing else ""
    if not both:
        return (
            "What holds in raw units is not known: the runs kept neither raw numbers nor deviations." if missing else ""
        )
    other = [f"{maze}: {percent.claim.text}" for maze, percent, raw in both if percent.holds != raw.holds]
    changes = f"{len(other)} change ({'; '.join(other)})" if other else "none changes"
    return f"Of {len(both)} that are judged in both units, {changes}.{unknown}"


def _ceiling_lines(mazes: Sequence[str], runs: Sequence[NavigationRun]) -> list[str]:
    """What the same networks reach when they are trained on the true states, without and with past actions."""
    position = refitted_error("position")
    sides = [
        (maze, [_by_seed((Condition(maze, method), position), runs).values() for method in WITH_MEMORY])
        for maze in mazes
    ]
    reached = [
        f"{maze} {' and '.join(f'{sum(side) / len(side):.1f}' for side in pair)}" for maze, pair in sides if all(pair)
    ]
    if not reached:
        return []
    names = "without and with past actions"
    return [
        "",
        f"Trained on the true states, the same networks reach these position errors {names}: {', '.join(reached)}.",
    ]


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
    paper = "none"
    if raw.paper:
        paper = f"{_sides(claim, *raw.paper)}: {'yes' if claim.holds(*raw.paper) else 'no'}"
    return f"| {' | '.join([*columns, paper])} |"


def _answer(verdict: Verdict) -> list[str]:
    return [_sides(verdict.claim, verdict.left, verdict.right), "**yes**" if verdict.holds else "**no**"]


def _sides(claim: Claim, left: float, right: float) -> str:
    return f"{left:.1f} / {right:.1f}" if claim.right else f"{left:.1f}"

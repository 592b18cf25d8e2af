"""Gates that a setting must pass before its methods are ranked, and the paper's claims, judged on returns.

Gates: 1. The data must suffice for the algorithm, both with the state known (`state`) and with nothing hidden (`acro`
under `none`, relative to published results from pixels). 2. Under the corruption, some method must beat an untrained
encoder (`random`). 3. The critics of all these runs must have converged. If a gate fails, differences in return reflect
the data, the algorithm and their budget more than the representations.

Claims: the text and two figures of Wu et al. (arXiv 2404.14552, Section 4.2) claim that baselines fail considerably
under partial observability, that a history and then past actions improve on them, and that MIK+A leads in almost all
tasks. Two distances are reported besides: to a memory supervised with states, and to the states themselves. Claims of a
family (results/protocol.md names two) are tested together: Holm's method adjusts their p values over the family's
claims measured in a setting. All others are exploratory and judged individually.

Named methods are used without variants, and only runs with equal settings are compared.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from vd4rl_pomdp.core.errors import distinct_texts
from vd4rl_pomdp.core.options import settings_of
from vd4rl_pomdp.core.text import counted
from vd4rl_pomdp.data.folder import published_scores
from vd4rl_pomdp.report import load, stats
from vd4rl_pomdp.report.load import REFERENCES, SETTING, STATE, Run, label
from vd4rl_pomdp.runs.files import Row, groups
from vd4rl_pomdp.runs.results import NOT_CERTIFIED, certificate_in_words

STATE_SHARE = 0.9  # minimum return of `state`, as a fraction of the data's mean return
PUBLISHED_SHARE, ACRO_SHARE = 0.8, 0.7
"""Minimum return of `acro` under `none`: PUBLISHED_SHARE of the highest published return of BASELINES or of the
data's mean return, whichever is smaller; ACRO_SHARE of the latter if no score is published for the quality."""
BASELINES = {"bc": "BC", "drq_bc": "DrQ+BC"}
"""V-D4RL's offline baselines from pixels, by column of `published_scores`."""
PASSED, FAILED, UNKNOWN = "discriminates", "undecided at this budget", "not known to discriminate"
NOT_RECORDED, NOT_CONVERGED = "convergence is not recorded", "unconverged critic"
GATED = (*SETTING, "algorithm")
_place = itemgetter(*GATED)
HOLDS, FAILS, OPEN, FEW = "holds", "does not hold", "undecided", "too few seeds"
UNJUDGED = "not judged: "  # how a verdict begins where nothing is judged, before the reason
NOT_REFUTED = "not refuted"  # verdict of an undecided "not below" claim
PRIMARY, SECOND, EXPLORATORY = "primary", "second family", "exploratory"
DISTANCE = "distance"  # kind of a row that is a measurement, not a claim
LEADER, OTHER = "mik+a", "acro"
OTHERS = {"mik+a minus acro": "method", "mik+a minus acro with a GRU": "gru"}
"""What the leader is compared with, by the difference's name: the other method's `--history`."""


class Sides(NamedTuple):
    """A comparison of two methods' seeds, each of one variant; empty if one side has no run."""

    left: list[Run]
    right: list[Run]
    unlike: list[str]
    """Settings in which both sides differ; if not empty, the comparison is not one of methods alone."""


def gates(runs: list[Run]) -> list[Row]:
    """One row with a `verdict` per task, quality, corruption and algorithm with finished runs of frozen encoders.

    `data_return` is a mean over the datasets of its runs. `state_share`, `acro_share` and `best_share` (of the best
    method) are fractions of the data's return; `state_seeds` and `acro_seeds` count the runs behind them. `acro_bar` is
    the minimum for `acro_share`, and `bar_from` the published score behind it. `above_random` is the mean return of the
    best method minus that of `random`, chosen by `sides`; `low` and `high` bound its 95% interval. `converged` says
    whether the critics of all these runs did. Unknown values are None.
    """
    finished = comparable(runs)
    return [_gate(key, on_set(key, finished)) for key in sorted({run.of(GATED) for run in finished})]


def _gate(key: tuple[str, ...], runs: list[Run]) -> Row:
    here, clean = (seen_under(under, runs) for under in (key[2], "none"))
    state, acro = best_of(as_it_is("state", here)), best_of(as_it_is("acro", clean))
    learned, floor = judged(run for run in here if run.method not in REFERENCES), as_it_is("random", here)
    above, (low, high) = difference(compared := sides(learned, floor))
    data = {value for run in here if (value := run.reference.data_return) is not None}
    everyone = {"state": state, "acro under none": acro}
    everyone |= {"best": compared.left or best_of(learned), "random": compared.right or best_of(floor)}
    bar, source = pixel_bar(key[0], key[1], [run.reference.data_return for run in acro or here])
    row: Row = dict(zip(GATED, key, strict=True)) | {
        "data_return": float(np.mean(sorted(data))) if data else None,
        **{"state_share": _share(state), "state_seeds": len(state)},
        **{"acro_share": _share(acro), "acro_seeds": len(acro), "acro_bar": bar, "bar_from": source},
        **{"best_share": _share(compared.left), "above_random": above, "low": low, "high": high},
        "converged": converged(run for seeds in everyone.values() for run in seeds),
    }
    missed, unknown = [], []
    for words, share, least in (
        ("state", row["state_share"], STATE_SHARE),
        ("acro under none", row["acro_share"], bar),
    ):
        if not everyone[words]:
            unknown.append(f"{words} was not measured")
        elif share is None or least is None:  # without a bar there is no share either
            recorded = all(run.reference.data_return is not None for run in everyone[words])
            unknown.append(f"the data's return is {'not above 0' if recorded else 'not known'}")
        elif share < least:
            found, asked = distinct_texts(share, least, 2)
            missed.append(f"{words} returns {found} of the data's return, less than {asked}")
    if compared.unlike:
        unknown.append(f"best and random have other {', '.join(compared.unlike)}")
    elif not floor or not learned:
        unknown.append("no method but references was measured" if floor else "random was not measured")
    elif low is None:
        unknown.append("best and random need two seeds each that differ")
    elif low <= 0:
        missed.append(f"best minus random is {above:.0f} {stats.interval(low, high, 0)}")
    if row["converged"] is None:
        unknown.append(NOT_RECORDED)
    if still := [name for name, seeds in everyone.items() if converged(seeds) is False]:
        missed.append(f"critics had not converged ({', '.join(still)})")
    if missed:  # one failed gate suffices, whatever is unknown about the others
        return row | {"verdict": f"{FAILED}: {'; '.join(missed)}"}
    return row | {"verdict": f"{UNKNOWN}: {'; '.join(dict.fromkeys(unknown))}" if unknown else PASSED}


def pixel_bar(task: str, quality: str, data: Sequence[float | None]) -> tuple[float | None, str]:
    """Minimum return of `acro` under `none`, as a fraction of its data's return, and the published score behind it.

    `data` is the mean return of each judged run's data. Unless all are known and above 0, there is no minimum.
    """
    scores = [row for row in published_scores() if (row["env"], row["dataset"]) == (task, quality)]
    if not scores:
        return ACRO_SHARE, "none published"
    score, name = max((float(scores[0][column]), name) for column, name in BASELINES.items())
    # Published returns exceed ours on some datasets: there, matching our own data's return is enough.
    shares = [min(1.0, 10 * score / value) for value in data if value is not None and value > 0]
    known = bool(shares) and len(shares) == len(data)
    return PUBLISHED_SHARE * float(np.mean(shares)) if known else None, f"{name} {score:g}"


def verdicts(runs: Iterable[Run], certificates: Mapping[str, Row]) -> dict[tuple[str, ...], str]:
    """By setting with an evaluated run, what `certificates`, by id, say about the need for memory for its datasets."""
    found = {}
    for place, mine in groups((run for run in runs if run.rows), lambda run: run.of(SETTING)).items():
        names = dict.fromkeys(run.result.certificate for run in mine)  # one per dataset
        texts = (certificate_in_words(certificates[name]) if name in certificates else NOT_CERTIFIED for name in names)
        counts = Counter(texts)
        parts = [f"{count} of {len(names)} datasets: {text}" for text, count in counts.most_common()]
        found[place] = "; ".join(parts if len(counts) > 1 else counts)
    return found


def unranked(table: list[Row], names: Sequence[str] = GATED) -> set[tuple[str, ...]]:
    """Undecided settings: values of some columns for which all rows fail a gate."""
    places = groups(table, itemgetter(*names))
    return {place for place, rows in places.items() if all(row["verdict"].startswith(FAILED) for row in rows)}


def comparable(runs: Iterable[Run]) -> list[Run]:
    """Evaluated runs with frozen encoders. End-to-end training says nothing about a pretraining objective."""
    return [run for run in runs if run.evaluated and not run.end_to_end]


def on_set(place: tuple[str, ...], runs: Iterable[Run]) -> list[Run]:
    """Runs with a row's task, quality and algorithm, under any corruption."""
    task, quality, _, algorithm = place
    return [run for run in runs if run.of(("task", "quality", "algorithm")) == (task, quality, algorithm)]


def converged(runs: Iterable[Run]) -> bool | None:
    """Whether the critics of all runs converged: False if one did not, else None if one is not recorded."""
    known = {run.converged for run in runs}
    return False if False in known else None if None in known else True


def seen_under(corruption: str, runs: Iterable[Run]) -> list[Run]:
    """Runs under a corruption, with missing seeds of `state` from other corruptions: nothing is hidden from it."""
    # The setting's own runs first, so that a seed of `state` under two corruptions counts once.
    found: dict[tuple[str, ...], Run] = {}
    for run in sorted(runs, key=lambda run: run.labels["corruption"] != corruption):
        if run.labels["corruption"] == corruption or run.method == STATE:
            found.setdefault(run.of(("method", "variant", "seed")), run)
    return list(found.values())


def as_it_is(method: str, runs: Iterable[Run], history: str = "method") -> list[Run]:
    """Runs of a method without variants other than its history. Unrecorded settings count as plain."""
    plain, mine = (load.PLAIN | {"history": history}).items(), [run for run in runs if run.method == method]
    return [run for run in mine if all(run.settings.get(name, load.PLAIN[name]) == value for name, value in plain)]


def judged(runs: Iterable[Run]) -> list[Run]:
    """Runs without variants, but `acro` with a GRU: the more variants compete, the higher is the best by chance."""
    every = list(runs)
    plain = [run for method in dict.fromkeys(run.method for run in every) for run in as_it_is(method, every)]
    return plain + as_it_is("acro", every, "gru")


def best_of(runs: Iterable[Run]) -> list[Run]:
    """Seeds of the method and variant with the highest mean return; empty without runs.

    A variant with a single seed is chosen only if none has more.
    """
    return max(seeds_by_variant(runs), key=_preference, default=[])


def sides(left: Iterable[Run], right: Iterable[Run]) -> Sides:
    """The pair of variants to compare, one from each side.

    Prefers pairs with equal settings, then with more than one seed on both sides, then with the highest returns.
    """
    pairs = _pairs(left, right)
    chosen = [pair for pair in pairs if not pair.unlike] or pairs
    return max(chosen, key=lambda pair: _preference(pair.left, pair.right), default=Sides([], [], []))


def _pairs(left: Iterable[Run], right: Iterable[Run]) -> list[Sides]:
    others = seeds_by_variant(right)
    return [Sides(one, other, _unlike(one, other)) for one in seeds_by_variant(left) for other in others]


def seeds_by_variant(runs: Iterable[Run]) -> list[list[Run]]:
    """Seeds by method and variant. Seeds that share an encoder are left out: their spread is not a method's."""
    own = (run for run in runs if load.ENCODER_SEED not in run.settings)
    return list(groups(own, lambda run: run.of(("method", "variant"))).values())


def _preference(*compared: list[Run]) -> tuple[int, float]:
    """Sort key: number of sides with more than one seed, then the sum of mean returns."""
    # Otherwise a lucky single seed could win, without an interval to show it.
    return sum(len(seeds) > 1 for seeds in compared), sum(float(returns_of(seeds).mean()) for seeds in compared)


def _unlike(left: list[Run], right: list[Run]) -> list[str]:
    """Settings that differ between both sides, ignoring those under comparison and the corruption's.

    For methods without pretraining, only fine-tuning settings count. If every training seed has its own dataset,
    datasets count as equal.
    """
    one, other, data = left[0], right[0], load.DATA[0]
    names = (one.settings.keys() & other.settings.keys()) - load.PLAIN.keys() - load.of_corruption(one.settings).keys()
    for run in (one, other):
        if run.method in ("random", STATE):
            names &= settings_of(run.record["config"]).keys() | {data}
    found = [name for name in one.settings if name in names - {data} and one.settings[name] != other.settings[name]]
    both = [*left, *right]
    if data in names and len({run.settings.get(data) for run in both}) > 1 and not load.a_set_a_seed(both):
        found.append(data)
    # a preset stands for the settings that it determines
    return [name for name in found if name in load.PRESETS] or found


def returns_of(runs: list[Run]) -> np.ndarray:
    """Mean return of each run's last evaluation, (n,)."""
    return np.array([np.mean([row["return"] for row in run.last]) for run in runs])


def episodes_of(runs: list[Run], clean: bool = False) -> np.ndarray:
    """Episode returns of each run's last evaluation, or with `clean` of the uncorrupted one, (n, episodes)."""
    return stats.by_episode([[row["return"] for row in (run.last_clean if clean else run.last)] for run in runs])


def difference(compared: Sides, clean: bool = False) -> tuple[float | None, tuple[float | None, float | None]]:
    """Mean return of the left side minus that of the right, and its 95% interval over seeds and episodes.

    None if a side has no run, if settings differ or, with `clean`, if a policy was not evaluated without corruption.
    The interval is None if `stats.difference_interval` has none.
    """
    everyone = [*compared.left, *compared.right]
    if not compared.left or compared.unlike or (clean and not all(run.last_clean for run in everyone)):
        return None, (None, None)
    best, floor = (episodes_of(runs, clean) for runs in (compared.left, compared.right))
    return float(best.mean() - floor.mean()), stats.difference_interval(best, floor) or (None, None)


def _share(runs: list[Run]) -> float | None:
    """Mean return as a fraction of each run's own data return; None without runs or if a data return is not above 0."""
    known = [value for run in runs if (value := run.reference.data_return) is not None and value > 0]
    return float((returns_of(runs) / known).mean()) if runs and len(known) == len(runs) else None


class Contender(NamedTuple):
    """The runs on one side of a claim."""

    method: str = ""  # a method; empty: every method except the other side's
    history: str = "method"  # its `--history`
    clean: bool = False  # whether to take runs without corruption, whatever the setting hides


class ReturnClaim(NamedTuple):
    """A claim that the left side returns more than the right."""

    text: str
    left: Contender
    right: Contender
    hidden: bool = True  # True: for settings with a corruption; False: for settings without
    kind: str = "above"  # above; not below (refuted if the left side is below); or distance, which is no claim
    family: str = EXPLORATORY  # claims that it is tested together with; exploratory: none


_MIK_A, _MIK, _ACRO = Contender("mik+a"), Contender("mik"), Contender("acro")
CLAIMS = (
    ReturnClaim("acro returns less where pixels are hidden", Contender("acro", clean=True), _ACRO),
    ReturnClaim("memory helps: mik above acro", _MIK, _ACRO, family=PRIMARY),
    ReturnClaim("memory helps: acro with a GRU above acro", Contender("acro", "gru"), _ACRO, family=PRIMARY),
    ReturnClaim("past actions help: mik+a above mik", _MIK_A, _MIK, family=PRIMARY),
    ReturnClaim("both help: mik+a above acro", _MIK_A, _ACRO, family=PRIMARY),
    ReturnClaim("mik+a above ah+a", _MIK_A, Contender("ah+a"), family=SECOND),
    ReturnClaim("mik+a above fj+a", _MIK_A, Contender("fj+a"), family=SECOND),
    ReturnClaim("mik+a is above every other method", _MIK_A, Contender()),
    ReturnClaim("with nothing hidden, mik+a is not below acro", _MIK_A, _ACRO, hidden=False, kind="not below"),
    ReturnClaim("what a memory trained on the states adds", Contender("supervised+a"), _MIK_A, kind=DISTANCE),
    ReturnClaim("what the states themselves add", Contender("state", clean=True), _MIK_A, kind=DISTANCE),
)


def judge_claims(runs: list[Run], unranked: Collection[tuple[str, ...]] = ()) -> list[Row]:
    """One row with a `verdict` per claim, setting and pair of variants with equal settings, such as those of a budget.

    `difference` is the left side's mean return minus the right's, `low` and `high` its 95% interval, `p` its two-sided
    p value; columns with `clean_` are the same without corruption. A claim of a family is judged by `adjusted_p`,
    adjusted among pairs with equal settings, an exploratory one by `p`. `smallest` is the difference that a 5% test
    with this standard error detects with 80% power; `smallest_share` is the same as a fraction of the data's return. If
    the sides have no runs with equal settings, these are None and the verdict names the differences. Nothing is judged
    unless the critics of both sides are known to have converged, nor in settings that are `unranked`.
    """
    finished = comparable(runs)
    places = sorted({run.of(GATED) for run in finished})
    found = [one for claim in CLAIMS for place in places for one in _compared(claim, place, finished)]
    tested = [one for one in found if one[0]["family"] in (PRIMARY, SECOND) and one[0]["p"] is not None]
    methods = [side[0].settings for _, compared in tested for side in (compared.left, compared.right)]
    known = [name for name in methods[0] if name not in (*load.PLAIN, *load.DATA)] if methods else []
    shared = [name for name in known if all(name in settings for settings in methods)]  # not options of one method

    def alike(one: tuple[Row, Sides]) -> tuple[str, ...]:
        return (one[0]["family"], *_place(one[0]), *(one[1].left[0].settings[name] for name in shared))

    for family in groups(tested, alike).values():
        for (row, _), adjusted in zip(family, stats.holm([row["p"] for row, _ in family]), strict=True):
            row["adjusted_p"] = adjusted
    return [row | {"verdict": _verdict(row, compared, _place(row) in unranked)} for row, compared in found]


def _compared(claim: ReturnClaim, place: tuple[str, ...], runs: list[Run]) -> Iterator[tuple[Row, Sides]]:
    """A claim in a setting, not judged yet, and its comparisons; none if a side has no run."""
    if claim.hidden == (place[2] == "none"):
        return
    alike, chosen = on_set(place, runs), []
    for side, other in ((claim.left, claim.right), (claim.right, claim.left)):
        seen = seen_under("none" if side.clean else place[2], alike)
        others = judged(run for run in seen if run.method not in (other.method, *REFERENCES))
        chosen.append(as_it_is(side.method, seen, side.history) if side.method else others)
    pairs = [pair for pair in _pairs(*chosen) if not pair.unlike] or [sides(*chosen)]
    for compared in pairs if claim.right.method else [_decisive(*chosen)]:
        if compared.left:
            yield _row(claim, place, compared), compared


def _row(claim: ReturnClaim, place: tuple[str, ...], compared: Sides) -> Row:
    row: Row = {"claim": claim.text, "kind": claim.kind, "family": "" if claim.kind == DISTANCE else claim.family}
    row |= dict(zip(GATED, place, strict=True))
    for name, seeds in (("left", compared.left), ("right", compared.right)):
        row |= {name: label(seeds[0].named), f"{name}_return": float(returns_of(seeds).mean())}
        row[f"{name}_seeds"] = len(seeds)
    for prefix in ("", "clean_"):
        above, (low, high) = difference(compared, clean=bool(prefix))
        row |= {f"{prefix}difference": above, f"{prefix}low": low, f"{prefix}high": high}
    found = None if compared.unlike else stats.difference(episodes_of(compared.left), episodes_of(compared.right))
    data = [run.reference.data_return for run in (*compared.left, *compared.right)]
    mean = None if None in data else float(np.mean(data))  # type: ignore[arg-type]
    smallest = found and found.smallest
    row |= {"p": found and found.p, "adjusted_p": None, "smallest": smallest, "data_return": mean}
    row["smallest_share"] = smallest / mean if smallest and mean and mean > 0 else None
    return row


def _decisive(left: list[Run], others: list[Run]) -> Sides:
    """The comparison that decides a claim about every other method, since it must hold against each of them.

    Among other methods: the one with the highest return of those that refute the claim, else of those that
    leave it open, however few seeds they have.
    """
    pairs = [pair for seeds in seeds_by_variant(others) if (pair := sides(left, seeds)).left]
    alike = [pair for pair in pairs if not pair.unlike]
    ends = [difference(pair)[1] for pair in alike]
    refuted = [pair for pair, (_, high) in zip(alike, ends, strict=True) if high is not None and high < 0]
    above = [low is not None and low > 0 for low, _ in ends]
    doubted = [pair for pair, holds in zip(alike, above, strict=True) if not holds or not converged(pair.right)]
    # The best other method alone is not enough: a weaker one with a single seed may leave the claim open.
    decisive = refuted or doubted or alike or pairs
    return max(decisive, key=lambda pair: returns_of(pair.right).mean(), default=Sides([], [], []))


def _verdict(row: Row, compared: Sides, unranked: bool) -> str:
    if compared.unlike:
        return f"{UNJUDGED}other {', '.join(compared.unlike)}"
    if row["kind"] == DISTANCE:
        return ""
    settled = converged([*compared.left, *compared.right])
    if unranked or not settled:
        return f"{UNJUDGED}{FAILED if unranked else NOT_RECORDED if settled is None else NOT_CONVERGED}"
    p = row["p"] if row["adjusted_p"] is None else row["adjusted_p"]
    sign = HOLDS if row["difference"] > 0 else FAILS
    found = FEW if p is None else sign if p < stats.LEVEL else OPEN
    return NOT_REFUTED if found == OPEN and row["kind"] == "not below" else found


def opposite(row: Row) -> bool:
    """Whether the difference of a claim with a verdict has the other sign where nothing is hidden in evaluation."""
    if not row["verdict"]:
        return False
    return None not in (row["difference"], row["clean_difference"]) and row["difference"] * row["clean_difference"] < 0


def tally(rows: list[Row]) -> str:
    """Summary of a claim over its settings: "holds in 1 of 3 settings; undecided in 1; not judged in 1 (1 REASON)".

    With several budgets in a setting, it counts comparisons.
    """
    if rows[0]["kind"] == DISTANCE:
        return ""
    counts = {verdict: len(members) for verdict, members in groups(rows, lambda row: str(row["verdict"])).items()}
    noun = "setting" if len({_place(row) for row in rows}) == len(rows) else "comparison"
    words = [f"{HOLDS} in {counts.pop(HOLDS, 0)} of {counted(len(rows), noun)}"]
    reasons = {name.removeprefix(UNJUDGED): counts.pop(name) for name in [*counts] if name.startswith(UNJUDGED)}
    words += [f"{verdict} in {count}" for verdict, count in counts.items()]
    if reasons:
        why = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        words.append(f"not judged in {sum(reasons.values())} ({why})")
    return "; ".join(words)


def leads(runs: list[Run]) -> list[Row]:
    """How the leader's lead depends on pretraining: a row per setting, policy budget, difference, pretraining budget.

    Only where both methods have at least two pretraining budgets, with a run each. `difference` is the leader's mean
    return minus the other method's, each run's in % of its own data's mean return; `low` and `high` bound its 95%
    interval over seeds and episodes. Only runs with equal settings are compared; without any it is None. `left_seeds`
    and `right_seeds` count both sides' seeds, comparable or not.

    A policy's budget is its `updates` and hidden `units`; a pretraining's is its `steps` and frame `stacks` per batch.
    """
    finished = [run for run in comparable(runs) if (run.reference.data_return or 0) > 0]
    sides_of = [as_it_is(LEADER, finished), *(as_it_is(OTHER, finished, history) for history in OTHERS.values())]
    known = []
    for run in (run for side in sides_of for run in side):
        own, card = run.record["config"], run.result.card
        before = card.get("settings") or {}
        if {"updates", "hidden_dim"} <= own.keys() and "steps" in card and {"batch_size", "window"} <= before.keys():
            pretraining = card["steps"], before["batch_size"] * before["window"]
            known.append((run, (own["updates"], own["hidden_dim"]), pretraining))
    rows: list[Row] = []
    for (place, (updates, units)), here in sorted(groups(known, lambda one: (one[0].of(GATED), one[1])).items()):
        by_budget, everyone = groups(here, itemgetter(2)), [run for run, *_ in here]
        for name, history in OTHERS.items():
            if len(by_budget) < 2 or not (as_it_is(LEADER, everyone) and as_it_is(OTHER, everyone, history)):
                continue
            for (steps, stacks), mine in sorted(by_budget.items(), key=lambda item: math.prod(item[0])):
                row = dict(zip(GATED, place, strict=True)) | {"method": name, "variant": "", "updates": updates}
                row |= {"units": units, "steps": steps, "stacks": stacks}
                rows.append(row | _lead([run for run, *_ in mine], history))
    if len({(row["updates"], row["units"]) for row in rows}) > 1:
        for row in rows:
            row["variant"] = f"{row['updates']:,} updates of {row['units']:,} units"
    return rows


def _lead(runs: list[Run], history: str) -> Row:
    """The difference among runs of one budget."""
    both = as_it_is(LEADER, runs), as_it_is(OTHER, runs, history)
    compared = sides(*both)
    row: Row = dict.fromkeys(("difference", "low", "high", "seeds"))
    if compared.left and not compared.unlike:
        both = compared.left, compared.right
        data = (np.array([[run.reference.data_return] for run in side], dtype=float) for side in both)
        left, right = (100 * episodes_of(side) / known for side, known in zip(both, data, strict=True))
        row["low"], row["high"] = stats.difference_interval(left, right) or (None, None)
        row["difference"] = float(left.mean() - right.mean())
    seeds = [len({run.labels["seed"] for run in side}) for side in both]
    row["seeds"] = 0 if row["difference"] is None else min(seeds)
    return row | {"left_seeds": seeds[0], "right_seeds": seeds[1]}

"""Where the paper's text and exact enumeration differ: one object a fact, with the worlds that show it.

A fact is checked where it stands. `contradicts` finds its numbers on a world that meets the assumptions of the claim,
and `holds_on` says whether what is left of the claim holds there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from inspect import getdoc

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.studies.theory import contradictions, remainders
from vd4rl_pomdp.studies.theory.gallery import counterexample, echo, momentum
from vd4rl_pomdp.studies.theory.small import alternator, flicker, hidden_switch, idle, ladder, switch, toggle
from vd4rl_pomdp.studies.theory.world import World


@dataclass(frozen=True)
class Fact:
    """One statement of the paper that enumeration contradicts."""

    name: str
    title: str
    """What is true, in a line."""
    methods: tuple[str, ...]
    """Of Table 1; empty if the statement is about a world alone, or about all inverse models."""
    printed: str
    """What the paper prints, and where."""
    exact: str
    """What enumeration says of a world: a sentence with places for the numbers of `contradicts`."""
    holds: str
    """What is left of the claim."""
    worlds: tuple[Callable[[], World], ...]
    """Worlds that contradict the claim, the smallest first."""
    contradicts: Callable[[World], Row | None]
    """What contradicts the claim on a world, in numbers; None if nothing does."""
    holds_on: Callable[[World], bool]
    """Whether what is left of the claim holds on a world that contradicts it."""
    searched: bool = True
    """Whether no smaller world of `small.FAMILY` contradicts the claim. False: the claim is about this world alone."""


AT = (
    "with m = {m}, n = {n}, k = {k}, s_t = {s_t}, s_{{t+k}} = {s_t+k}, P(a_t = {action}) is {exact} given what is seen "
    "and {printed} given the states"
)
PAST_AT = AT.replace(" n = {n},", "")
ON_STATES = "P(a_t | s_t, s_{t+k})"


def main_text() -> World:
    """The paper's own, with the actions of its main text, 0 and 1."""
    return counterexample((0, 1))


FACTS = (
    Fact(
        "reaches_back",
        "A forward jump looks back behind m",
        ("fj", "fj+a"),
        f"P(a_t | rows t-m..t and t+k-m..t+k) is {ON_STATES} for every k > m (section 3.1)",
        PAST_AT,
        "k up to m, as printed. Beyond, FJ+A sees what MIK+A sees at the gap k-m with n = m actions, "
        "as the paper counts them (here MIK+A reads a_{t+k}, too): it is "
        "P(a_t | s_t, s_{t+k-m}) where its later window tells its first state",
        (ladder, counterexample),
        contradictions.forward_jump,
        remainders.jumps_are_shorter,
    ),
    Fact(
        "useful_jumps",
        "Jumps beyond m are not useless to FJ+A",
        ("fj+a",),
        "on the counterexample k > m = 3 gives no signal, so that FJ and FJ+A fail (section 3.2)",
        "pairs of states that are told apart in all histories, of {pairs}: by FJ+A with k up to {m}, {near}; with k up "
        "to {max_k}, {far}; by the literal MIK+A, {masked}",
        "with k up to m FJ+A can be a recorder of actions, as the paper argues",
        (counterexample,),
        contradictions.useful_jumps,
        remainders.near_jumps_merge,
        searched=False,
    ),
    Fact(
        "no_future",
        "Without the leak, the counterexample breaks an assumption of MIK+A",
        ("mik+a",),
        "the counterexample sets MIK+A apart from FJ and FJ+A (section 3.2); MIK+A assumes that the future decodes "
        "(Table 1)",
        "no number of later rows tells the state; " + AT,
        "read literally, the future decodes, and MIK+A is the multi-step inverse",
        (hidden_switch, counterexample),
        contradictions.no_future,
        remainders.literal_is_right,
    ),
    Fact(
        "idle_k",
        "On the counterexample k = 3 tells nothing",
        (),
        "k = 2 and k = 3 are needed to tell the states apart, and k > 3 is uniform (section 3.2)",
        "at k = {idle} both first actions are equally likely for each of {pairs} pairs of states; k = {informative} "
        "alone tell anything",
        "16368 examples for k up to 10, diameter 3, m = 3, and uniform first actions from k = 4 to 10",
        (counterexample,),
        contradictions.idle_k,
        remainders.counts_are_right,
        searched=False,
    ),
    Fact(
        "main_text_actions",
        "With the main text's actions 0 and 1 every k tells something",
        (),
        "a_t is 0 or 1, the diameter is 3, and k > 3 is uniform (section 3.2); the appendix has -1 and +1",
        "k = {useful} are not uniform, and the diameter is {diameter}",
        "there are 16368 examples here, too; what else is printed is true of -1 and +1",
        (main_text,),
        contradictions.never_idle,
        remainders.examples_are_as_many,
        searched=False,
    ),
    Fact(
        "leaked_target",
        "Read literally, the later view holds the action that is asked for",
        ("mik+a literal", "fj+a literal"),
        f"row t is (o_t, a_{{t-1}}) (section 2), the later view begins with row t+k (appendix), MIK+A is {ON_STATES} "
        "from k = 1 on (section 3.1)",
        AT,
        "without a_{t+k-1} MIK+A is the multi-step inverse wherever past and future decode",
        (idle,),
        contradictions.leaked_target,
        remainders.masked_is_right,
    ),
    Fact(
        "leaked_mask",
        "Read literally, MIK+A sees one of the masked actions at every k",
        ("mik+a literal",),
        f"row t is (o_t, a_{{t-1}}), and MIK+A is {ON_STATES} at every k (section 3.1)",
        AT,
        "without a_{t+k-1} as above, and with it where states record the last action",
        (toggle, momentum),
        contradictions.leaked_mask,
        remainders.masked_is_right,
    ),
    Fact(
        "merged_states",
        "MIK+A's past encoder may merge states that act alike",
        ("mik+a",),
        "MIK+A finds the complete agent-centric state (Table 1, section 3.2)",
        "pairs of states that f must tell apart, with k up to {max_k} and both actions equally likely: {forced} of "
        "{pairs}",
        "one encoder for both ends has to tell all states apart",
        (switch, echo),
        contradictions.merged_states,
        remainders.one_encoder_separates,
    ),
    Fact(
        "merged_phases",
        "Where states take turns, no inverse model tells the turns apart",
        (),
        "all k up to the diameter recover the state of a deterministic world (appendix), and k = 1 to 3 that of the "
        "counterexample (section 3.2)",
        "codes that one encoder on true states needs, with k up to {max_k}: {codes} for {states} states",
        "states that can occur in the same row are told apart",
        (alternator, counterexample),
        contradictions.merged_phases,
        remainders.phases_are_whole,
    ),
    Fact(
        "needed_noise",
        "FJ+A's jumps beyond m may need the exogenous part",
        ("fj+a",),
        "FJ+A discards exogenous noise (Table 1)",
        "with m = {m} and k up to {k} the best prediction depends on the exogenous part of the past",
        "with k up to m it does not",
        (flicker, counterexample),
        contradictions.needed_noise,
        remainders.near_jumps_discard,
    ),
)


def told(fact: Fact, rows: Iterable[Row]) -> Row:
    """A fact in JSON, with what shows it among the `table.disagreements`."""
    return {
        "name": fact.name,
        "title": fact.title,
        "methods": list(fact.methods),
        "printed": fact.printed,
        "worlds": [_on(fact, make, smallest=fact.searched and not place) for place, make in enumerate(fact.worlds)],
        "holds": fact.holds,
        "in_table": [row for row in rows if explanation(row) == fact.name],
    }


def _on(fact: Fact, make: Callable[[], World], smallest: bool) -> Row:
    world = make()
    numbers = fact.contradicts(world)
    assert numbers is not None, f"{world.name} does not show {fact.name}"
    size = {"states": len(world.states), "exogenous": len(world.exogenous), "observations": len(world.symbols)}
    exact = fact.exact.format(**{key: _text(value) for key, value in numbers.items()})
    label = {"world": world.name, "story": (getdoc(make) or "").split("\n")[0], "smallest": smallest} | size
    return label | {"exact": exact, "numbers": numbers, "rest_holds": fact.holds_on(world)}


def explanation(row: Row) -> str:
    """The name of the fact that a row of `table.disagreements` is an instance of."""
    if row["claim"] == "discards":
        return "needed_noise"
    if row["claim"] == "complete":
        return "merged_phases" if row["period"] > 1 else "merged_states"
    return "leaked_mask" if row["method"] == "mik+a literal" else "reaches_back"


def _text(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)

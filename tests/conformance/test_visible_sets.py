"""The inputs of predictions, compared with sets written from the paper's Table 1 and not from the code.

The sets are drawn by hand for single pairs, and given as formulas for all pairs of all windows. The inputs are found
by changing one of them at a time and by gradients, and must also equal the declaration `visible`. For `mik+a` the sets
follow this project's reading of the table: the future begins with o_{t+k} and the action taken there; the option
`literal_future` begins with the action before instead.

Observations are stacks of three frames, so each shows the two frames before it, including those of masked steps.
Therefore all pairs are also compared in frames.
"""

from collections.abc import Callable
from functools import cache

import pytest

from pretrain.objectives import METHODS
from vd4rl_pomdp.nn.objective import InverseObjective
from vd4rl_pomdp.nn.visibility import declared, dependence, response
from vd4rl_pomdp.testing.methods import ROWS, build_inverse, predicts_actions

INSIDE, END, SHORT = 0, 1, 2
LENGTHS = [ROWS, ROWS, 4]
"""Windows that end inside the episode (their last row has an action), with the episode, and with padding."""
OPTIONS: dict[str, dict] = {
    "gru": {"history": "gru"},
    "layers": {"gru_layers": 2},
    "literal": {"literal_future": True},
    "m=0": {"m": 0},
    "m=1": {"m": 1},
    "m=2": {"m": 2},
    "m=9": {"m": 9},
    "n=0": {"n": 0},
    "n=1": {"n": 1},
    "n=9": {"n": 9},
    "newest": {"future_frames": "newest"},
    "transformer": {"history": "transformer"},
    "lru": {"history": "lru"},
    "narrow": {"history": "transformer", "attention_window": 2, "transformer_layers": 1},
}
WINDOWS = {"inside": INSIDE, "end": END, "short": SHORT}
DRAWN = """
method            options        window  t k   o_012345  a_012345

no_history        -              inside  1 3     .#..#.    ......
no_history        gru            inside  1 3     #####.    ......
acro              -              inside  1 3     .#..#.    ......
acro              -              short   0 3     #..#..    ......
acro              gru,m=1        inside  2 3     .##.##    ......
one_step_inverse  -              inside  2 1     ..##..    ......
acdf              -              inside  1 3     .#..#.    ......
smwm              -              inside  2 1     ..##..    ......
ah                -              end     0 5     ######    ......
ah+a              -              inside  1 3     #####.    ####..
ah+a              m=1            inside  2 3     .##.##    .#..#.
fj                m=1            inside  0 4     #..##.    ......
fj                m=2            inside  1 2     ####..    ......
fj+a              m=1            inside  0 1     ##....    #.....
fj+a              m=1            inside  2 3     .##.##    .#..#.
fj+a              m=2            inside  2 3     ######    ##.##.
fj+a              m=2            short   0 3     ####..    .##...
mik               -              inside  1 2     ##.###    ......
mik               -              end     0 5     #....#    ......
mik               m=0,n=1        inside  3 1     ...###    ......
mik               n=1            short   0 2     #.##..    ......
mik+a             -              inside  2 2     ###.##    ##..##
mik+a             -              inside  0 1     ######    .#####
mik+a             -              end     0 5     #....#    ......
mik+a             -              short   1 1     ####..    #.#...
mik+a             layers         inside  2 2     ###.##    ##..##
mik+a             m=1,n=0        inside  2 2     .##.#.    .#..#.
mik+a             m=1,n=1        end     2 2     .##.##    .#..#.
mik+a             literal        inside  2 2     ###.##    ##.##.
mik+a             literal        inside  2 1     ######    #####.
mik+a             literal        short   1 1     ####..    ###...
mik+a             literal,n=0    inside  1 2     ##.#..    #.#...
mik+a             transformer    inside  2 2     ###.##    ##..##
mik+a             lru            inside  2 2     ###.##    ##..##
mik+a             narrow         inside  2 2     .##.##    ##..##
mik+a             narrow         inside  3 1     ..####    .##.##
mik+a             narrow         inside  2 1     .####.    ##.##.
mik+a             narrow,m=0     inside  2 1     ..###.    ...##.
mik+a             narrow,n=0     inside  2 1     .###..    ##.#..
ah+a              narrow         inside  1 3     ##.##.    #.##..
ah+a              narrow         inside  2 3     .##.##    ##.##.
acro              narrow         inside  3 1     ..###.    ......
"""
"""# is visible, . is not. Columns: j of o_j and of a_j; a_5 exists only if the window ends inside the episode."""
Case = tuple[str, tuple[str, ...]]
LINES = [line.split() for line in DRAWN.strip().splitlines()[2:] if line]


def test_only_fj_has_a_bounded_past_by_default():
    """The windows below are too short for the default of m = 8."""
    bounded = {name: method.past for name, method in METHODS.items() if method.past is not None}
    assert bounded == {"fj": JUMPS_PAST, "fj+a": JUMPS_PAST}


def test_frames_after_the_predicted_action_that_fj_hides():
    """The later window's first stack shows two more frames: with m = 8, none is hidden up to k = 11."""
    objective, t = build_inverse("fj", m=8, max_k=15), 10
    hidden = {k: [j for j in range(t + 1, t + k) if j not in objective.visible_frames(t, k, 32)] for k in range(1, 16)}
    assert {k: len(frames) for k, frames in hidden.items()} == {k: max(0, k - 11) for k in range(1, 16)}


def test_drawn_cases_cover_all_inverse_methods():
    assert {line[0] for line in LINES} == {name for name in METHODS if predicts_actions(name)}


def settings(words: tuple[str, ...]) -> dict:
    return {key: value for word in words for key, value in OPTIONS[word].items()}


@cache
def seen_by(method: str, words: tuple[str, ...], frames: bool = False) -> tuple[InverseObjective, dict, dict]:
    """An objective, and by (window, t, k) the inputs that change its prediction and those with gradients."""
    largest = {} if method in ("one_step_inverse", "smwm") else {"max_k": ROWS - 1}
    objective = build_inverse(method, **largest, **settings(words)).eval()
    return objective, response(objective, LENGTHS, frames=frames), dependence(objective, LENGTHS, frames=frames)


@pytest.mark.parametrize("line", LINES, ids=" ".join)
def test_predictions_depend_on_drawn_sets(line: list[str]):
    method, options, window, t, k, rows, actions = line
    objective, changing, differentiable = seen_by(method, words_of(options))
    place = WINDOWS[window], int(t), int(k)
    drawn = marked(rows), marked(actions)
    assert changing[place] == drawn
    assert differentiable[place] == drawn
    assert declared(objective, *place[1:], LENGTHS[place[0]], last_action=place[0] == INSIDE) == drawn


def words_of(options: str) -> tuple[str, ...]:
    return () if options == "-" else tuple(options.split(","))


def marked(drawing: str) -> set[int]:
    return {place for place, mark in enumerate(drawing) if mark == "#"}


FAR = 99
"""m or n of an unbounded past or future."""
JUMPS_PAST = 8
"""Default m of FJ and FJ+A: the paper gives none, docs/navigation.md documents 8."""
Seen = Callable[[int, int, int, int, int], bool]
"""(j, t, u = t+k, m, n) -> whether row or action j is visible."""
ROW_OF: dict[str, Seen] = {
    "no_history": lambda j, t, u, m, n: j in (t, u),
    "acro": lambda j, t, u, m, n: j in (t, u),
    "one_step_inverse": lambda j, t, u, m, n: j in (t, t + 1),
    "acdf": lambda j, t, u, m, n: j in (t, u),
    "smwm": lambda j, t, u, m, n: j in (t, t + 1),
    "ah": lambda j, t, u, m, n: t - m <= j <= t or u - m <= j <= u,
    "fj": lambda j, t, u, m, n: t - m <= j <= t or u - m <= j <= u,
    "mik": lambda j, t, u, m, n: t - m <= j <= t or u <= j <= u + n,
}
"""Visible o_j in the paper's Table 1, or of a memoryless method; m rows of the past, n of the future."""
ACTION_OF: dict[str, Seen] = {
    "ah+a": lambda j, t, u, m, n: t - m <= j < t or u - m <= j < u,
    "fj+a": lambda j, t, u, m, n: t - m <= j < t or u - m <= j < u,
    "mik+a": lambda j, t, u, m, n: t - m <= j < t or u <= j <= u + n,
    "mik+a literal": lambda j, t, u, m, n: t - m <= j < t or u <= j + 1 <= u + n,
}
"""Visible a_j; methods without an entry see none. In the literal reading each future row has the action before it."""
BOUNDED = [
    *((name, ()) for name in METHODS if predicts_actions(name)),
    *((name, (m,)) for name in ("ah", "ah+a", "fj", "fj+a", "mik", "mik+a") for m in ("m=0", "m=1", "m=2")),
    *((name, ("gru", *m)) for name in ("no_history", "acro", "one_step_inverse") for m in ((), ("m=1",))),
    *((name, (m, n)) for name in ("mik", "mik+a") for m in ("m=0", "m=2") for n in ("n=0", "n=1")),
    *(("mik+a", ("literal", *n)) for n in ((), ("n=0",), ("n=1",), ("m=1", "n=1"))),
    *((name, ("newest", *more)) for name in ("mik", "mik+a") for more in ((), ("m=0", "n=0"), ("n=1",), ("layers",))),
    ("mik+a", ("newest", "literal")),
    *(
        (name, (memory, *more))
        for memory in ("transformer", "lru")
        for name, more in (
            *((name, ()) for name in METHODS if predicts_actions(name)),
            ("ah+a", ("m=1",)),
            ("mik+a", ("m=2", "n=1")),
            ("mik+a", ("literal",)),
            ("mik+a", ("newest",)),
        )
    ),
]


def from_the_paper(method: str, words: tuple[str, ...], t: int, k: int, last: int, acts: int) -> tuple:
    """Table 1's sets: rows up to `last`, actions up to `acts`. A memoryless method given a memory sees AH's rows."""
    given = settings(words)
    m, n = given.get("m", JUMPS_PAST if method in ("fj", "fj+a") else FAR), given.get("n", FAR)
    table = "ah" if "history" in given and METHODS[method].history == "none" else method.removesuffix("+a")
    row = ROW_OF[table]
    action = ACTION_OF.get(method + " literal" * given.get("literal_future", False), lambda *_: False)
    return (
        {j for j in range(last + 1) if row(j, t, t + k, m, n)},
        {j for j in range(acts + 1) if action(j, t, t + k, m, n)},
    )


@pytest.mark.parametrize("frames", [False, True], ids=["rows", "frames"])
@pytest.mark.parametrize(
    ("method", "words"), BOUNDED, ids=lambda value: value if isinstance(value, str) else ",".join(value)
)
def test_visible_sets_match_the_papers_table(method: str, words: tuple[str, ...], frames: bool):
    """In frames each row shows its own and the two before it, including masked ones unless they are blanked."""
    objective, changing, differentiable = seen_by(method, words, frames)
    assert len(changing) == sum(len(objective.pairs(length)) for length in LENGTHS)
    for (window, t, k), seen in changing.items():
        last = LENGTHS[window] - 1
        acts = last if window == INSIDE and "literal" not in words else last - 1
        table = rows, actions = from_the_paper(method, words, t, k, last, acts)
        if frames:
            masked = set(range(t + 1, t + k)) if "newest" in words else set()
            table = {frame for row in rows for frame in (row - 2, row - 1, row)} - masked, actions
        assert seen == differentiable[window, t, k] == table, (window, t, k)
        assert declared(objective, t, k, LENGTHS[window], window == INSIDE, frames) == table, (window, t, k)


@pytest.mark.parametrize("method", [name for name in METHODS if predicts_actions(name)])
def test_target_leaks_match_the_papers_table(method: str):
    """AH+A always sees a_t, FJ+A up to k = m, the literal MIK+A at k = 1, and no other method does."""
    for words in ((), ("literal",)) if method == "mik+a" else (("m=2",),) if method.startswith("fj") else ((),):
        leaks = {k for (_, t, k), (_, actions) in seen_by(method, words)[1].items() if t in actions}
        expected = {("ah+a", ()): {1, 2, 3, 4, 5}, ("fj+a", ("m=2",)): {1, 2}, ("mik+a", ("literal",)): {1}}
        assert leaks == expected.get((method, words), set())

"""A run's reference values come from its dataset; only shipped actors are known."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.helpers_data import fake_rows, write_fake_set, write_rows
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.reference import Reference, summarise
from vd4rl_pomdp.policies import load_actor
from vd4rl_pomdp.policies.actor import ASSETS
from vd4rl_pomdp.runs import REFERENCE_FILE

EXPERT, MEDIUM = (load_actor("walker_walk", quality).sha256 for quality in ("expert", "medium"))
ACTOR = {"task": "walker_walk", "quality": "expert", "sha256": EXPERT}


@pytest.mark.parametrize(
    ("shards", "known"),
    [
        ([{"task": "walker_walk", "actor_sha256": EXPERT}] * 2, ACTOR),
        ([{"task": "walker_walk", "set": "expert_noisy", "actor_sha256": EXPERT}], ACTOR),
        ([{"task": "walker_walk", "actor_sha256": MEDIUM}], {"quality": "medium", "sha256": MEDIUM}),
        ([{"task": "walker_walk", "actor_sha256": sha} for sha in (EXPERT, MEDIUM)], None),
        ([{"task": "walker_walk", "actor_sha256": EXPERT}, {}], None),
        ([{"task": "walker_walk", "set": "expert", "actor_sha256": "0" * 64}], None),
        ([{"task": "cheetah_run", "set": "expert", "actor_sha256": EXPERT}], None),
        ([{"task": "walker_walk", "set": "random", "actor_sha256": None}], None),
        ([{}], None),
        ([{"actor_sha256": EXPERT}], None),
    ],
    ids=["expert", "noisy", "medium", "two", "partly", "own", "other task", "random", "published", "no task"],
)
def test_reference_actor_is_known_only_if_single_and_shipped(tmp_path, shards, known):
    for number, attributes in enumerate(shards):
        write_rows(tmp_path / "set", fake_rows([8, 8]), attributes, f"{number}_fake.hdf5")
    dataset = open_dataset(tmp_path / "set")
    reference = Reference.of(dataset)
    assert reference.actor == (None if known is None else ACTOR | known)
    assert (reference.actor_file is None) == (known is None)
    assert reference.data_return == pytest.approx(np.mean(dataset.returns.tolist()), abs=1e-4)
    assert reference.path_error is None
    assert reference.mean_reward == pytest.approx(float(dataset.reward[dataset.t > 0].mean()), abs=1e-5)


def test_single_rows_are_no_episodes_of_the_data_return(tmp_path):
    rows = fake_rows([1, 5, 1, 6])
    write_rows(tmp_path / "set", rows, {}, "0_fake.hdf5")
    returns = open_dataset(tmp_path / "set").returns
    assert Reference.of(open_dataset(tmp_path / "set")).data_return == pytest.approx(float(returns[[1, 3]].mean()))


def test_reference_round_trip_and_retired_actor(tmp_path):
    assert Reference.read(tmp_path) == Reference(), "early versions stored no file, and then no mean reward"
    (tmp_path / REFERENCE_FILE).write_text('{"data_return": 2.0, "actor": null, "path_error": null}')
    assert Reference.read(tmp_path) == Reference(2.0)
    reference = Reference.of(
        open_dataset(write_fake_set(tmp_path / "set", attributes={"task": "walker_walk", "actor_sha256": EXPERT}))
    ).with_path_error(0.12345678)
    reference.write(tmp_path)
    assert Reference.read(tmp_path) == reference
    assert reference.path_error == 0.123457
    assert reference.actor_file == ASSETS / "walker_walk_expert.safetensors"
    assert Reference(actor=ACTOR | {"sha256": MEDIUM}).actor_file is None


@pytest.mark.parametrize(
    "change",
    [{"data_return": "much"}, {"path_error": [1]}, {"actor": "expert"}, {"actor": {"task": "walker_walk"}}, None],
    ids=str,
)
def test_damaged_reference_is_rejected(tmp_path, change):
    Reference(1.0, ACTOR, 0.5).write(tmp_path)
    whole = json.loads((tmp_path / REFERENCE_FILE).read_text())
    (tmp_path / REFERENCE_FILE).write_text(json.dumps({} if change is None else whole | change))
    with pytest.raises(UserError, match=r"reference\.json: is damaged"):
        Reference.read(Path(tmp_path))


def test_summary_counts_episodes_above_80_percent_of_data_return():
    given = (90.0, 0.2), (80.0, 0.4), (100.0, None)
    rows = [{"return": total, "score": total / 10, "action_error": error} for total, error in given]
    assert summarise(rows, Reference(data_return=100.0)) == {
        "score_mean": 9.0,
        "score_min": 8.0,
        "score_max": 10.0,
        "return_mean": 90.0,
        "share_above_80": 2 / 3,
        "action_error": pytest.approx(0.3),
    }
    for unknown in (None, -5.0):  # undefined for a negative return
        last = summarise(rows[2:], Reference(data_return=unknown))
        assert (last["share_above_80"], last["action_error"]) == (None, None)

"""Published sets download completely and verified; an incomplete one names the command that completes it."""

import hashlib
import re

import huggingface_hub
import pytest

from tests.helpers_bad_input import rejection
from tests.helpers_data import write_fake_set
from tests.helpers_hub import Hub, Repo
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import download as module
from vd4rl_pomdp.data import folder as listed
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.card import write_card
from vd4rl_pomdp.data.download import REPOSITORY, download
from vd4rl_pomdp.data.folder import RemoteFile, manifest
from vd4rl_pomdp.hub import push

CONTENT = {"0_a_expert.hdf5": b"first" * 999, "1_a_expert.hdf5": b"second" * 999, "0_a_medium.hdf5": b"m" * 500}
EXPERT, BOTH = "walker_walk/expert/84px", "walker_walk/medium_expert/84px"
FILES = {f"{EXPERT}/{name}": CONTENT[name] for name in list(CONTENT)[:2]}
FILES |= {f"{BOTH}/{name}": content for name, content in CONTENT.items()}


@pytest.fixture
def mirror(monkeypatch):
    """A local mirror with small files in place of the published ones."""
    hub = Hub()
    repo = hub.repos[f"datasets/{REPOSITORY}"] = Repo()
    repo.commit("main", {f"vd4rl/main/{path}": content for path, content in FILES.items()})
    server = hub.serve()
    hub.endpoint = f"http://127.0.0.1:{server.server_port}"
    listing = tuple(
        RemoteFile(f"vd4rl/main/{path}", len(content), hashlib.sha256(content).hexdigest())
        for path, content in FILES.items()
    )
    for where in (module, listed):
        monkeypatch.setattr(where, "manifest", lambda: listing)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr("huggingface_hub.file_download.time.sleep", lambda _: None)
    yield hub
    server.shutdown()
    server.server_close()
    huggingface_hub.close_session()


def fetch(mirror, destination, quality="expert", **options):
    return download("walker_walk", quality, destination, endpoint=mirror.endpoint, **options)


def fetched(mirror):
    """Names of the files requested since the last call."""
    found = {path.rpartition("/")[2] for path in mirror.requests if path.startswith("GET")}
    mirror.requests.clear()
    return sorted(found)


def test_manifest_lists_published_sets():
    listed = manifest()
    assert len(listed) == 86
    assert len({file.sha256 for file in listed}) == 62
    assert sum({file.sha256: file.size for file in listed}.values()) == pytest.approx(10.5e9, rel=0.01)
    assert len({tuple(file.path.split("/")[2:4]) for file in listed}) == 15


def test_download_command_fetches_several_sets(mirror, tmp_path, capsys):
    words = ["--task", "walker_walk", "--quality", "medium_expert", "expert", "--endpoint", mirror.endpoint]
    main(["data", "download", *words, "--out", str(tmp_path)])
    assert all((tmp_path / path).read_bytes() == content for path, content in FILES.items())
    assert capsys.readouterr().out.count("check them with") == 2


def test_download_resumes_and_reuses_stored_shards(mirror, tmp_path):
    mirror.cut[f"vd4rl/main/{EXPERT}/1_a_expert.hdf5"] = 1
    expert = fetch(mirror, tmp_path)
    asked = {path.rpartition("/")[2]: count for path, count in mirror.requests.items() if path.startswith("GET")}
    assert asked == {"0_a_expert.hdf5": 1, "1_a_expert.hdf5": 2}, "a cut connection is resumed"
    assert [shard.relative_to(tmp_path).as_posix() for shard in expert] == list(FILES)[:2]
    assert [shard.read_bytes() for shard in expert] == list(CONTENT.values())[:2]
    assert sorted(path.name for path in (tmp_path / EXPERT).iterdir()) == ["0_a_expert.hdf5", "1_a_expert.hdf5"]
    assert fetched(mirror) == ["0_a_expert.hdf5", "1_a_expert.hdf5"]
    assert fetch(mirror, tmp_path) == expert
    both = fetch(mirror, tmp_path, "medium_expert")
    assert fetched(mirror) == ["0_a_medium.hdf5"]
    assert [shard.read_bytes() for shard in both] == list(CONTENT.values())
    assert both[0].samefile(expert[0])
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]


def test_damage_is_found_by_size_and_with_verify_by_hash(mirror, tmp_path):
    first, second = fetch(mirror, tmp_path)
    first.write_bytes(b"short")
    second.write_bytes(b"SECOND" * 999)
    fetch(mirror, tmp_path)
    assert (first.read_bytes(), second.read_bytes()) == (CONTENT["0_a_expert.hdf5"], b"SECOND" * 999)
    third = fetch(mirror, tmp_path, "medium_expert")[1]
    assert third.read_bytes() == CONTENT["1_a_expert.hdf5"], "a damaged file of another set is not linked"
    fetch(mirror, tmp_path, verify=True)
    assert second.read_bytes() == CONTENT["1_a_expert.hdf5"]


def test_failed_download_keeps_complete_shards(mirror, tmp_path):
    mirror.damaged = {f"vd4rl/main/{EXPERT}/1_a_expert.hdf5"}
    with pytest.raises(UserError, match=r"1_a_expert\.hdf5: has a wrong SHA-256 and was removed; re-run the same"):
        fetch(mirror, tmp_path)
    mirror.damaged, mirror.status = set(), {"1_a_expert": 404}
    with pytest.raises(UserError, match=r"1_a_expert\.hdf5: cannot be fetched \(.*404.*\); check the network"):
        fetch(mirror, tmp_path)
    mirror.status = {}
    fetched(mirror)
    assert len(fetch(mirror, tmp_path)) == 2
    assert fetched(mirror) == ["1_a_expert.hdf5"]


def test_invalid_names_are_rejected_before_any_request(mirror, tmp_path):
    for words in (["walker_walk", "foo", "--quality", "expert"], ["walker_walk", "--quality", "expert", "foo"]):
        assert "'foo': choose one of" in rejection(
            ["data", "download", "--out", str(tmp_path), "--endpoint", mirror.endpoint, "--task", *words]
        )
    assert not mirror.requests
    assert not list(tmp_path.iterdir())


def test_token_is_sent_only_to_configured_hub(mirror, tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(module, "hf_hub_download", lambda *words, token, **options: given.append(token) or "/nowhere")
    for own in (mirror.endpoint, f"{mirror.endpoint}0"):
        monkeypatch.setenv("HF_ENDPOINT", own)
        with pytest.raises(UserError, match="no such file"):
            fetch(mirror, tmp_path)
    assert given == [None, False], "None: the user's token"


@pytest.mark.parametrize(
    ("endpoint", "message"),
    [
        ("hf.co", "endpoint 'hf.co' is not an address"),
        ("http://[", r"endpoint 'http://\[' is not an address"),
        ("http://127.0.0.1:9", "cannot be fetched .*choose another --endpoint"),
    ],
)
def test_bad_and_unreachable_endpoints_are_rejected(tmp_path, monkeypatch, endpoint, message):
    monkeypatch.setenv("NO_PROXY", "*")
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)
    with pytest.raises(UserError, match=message):
        download("walker_walk", "expert", tmp_path, endpoint)
    assert not list(tmp_path.rglob("*.hdf5"))


@pytest.mark.usefixtures("mirror")
def test_incomplete_published_set_names_download_command(tmp_path):
    place = write_fake_set(tmp_path / EXPERT, names=["0_a_expert.hdf5"])
    part = f"{place}: contains 1 of 2 shards of V-D4RL's walker_walk expert (1_a_expert.hdf5 is missing); get the rest "
    command = f"`vd4rl-pomdp data download --task walker_walk --quality expert --out {tmp_path}`"
    for read in (open_dataset, write_card, lambda folder: push(folder, "datasets/lab/set")):
        with pytest.raises(UserError, match=re.escape(f"{part}with {command}")):
            read(place)


@pytest.mark.usefixtures("mirror")
def test_sets_that_are_not_published_parts_are_opened(tmp_path):
    names = ["0_a_expert.hdf5", "1_a_expert.hdf5"]
    attributes = {"task": "walker_walk", "set": "expert"}
    write_fake_set(tmp_path / "a" / EXPERT, (5, 5), cuts=(5,), names=names)
    write_fake_set(tmp_path / "b" / EXPERT, names=names[:1], attributes=attributes)
    write_fake_set(tmp_path / "c" / "mine", names=names[:1])
    write_fake_set(tmp_path / "d" / EXPERT)
    for folder in (f"a/{EXPERT}", f"b/{EXPERT}", "c/mine", f"d/{EXPERT}"):
        assert open_dataset(tmp_path / folder).num_episodes == 2
    assert open_dataset(tmp_path / "c" / "mine" / names[0]).num_episodes == 2

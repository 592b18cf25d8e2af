"""Encoders and sets go to a Hub and come back as they were; what is not theirs, damaged or refused is one sentence."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import huggingface_hub
import pytest
import yaml

from tests.helpers_data import write_fake_set
from tests.helpers_hub import TOKEN, Hub, Repo
from tests.nn.test_encoder import CARD, make
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.hub import LISTING, Repository, pull, push
from vd4rl_pomdp.nn import load_encoder, save_encoder
from vd4rl_pomdp.nn.encoder_folder import encoder_hash

ENCODER, SET = Repository.named("lab/encoder"), Repository.named("datasets/lab/set")
WHERE = {ENCODER: "models/lab/encoder", SET: "datasets/lab/set"}
"""Where the Hub keeps them."""


@pytest.fixture
def hub(monkeypatch) -> Iterator[Hub]:
    """A Hub that huggingface_hub takes for the real one, and the token of one who may write there."""
    hub = Hub()
    server = hub.serve()
    monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr("huggingface_hub.file_download.time.sleep", lambda _: None)
    yield hub
    server.shutdown()
    server.server_close()
    huggingface_hub.close_session()


@pytest.fixture
def encoder(tmp_path) -> Path:
    save_encoder(tmp_path / "run" / "encoder", make("gru", True), CARD, frames=160)
    return tmp_path / "run" / "encoder"


@pytest.fixture
def data(tmp_path) -> Path:
    folder = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25, 30])
    (folder / "card.md").write_text("# A set\n\n![film](card.png)\n")
    (folder / "card.png").write_bytes(b"\x89PNG")
    (folder / ".hidden").write_text("mine")
    return folder


def content(folder: Path) -> dict[str, bytes]:
    """Files of a folder, but for hidden ones."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def lists(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_encoder_comes_back_as_it_was_with_its_name(hub, encoder, tmp_path):
    address = push(encoder, ENCODER)
    assert address.startswith(os.environ["HF_ENDPOINT"] + "/models/lab/encoder/commit/")
    assert pull(ENCODER, tmp_path / "new" / "encoder")
    assert content(tmp_path / "new" / "encoder") == content(encoder)
    assert encoder_hash(tmp_path / "new" / "encoder") == encoder_hash(encoder)
    assert load_encoder(tmp_path / "new" / "encoder")[1] == CARD
    assert lists(tmp_path / "new") == ["encoder"]
    assert list(hub.large.values()) == [(encoder / "model.safetensors").read_bytes()]


def test_a_pulled_encoders_card_names_the_licence_it_was_pushed_with_or_none(hub, encoder, tmp_path):
    push(encoder, ENCODER, license="apache-2.0")
    pull(ENCODER, tmp_path / "new")
    assert huggingface_hub.ModelCard.load(tmp_path / "new" / "README.md").data.license == "apache-2.0"
    listing = json.loads(hub.files(WHERE[ENCODER])[LISTING])
    del listing["license"]  # as earlier versions wrote it
    hub.repos[WHERE[ENCODER]].commit("main", hub.files(WHERE[ENCODER]) | {LISTING: json.dumps(listing).encode()})
    pull(ENCODER, tmp_path / "earlier")
    assert "licen" not in (tmp_path / "earlier" / "README.md").read_text()


def test_a_set_comes_back_as_it_was(hub, data, tmp_path):
    push(data, SET)
    assert pull(SET, tmp_path / "new")
    assert content(tmp_path / "new") == content(data)
    pushed = hub.files(WHERE[SET])
    assert set(pushed) == {*content(data), "README.md", LISTING, ".gitattributes"}
    assert len(hub.large) == len(list(data.glob("*.hdf5"))) + 1


def test_shards_of_capital_suffixes_are_sent_and_counted(hub, data, tmp_path):
    mine = shutil.copytree(data, tmp_path / "mine")
    last = max(mine.glob("*.hdf5"))
    last.rename(last.with_suffix(".HDF5"))
    push(mine, SET)
    assert pull(SET, tmp_path / "new")
    assert content(tmp_path / "new") == content(mine)
    (tmp_path / "new" / "9_more.H5").write_bytes(b"mine")
    with pytest.raises(UserError, match="is not empty and holds something else"):
        pull(SET, tmp_path / "new")


def test_cards_on_the_hub_say_how_to_load_what_they_describe(hub, encoder, data, monkeypatch, capsys):
    push(encoder, ENCODER, license="apache-2.0")
    push(data, SET)
    cards = {where: hub.files(WHERE[where])["README.md"].decode() for where in (ENCODER, SET)}
    front = {where: yaml.safe_load(card.split("---\n")[1]) for where, card in cards.items()}
    assert (front[ENCODER]["license"], front[SET]["license"]) == ("apache-2.0", "mit")
    assert {"walker_walk", "expert"} <= set(front[SET]["tags"])
    assert "# A set\n\n![film](card.png)" in cards[SET]
    assert "vd4rl-pomdp hub pull datasets/lab/set FOLDER" in cards[SET]
    code = re.search(r"```python\n(.*?)\n```", cards[ENCODER], re.DOTALL)[1]
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda name: {"lab/encoder": encoder}[name])
    exec(code, {})
    assert capsys.readouterr().out.split() == ["mik+a", "walker_walk", "12"]


def test_a_set_without_a_card_gets_one_of_its_names(hub, tmp_path):
    push(write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25]), SET)
    assert "# `walker_walk`, `expert`" in hub.files(WHERE[SET])["README.md"].decode()


def test_what_is_there_is_neither_sent_nor_fetched_again(hub, encoder, tmp_path):
    push(encoder, ENCODER)
    pull(ENCODER, tmp_path / "new")
    hub.requests.clear()
    assert not pull(ENCODER, tmp_path / "new")
    assert not any("model.safetensors" in request for request in hub.requests)
    push(encoder, ENCODER)
    assert not any(request.startswith("PUT") for request in hub.requests)


def test_a_later_push_replaces_all_of_the_earlier_one(hub, data, tmp_path):
    push(data, SET)
    hub.repos[WHERE[SET]].commit("main", hub.files(WHERE[SET]) | {"notes.txt": b"the owner's own"})
    (data / "card.png").unlink()
    push(data, SET)
    assert "card.png" not in hub.files(WHERE[SET])
    assert "notes.txt" in hub.files(WHERE[SET])
    pull(SET, tmp_path / "new")
    assert content(tmp_path / "new") == content(data)


def test_revisions_are_branches_tags_and_commits(hub, encoder, tmp_path):
    push(encoder, ENCODER)
    first = hub.repos[WHERE[ENCODER]].at("main")
    save_encoder(encoder, make("gru", True), replace(CARD, seed=1))
    push(encoder, ENCODER, revision="seed1")
    push(encoder, ENCODER, revision="seed1")
    assert hub.repos[WHERE[ENCODER]].at("main") == first
    for revision, seed in (("main", 0), ("seed1", 1), (first, 0)):
        pull(ENCODER, tmp_path / revision, revision)
        assert load_encoder(tmp_path / revision)[1].seed == seed
    with pytest.raises(UserError, match="lab/encoder: has no revision 'seed2'; check --revision"):
        pull(ENCODER, tmp_path / "new", "seed2")
    assert not (tmp_path / "new").exists()


def test_a_private_repository_needs_a_token_and_a_public_one_stays_public(hub, encoder, data, tmp_path, monkeypatch):
    push(encoder, ENCODER, private=True)
    push(data, SET)
    assert (hub.repos[WHERE[ENCODER]].private, hub.repos[WHERE[SET]].private) == (True, False)
    push(encoder, ENCODER, private=True)
    with pytest.raises(UserError, match="datasets/lab/set: is public already; leave --private out"):
        push(data, SET, private=True)
    monkeypatch.setenv("HF_TOKEN", "hf_other")
    with pytest.raises(UserError, match="lab/encoder: no such repository, or your token gives no access; check"):
        pull(ENCODER, tmp_path / "new")
    pull(SET, tmp_path / "public")
    with pytest.raises(UserError, match=r"datasets/lab/set: your token may not do this \(status 403\); check HF_TOKEN"):
        push(data, SET)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no repository: write OWNER/NAME for an encoder, datasets/OWNER/NAME for a data set"),
        ("encoder", "names no repository"),
        ("datasets/set", "names no repository"),
        ("models/lab/encoder", "names no repository"),
        ("lab/enc oder", "names no repository"),
        ("lab/..", "names no repository"),
        ("https://huggingface.co/lab/encoder", "names no repository"),
    ],
)
def test_a_name_of_no_repository_is_refused(text, message):
    with pytest.raises(UserError, match=message):
        Repository.named(text)


def test_only_whole_encoders_and_sets_go_to_repositories_of_their_kind(hub, encoder, data, tmp_path):
    with pytest.raises(UserError, match="holds neither an encoder nor a data set; name RUN/encoder or a folder"):
        push(tmp_path / "run", ENCODER)
    with pytest.raises(UserError, match="holds an encoder, which goes to OWNER/NAME; datasets/lab/set is the name"):
        push(encoder, SET)
    with pytest.raises(UserError, match="holds a data set, which goes to datasets/OWNER/NAME"):
        push(data, ENCODER)
    (encoder / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(UserError, match="cannot be read"):
        push(encoder, ENCODER)
    shard = next(data.glob("*.hdf5"))
    whole = shard.read_bytes()
    shard.write_bytes(whole[:-99])
    with pytest.raises(UserError, match=r"\.hdf5"):
        push(data, SET)
    shard.write_bytes(whole)
    assert not hub.requests


def test_a_repository_of_something_else_is_neither_written_nor_read(hub, encoder, tmp_path):
    repo = hub.repos[WHERE[ENCODER]] = Repo()
    repo.commit("main", {"pytorch_model.bin": b"pickle", "README.md": b""})
    with pytest.raises(UserError, match=r"lab/encoder: holds files that were not pushed by vd4rl-pomdp; choose"):
        push(encoder, ENCODER)
    with pytest.raises(UserError, match=r"lab/encoder: holds nothing that `vd4rl-pomdp hub push` wrote"):
        pull(ENCODER, tmp_path / "new")
    with pytest.raises(UserError, match=r"holds files that were not pushed"):
        push(encoder, ENCODER, revision="v1")
    assert set(hub.files(WHERE[ENCODER])) == {"pytorch_model.bin", "README.md"}
    assert set(repo.branches) == {"main"}
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "listing",
    [
        b"{",
        b"[]",
        b"{}",
        b'{"format": 2, "kind": "an encoder", "sha256": {"config.json": "", "model.safetensors": ""}}',
        b'{"format": 1, "kind": "a data set", "sha256": {}}',
        b'{"format": 1, "kind": "an encoder", "sha256": {"config.json": ""}}',
        b'{"format": 1, "kind": "an encoder", "sha256": {"config.json": "", "model.safetensors": ""}, "license": 1}',
        b'{"format": 1, "kind": "an encoder", "sha256": {"config.json": 1, "model.safetensors": ""}}',
        b'{"format": 1, "kind": "an encoder", "sha256": {"config.json": "", "model.safetensors": "", "../x.md": ""}}',
    ],
)
def test_a_listing_of_another_kind_or_with_other_files_is_refused(hub, encoder, tmp_path, listing):
    push(encoder, ENCODER)
    hub.repos[WHERE[ENCODER]].commit("main", hub.files(WHERE[ENCODER]) | {LISTING: listing})
    with pytest.raises(UserError, match=r"lab/encoder: its vd4rl_pomdp\.json is of another version or damaged"):
        pull(ENCODER, tmp_path / "new")
    assert lists(tmp_path) == ["run"]


@pytest.mark.parametrize(
    "name", ["../out.hdf5", "/out.hdf5", ".hidden.hdf5", "a/b.hdf5", "run.py", "README.md", "x.pkl"]
)
def test_a_set_brings_shards_cards_and_records_only(hub, data, tmp_path, name):
    push(data, SET)
    listing = json.loads(hub.files(WHERE[SET])[LISTING])
    listing["sha256"][name] = "0"
    hub.repos[WHERE[SET]].commit("main", hub.files(WHERE[SET]) | {LISTING: json.dumps(listing).encode(), name: b""})
    with pytest.raises(UserError, match=r"of another version or damaged"):
        pull(SET, tmp_path / "new")


def test_damage_is_found_and_only_what_was_damaged_is_fetched_again(hub, encoder, tmp_path):
    push(encoder, ENCODER)
    hub.damaged.add("model.safetensors")
    with pytest.raises(UserError, match=r"lab/encoder: model\.safetensors has a wrong SHA-256 and was removed; pull"):
        pull(ENCODER, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    hub.damaged.clear()
    hub.requests.clear()
    pull(ENCODER, tmp_path / "new")
    gets = [request for request in hub.requests if request.startswith("GET") and "/resolve/" in request]
    assert not any("config.json" in request for request in gets)
    assert content(tmp_path / "new") == content(encoder)
    assert lists(tmp_path) == ["new", "run"]


def test_a_cut_transfer_is_resumed(hub, encoder, tmp_path, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "DOWNLOAD_CHUNK_SIZE", 1000)
    push(encoder, ENCODER)
    hub.cut["model.safetensors"] = 1
    pull(ENCODER, tmp_path / "new")
    assert hub.ranges == ["model.safetensors"]
    assert content(tmp_path / "new") == content(encoder)


def test_a_set_of_no_shards_is_none(hub, data, tmp_path):
    push(data, SET)
    listing = {"format": 1, "kind": "a data set", "sha256": {}}
    hub.repos[WHERE[SET]].commit("main", hub.files(WHERE[SET]) | {LISTING: json.dumps(listing).encode()})
    with pytest.raises(UserError, match=r"of another version or damaged"):
        pull(SET, tmp_path / "new")


def test_a_cut_pull_of_another_set_leaves_nothing_in_this_one(hub, data, tmp_path):
    other = Repository.named("datasets/lab/other")
    push(write_fake_set(tmp_path / "own" / "walker_walk" / "medium", [20, 25]), other)
    hub.damaged.add("card.md")
    push(data, SET)
    with pytest.raises(UserError, match=r"card\.md has a wrong SHA-256"):
        pull(SET, tmp_path / "new")
    pull(other, tmp_path / "new")
    assert content(tmp_path / "new") == content(tmp_path / "own" / "walker_walk" / "medium")


@pytest.mark.parametrize("what", ["a file", "a folder", "an encoder", "a run", "a link"])
def test_nothing_foreign_is_written_over(hub, encoder, tmp_path, what):
    push(encoder, ENCODER)
    target = tmp_path / "there"
    if what == "a file":
        target.write_text("mine")
    elif what == "a folder":
        target.mkdir()
        (target / ".env").write_text("mine")
    elif what == "a link":
        target.symlink_to(tmp_path / "nowhere")
    elif what == "an encoder":
        save_encoder(target, make("gru", True), replace(CARD, seed=7))
    else:
        target = encoder.parent
        (target / "config.json").write_text('{"stage": "pretrain"}')
    before = content(tmp_path)
    with pytest.raises(
        UserError, match="is not empty and holds something else than lab/encoder; choose another folder"
    ):
        pull(ENCODER, target)
    if what == "a run":
        with pytest.raises(UserError, match=r"lies inside .* which holds a run"):
            pull(ENCODER, target / "more")
    assert content(tmp_path) == before


def test_a_set_with_a_shard_more_is_another_set(hub, data, tmp_path):
    push(data, SET)
    pull(SET, tmp_path / "new")
    (tmp_path / "new" / "9_more.hdf5").write_bytes(b"mine")
    with pytest.raises(UserError, match="is not empty and holds something else than datasets/lab/set"):
        pull(SET, tmp_path / "new")


def test_an_empty_folder_takes_what_is_pulled(hub, encoder, tmp_path):
    push(encoder, ENCODER)
    (tmp_path / "empty").mkdir()
    assert pull(ENCODER, tmp_path / "empty")
    assert content(tmp_path / "empty") == content(encoder)


@pytest.mark.parametrize(
    ("path", "status", "message"),
    [
        ("/api/models", 500, "the Hub answers with status 500, refused; try again later"),
        ("/preupload/", 429, "the Hub answers with status 429, refused; try again later"),
        ("/large/", 503, "the Hub answers with status 503, refused; try again later"),
        ("/commit/", 403, r"your token may not do this \(status 403\)"),
    ],
)
def test_what_fails_in_a_push_is_one_sentence_and_leaves_no_half(hub, encoder, monkeypatch, path, status, message):
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)
    push(encoder, ENCODER)
    hub.large.clear()
    save_encoder(encoder, make("gru", True), replace(CARD, seed=1))
    before = hub.files(WHERE[ENCODER])
    hub.status = {path: status}
    with pytest.raises(UserError, match=f"lab/encoder: {message}"):
        push(encoder, ENCODER)
    assert hub.files(WHERE[ENCODER]) == before


@pytest.mark.parametrize("path", ["/repos/create", "/preupload/", "/objects/batch", "/commit/"])
def test_a_hub_that_falls_silent_in_a_push_is_not_waited_for_for_ever(hub, encoder, monkeypatch, path):
    monkeypatch.setattr("vd4rl_pomdp.hub.repository._SILENCE_S", 0.2)
    hub.silent = path
    with pytest.raises(UserError, match=r"does not answer as the Hub does \(ReadTimeout\); check the network"):
        push(encoder, ENCODER)


def test_a_card_that_the_hub_refuses_is_told(hub, encoder):
    with pytest.raises(UserError, match=r'lab/encoder: the Hub does not take it \(.*"license" must be one of \[mit\]'):
        push(encoder, ENCODER, license="nobody's")
    assert LISTING not in hub.files(WHERE[ENCODER])


def test_a_gated_repository_is_told_apart(hub, encoder, tmp_path, monkeypatch):
    push(encoder, ENCODER)
    hub.gated.add(WHERE[ENCODER])
    monkeypatch.setenv("HF_TOKEN", "hf_other")
    for act in (lambda: pull(ENCODER, tmp_path / "new"), lambda: push(encoder, ENCODER)):
        with pytest.raises(UserError, match="lab/encoder: is open to those whom its owner lets in; ask there"):
            act()


@pytest.mark.parametrize(
    ("endpoint", "message"),
    [
        (
            "http://127.0.0.1:9",
            r"http://127\.0\.0\.1:9 does not answer as the Hub does \(ConnectError\); check the net",
        ),
        ("huggingface.co", "HF_ENDPOINT 'huggingface.co' is no address; it starts with https:// or http://"),
        ("http://[", r"HF_ENDPOINT 'http://\[' is no address"),
    ],
)
def test_where_nobody_is_nothing_is_left(encoder, tmp_path, monkeypatch, endpoint, message):
    monkeypatch.setenv("HF_ENDPOINT", endpoint)
    monkeypatch.setenv("NO_PROXY", "*")
    for act in (lambda: pull(ENCODER, tmp_path / "new"), lambda: push(encoder, ENCODER)):
        with pytest.raises(UserError, match=message):
            act()
    assert lists(tmp_path) == ["run"]


def test_huggingface_hubs_own_switch_for_no_network_is_obeyed(encoder, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(UserError, match="HF_HUB_OFFLINE is set, so that nothing is sent or fetched; unset it"):
        push(encoder, ENCODER)


def test_the_commands_of_the_program(hub, encoder, tmp_path, capsys):
    main(["hub", "push", str(encoder), "lab/encoder", "--private", "--revision", "v1"])
    assert "/models/lab/encoder/commit/" in capsys.readouterr().out
    new = str(tmp_path / "new")
    for told in ("fetched and checked", "is there already, and right"):
        main(["hub", "pull", "lab/encoder", new, "--revision", "v1"])
        assert tuple(capsys.readouterr()) == (f"{new}: {told}\n", "")
    with pytest.raises(SystemExit) as ended:
        main(["hub", "pull", "lab/nothing", new])
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith("error: lab/nothing: no such repository, or your token gives no access")

import hashlib
import os
import re
import threading
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.helpers_data import write_fake_set
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data import download as module
from vd4rl_pomdp.data import manifest as listed
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.card import write_card
from vd4rl_pomdp.data.download import RemoteFile, download, manifest
from vd4rl_pomdp.data.format import shard_paths
from vd4rl_pomdp.hub import push

CONTENT = {"0_a_expert.hdf5": bytes(range(256)) * 40, "1_a_expert.hdf5": b"second" * 999, "0_a_medium.hdf5": b"m" * 500}
EXPERT = "walker_walk/expert/84px"
BOTH = "walker_walk/medium_expert/84px"
PREFIX = "/datasets/conglu/vd4rl/resolve/main/vd4rl/main/"


class Mirror:
    """A mirror on this machine with the faults that a test asks for."""

    def __init__(self):
        self.files = {
            f"{folder}/{name}": CONTENT[name]
            for folder, names in {EXPERT: list(CONTENT)[:2], BOTH: list(CONTENT)}.items()
            for name in names
        }
        self.manifest = tuple(
            RemoteFile(f"vd4rl/main/{path}", len(content), hashlib.sha256(content).hexdigest())
            for path, content in self.files.items()
        )
        self.requests = []
        """(path, Range header or None) of every request."""
        self.tokens = []
        """Authorization header or None, likewise."""
        self.ranges = True
        self.cuts = Counter()
        """How often a path's answer breaks off after 1000 bytes."""
        self.status = []
        """Statuses of the next answers that fail."""

    def answer(self, handler):
        path, wanted = handler.path.removeprefix(PREFIX), handler.headers["Range"]
        self.requests.append((path, wanted))
        self.tokens.append(handler.headers["Authorization"])
        if self.status or path not in self.files:
            return handler.send_error(self.status.pop(0) if self.status else 404)
        body = self.files[path]
        offset = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1]) if wanted and self.ranges else 0
        handler.send_response(206 if offset else 200)
        if offset:
            handler.send_header("Content-Range", f"bytes {offset}-{len(body) - 1}/{len(body)}")
        handler.send_header("Content-Length", str(len(body) - offset))
        handler.end_headers()
        cut = self.cuts[path] > 0
        self.cuts[path] -= cut
        handler.wfile.write(body[offset : offset + 1000] if cut else body[offset:])
        return None


@pytest.fixture
def mirror(monkeypatch):
    mirror = Mirror()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            mirror.answer(self)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    mirror.endpoint = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    for where in (module, listed):
        monkeypatch.setattr(where, "manifest", lambda: mirror.manifest)
    monkeypatch.setattr(module, "_FIRST_WAIT_S", 0.001)
    monkeypatch.setattr(module, "_BLOCK", 500)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    yield mirror
    server.shutdown()
    server.server_close()


def fetch(mirror, destination, quality="expert", **options):
    return download("walker_walk", quality, destination, endpoint=mirror.endpoint, **options)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_the_manifest_lists_the_published_sets():
    listed = manifest()
    assert len(listed) == 86
    assert len({file.sha256 for file in listed}) == 62
    assert sum({file.sha256: file.size for file in listed}.values()) == pytest.approx(10.5e9, rel=0.01)
    sets = {tuple(file.path.split("/")[2:4]) for file in listed}
    assert len(sets) == 15


def test_a_set_arrives_whole_and_is_not_fetched_twice(mirror, tmp_path):
    shards = fetch(mirror, tmp_path)
    assert [shard.relative_to(tmp_path).as_posix() for shard in shards] == list(mirror.files)[:2]
    assert [shard.read_bytes() for shard in shards] == list(CONTENT.values())[:2]
    assert names(tmp_path / EXPERT) == ["0_a_expert.hdf5", "1_a_expert.hdf5"]
    mirror.requests.clear()
    assert fetch(mirror, tmp_path) == shards
    assert mirror.requests == []


def test_a_cut_connection_is_resumed(mirror, tmp_path):
    path = f"{EXPERT}/0_a_expert.hdf5"
    mirror.cuts[path] = 2
    fetch(mirror, tmp_path)
    assert [r for p, r in mirror.requests if p == path] == [None, "bytes=1000-", "bytes=2000-"]
    assert (tmp_path / path).read_bytes() == CONTENT["0_a_expert.hdf5"]


def test_a_set_of_which_files_are_missing_is_not_taken_for_whole(mirror, tmp_path):
    missing = f"{EXPERT}/1_a_expert.hdf5"
    body = mirror.files.pop(missing)
    with pytest.raises(UserError, match="404"):
        fetch(mirror, tmp_path)
    with pytest.raises(UserError, match=r"1_a_expert\.hdf5\.part: the set's download is not finished"):
        shard_paths(tmp_path / EXPERT)
    mirror.files[missing] = body
    assert fetch(mirror, tmp_path) == shard_paths(tmp_path / EXPERT)


def test_a_partial_file_of_an_earlier_run_is_continued(mirror, tmp_path):
    path = f"{EXPERT}/0_a_expert.hdf5"
    (tmp_path / EXPERT).mkdir(parents=True)
    (tmp_path / f"{path}.part").write_bytes(CONTENT["0_a_expert.hdf5"][:77])
    fetch(mirror, tmp_path)
    assert mirror.requests[0] == (path, "bytes=77-")
    assert (tmp_path / path).read_bytes() == CONTENT["0_a_expert.hdf5"]


def test_a_part_that_was_left_beside_a_file_blocks_no_set(mirror, tmp_path):
    shards = fetch(mirror, tmp_path)
    for content in (CONTENT["0_a_expert.hdf5"], b"?" * len(CONTENT["0_a_expert.hdf5"])):  # whole, and another's
        shards[0].write_bytes(content)
        (tmp_path / f"{EXPERT}/0_a_expert.hdf5.part").write_bytes(b"")
        assert fetch(mirror, tmp_path) == shards == shard_paths(tmp_path / EXPERT)
        assert shards[0].read_bytes() == CONTENT["0_a_expert.hdf5"]


def test_a_damaged_file_of_another_set_is_not_linked(mirror, tmp_path):
    damaged = fetch(mirror, tmp_path)[0]
    damaged.write_bytes(b"?" * damaged.stat().st_size)
    shards = fetch(mirror, tmp_path, "medium_expert")
    assert {shard.name: shard.read_bytes() for shard in shards} == CONTENT


def test_a_server_without_ranges_starts_over(mirror, tmp_path):
    path = f"{EXPERT}/0_a_expert.hdf5"
    mirror.ranges, mirror.cuts[path] = False, 2
    fetch(mirror, tmp_path)
    assert [r for p, r in mirror.requests if p == path] == [None, "bytes=1000-", "bytes=1000-"]
    assert (tmp_path / path).read_bytes() == CONTENT["0_a_expert.hdf5"]


def test_passing_failures_of_the_server_are_survived(mirror, tmp_path):
    mirror.status = [503, 429, 500]
    assert len(fetch(mirror, tmp_path)) == 2


def test_a_wrong_hash_removes_the_file(mirror, tmp_path):
    path = f"{EXPERT}/1_a_expert.hdf5"
    mirror.files[path] = b"SECOND" * 999
    with pytest.raises(UserError, match=r"1_a_expert\.hdf5: has a wrong SHA-256 and was removed"):
        fetch(mirror, tmp_path)
    assert names(tmp_path / EXPERT) == ["0_a_expert.hdf5"]


def test_huggingface_hubs_endpoint_and_token_are_used_and_the_token_goes_nowhere_else(mirror, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_mine")
    monkeypatch.setenv("HF_ENDPOINT", mirror.endpoint)
    download("walker_walk", "expert", tmp_path / "a")
    monkeypatch.setenv("HF_ENDPOINT", f"{mirror.endpoint}0")
    fetch(mirror, tmp_path / "b")
    assert mirror.tokens == ["Bearer hf_mine"] * 2 + [None] * 2
    assert (tmp_path / "a" / EXPERT / "0_a_expert.hdf5").read_bytes() == CONTENT["0_a_expert.hdf5"]


def test_a_set_has_one_owner_while_it_is_downloaded(mirror, tmp_path, monkeypatch):
    receive, refused = module._receive, []

    def meanwhile(*arguments):
        with pytest.raises(UserError, match=rf"84px: is in use by process {os.getpid()} on"):
            fetch(mirror, tmp_path)
        assert "1_a_expert.hdf5.part" in names(tmp_path / EXPERT), "it still says that the set is not whole"
        refused.append(1)
        return receive(*arguments)

    monkeypatch.setattr(module, "_receive", meanwhile)
    fetch(mirror, tmp_path)
    assert len(refused) == 2
    assert names(tmp_path / EXPERT) == ["0_a_expert.hdf5", "1_a_expert.hdf5"]


def test_a_set_that_is_there_needs_no_folder_that_may_be_written(mirror, tmp_path, monkeypatch):
    shards = fetch(mirror, tmp_path)
    monkeypatch.setattr(module, "owned", lambda folder: pytest.fail("owned"))
    assert fetch(mirror, tmp_path) == shards


def test_equal_files_are_fetched_and_stored_once(mirror, tmp_path):
    expert = fetch(mirror, tmp_path)
    mirror.requests.clear()
    both = fetch(mirror, tmp_path, "medium_expert")
    assert [path for path, _ in mirror.requests] == [f"{BOTH}/0_a_medium.hdf5"]
    assert [shard.read_bytes() for shard in both] == list(CONTENT.values())
    assert both[0].samefile(expert[0])


@pytest.mark.parametrize("broken", [["link"], ["link", "symlink"]])
def test_where_links_do_not_work_the_next_best_is_used(mirror, tmp_path, monkeypatch, broken):
    def refuse(*_, **__):
        raise OSError("links are not supported here")

    expert = fetch(mirror, tmp_path)
    for name in broken:
        monkeypatch.setattr(module.os, name, refuse)
    both = fetch(mirror, tmp_path, "medium_expert")
    assert both[0].read_bytes() == expert[0].read_bytes()
    assert both[0].is_symlink() == (broken == ["link"])
    assert both[0].samefile(expert[0]) == (broken == ["link"])


def test_damage_is_found_by_size_and_on_request_by_hash(mirror, tmp_path):
    first, second = fetch(mirror, tmp_path)
    first.write_bytes(b"short")
    second.write_bytes(b"SECOND" * 999)
    fetch(mirror, tmp_path)
    assert (first.read_bytes(), second.read_bytes()) == (CONTENT["0_a_expert.hdf5"], b"SECOND" * 999)
    fetch(mirror, tmp_path, verify=True)
    assert second.read_bytes() == CONTENT["1_a_expert.hdf5"]


def test_a_dead_mirror_is_told_with_advice(mirror, tmp_path):
    mirror.status = [503] * 5
    with pytest.raises(UserError, match=r"cannot be fetched \(status 503\); check the network .*--endpoint"):
        fetch(mirror, tmp_path)
    assert len(mirror.requests) == 5


@pytest.mark.parametrize("endpoint", ["http://127.0.0.1:9", "https://nobody.invalid"])
def test_where_nobody_is_nothing_is_waited_for(tmp_path, monkeypatch, endpoint):
    monkeypatch.setattr(module.time, "sleep", lambda _: pytest.fail("waited"))
    monkeypatch.setenv("NO_PROXY", "*")
    with pytest.raises(UserError, match=r"cannot be fetched .*choose another --endpoint"):
        download("walker_walk", "expert", tmp_path, endpoint=endpoint)
    assert names(tmp_path) == []


def test_where_the_mirror_has_answered_its_absence_is_waited_out(mirror, tmp_path, monkeypatch):
    path = f"{EXPERT}/0_a_expert.hdf5"
    mirror.cuts[path] = 1
    receive, calls = module._receive, []

    def unplugged(url, part, offset):
        calls.append(offset)
        yield from receive("http://127.0.0.1:9/x" if len(calls) in (2, 3) else url, part, offset)

    monkeypatch.setattr(module, "_receive", unplugged)
    fetch(mirror, tmp_path)
    assert calls[:4] == [0, 1000, 1000, 1000]


def test_a_missing_file_is_told_at_once(mirror, tmp_path):
    mirror.files.clear()
    with pytest.raises(UserError, match=r"the mirror answers 404 .*--endpoint"):
        fetch(mirror, tmp_path)
    assert len(mirror.requests) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("walker_run", "expert"), "unknown task of published sets 'walker_run': choose one of cheetah_run"),
        (("walker_walk", "best"), "unknown quality 'best': choose one of random"),
        (("walker_walk", "expert", "hf.co"), "endpoint 'hf.co' is no address"),
        (("walker_walk", "expert", "http://"), "endpoint 'http://' is no address"),
        (("walker_walk", "expert", "http://["), r"endpoint 'http://\[' is no address"),
    ],
)
def test_what_is_not_published_is_refused(tmp_path, arguments, message):
    task, quality, *endpoint = arguments
    with pytest.raises(UserError, match=message):
        download(task, quality, tmp_path, *endpoint)
    assert names(tmp_path) == []


def part_of_a_set(mirror, tmp_path, names, folder=EXPERT):
    """Some of a set's files, of their published sizes and no shards inside."""
    place = tmp_path / folder
    place.mkdir(parents=True)
    for name in names:
        (place / name).write_bytes(mirror.files.get(f"{folder}/{name}", CONTENT[name]))
    return place


@pytest.mark.parametrize(
    ("folder", "names", "task", "told"),
    [
        (EXPERT, ["0_a_expert.hdf5"], "walker_walk expert", "1_a_expert.hdf5 is missing"),
        (BOTH, list(CONTENT)[:2], "walker_walk medium_expert", "0_a_medium.hdf5 is missing"),
        ("mine", ["0_a_expert.hdf5"], "walker_walk expert", "1_a_expert.hdf5 is missing"),
        ("mine", ["0_a_expert.hdf5", "0_a_medium.hdf5"], "walker_walk medium_expert", "1_a_expert.hdf5 is missing"),
    ],
)
def test_a_part_of_a_published_set_is_told_with_what_gets_the_rest(mirror, tmp_path, folder, names, task, told):
    place = part_of_a_set(mirror, tmp_path, names, folder)
    words = "--task {} --quality {}".format(*task.split())
    out = "DIR" if folder == "mine" else tmp_path
    with pytest.raises(
        UserError, match=re.escape(f"{place}: is a part of V-D4RL's {task} ({told}); get the rest")
    ) as e:
        open_dataset(place)
    assert f"`vd4rl-pomdp data download {words} --out {out}`" in str(e.value)


def test_a_part_of_a_published_set_gets_no_card_and_is_not_pushed(mirror, tmp_path):
    place = part_of_a_set(mirror, tmp_path, ["0_a_expert.hdf5"])
    for tell in (write_card, lambda folder: push(folder, "datasets/lab/set")):
        with pytest.raises(UserError, match="is a part of V-D4RL's walker_walk expert"):
            tell(place)


def test_a_shard_of_another_size_than_the_others_of_a_published_set_is_told(mirror, tmp_path):
    place = part_of_a_set(mirror, tmp_path, list(CONTENT)[:2])
    (place / "1_a_expert.hdf5").write_bytes(b"cut")
    with pytest.raises(UserError, match=rf"\(1_a_expert.hdf5 has 3 bytes, not {6 * 999}\); get the rest with"):
        open_dataset(place)
    download("walker_walk", "expert", tmp_path, mirror.endpoint)
    with pytest.raises(UserError, match=r"0_a_expert.hdf5: is truncated, damaged or no HDF5 file"):  # as these are
        open_dataset(place)


@pytest.mark.usefixtures("mirror", "own_cache")
def test_a_set_of_ones_own_is_opened_unless_it_is_named_as_a_part_of_a_published_one(tmp_path):
    names = ["0_a_expert.hdf5", "1_a_expert.hdf5"]
    told = {"task": "walker_walk", "set": "expert"}
    write_fake_set(tmp_path / "a" / EXPERT, (5, 5), cuts=(5,), names=names)
    write_fake_set(tmp_path / "b" / EXPERT, names=names[:1], attributes=told)
    write_fake_set(tmp_path / "c" / "mine", names=names[:1])
    write_fake_set(tmp_path / "d" / EXPERT)
    write_fake_set(tmp_path / "e" / EXPERT, (5, 5), cuts=(5,), names=[names[0], "0_mine.hdf5"])
    for folder in (f"a/{EXPERT}", f"b/{EXPERT}", "c/mine", f"d/{EXPERT}", f"e/{EXPERT}"):
        assert open_dataset(tmp_path / folder).num_episodes == 2
    assert open_dataset(tmp_path / "c" / "mine" / names[0]).num_episodes == 2
    with pytest.raises(UserError, match=r"walker_walk expert \(1_a_expert.hdf5 is missing\); get the rest"):
        open_dataset(write_fake_set(tmp_path / EXPERT, names=names[:1]))

"""A local Hugging Face Hub with the endpoints that huggingface_hub uses for repositories, commits and large files."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections import Counter
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

TOKEN = "hf_writer"
LARGE = (".safetensors", ".hdf5", ".png")
"""Suffixes stored as large files."""


def git_oid(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@dataclass
class Repo:
    private: bool = False
    branches: dict[str, list[str]] = field(default_factory=lambda: {"main": []})
    """Commits by branch, oldest first."""
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    """Files by commit."""

    def commit(self, branch: str, files: dict[str, bytes]) -> str:
        content = [branch, len(self.commits), sorted(files)]
        name = hashlib.sha1(json.dumps(content).encode()).hexdigest()
        self.commits[name] = files
        self.branches[branch].append(name)
        return name

    def at(self, revision: str) -> str | None:
        found = self.branches.get(revision)
        return found[-1] if found else revision if revision in self.commits else None


class RefusedError(Exception):
    def __init__(self, status: int, code: str = "", message: str = "refused") -> None:
        super().__init__(message)
        self.status, self.code, self.message = status, code, message


class Hub:
    """Repositories, and faults requested by a test."""

    def __init__(self) -> None:
        self.repos: dict[str, Repo] = {}
        """By `models/OWNER/NAME` and `datasets/OWNER/NAME`."""
        self.large: dict[str, bytes] = {}
        self.requests: Counter[str] = Counter()
        """Counts by method and path."""
        self.cut: Counter[str] = Counter()
        """Number of responses to cut in the middle, by file."""
        self.damaged: set[str] = set()
        """Files sent with a wrong byte."""
        self.status: dict[str, int] = {}
        """Error statuses by a part of the request's path."""

    def files(self, repo: str, revision: str = "main") -> dict[str, bytes]:
        found = self.repos[repo]
        return found.commits[found.at(revision) or ""]

    def serve(self) -> ThreadingHTTPServer:
        server = ThreadingHTTPServer(("127.0.0.1", 0), type("Bound", (_Handler,), {"hub": self}))
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        return server


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        pass

    def _answer(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"] or 0))
        path = unquote(urlsplit(self.path).path)
        self.hub.requests[f"{self.command} {path}"] += 1
        try:
            for part, status in self.hub.status.items():
                if part in path:
                    raise RefusedError(status)
            self._route(path, body)
        except RefusedError as error:
            headers = {"X-Error-Message": error.message} | ({"X-Error-Code": error.code} if error.code else {})
            self._send(error.status, json.dumps({"error": error.message}).encode(), headers)

    do_GET = do_HEAD = do_POST = do_PUT = _answer

    def _route(self, path: str, body: bytes) -> None:
        for pattern, handle in _ROUTES:
            if found := re.fullmatch(pattern, path):
                return handle(self, *found.groups(), body=body)
        raise RefusedError(404, "", f"no such address: {path}")

    def _send(self, status: int, body: bytes = b"", headers: dict[str, str] | None = None, cut: bool = False) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body[: len(body) // 2] if cut else body)
        if cut:
            self.close_connection = True

    def _json(self, payload: Any) -> None:
        self._send(200, json.dumps(payload).encode(), {"Content-Type": "application/json"})

    @property
    def _writes(self) -> bool:
        return self.headers["Authorization"] == f"Bearer {TOKEN}"

    def _repo(self, name: str, write: bool = False) -> Repo:
        repo = self.hub.repos.get(name)
        if repo is None or (repo.private and not self._writes):
            raise RefusedError(404, "RepoNotFound", "Repository not found")
        if write and not self._writes:
            raise RefusedError(403, "", "Forbidden: no write access")
        return repo

    def create(self, body: bytes) -> None:
        asked = json.loads(body)
        if not self._writes:
            raise RefusedError(401, "", "Invalid username or password.")
        name = f"{asked.get('type', 'model')}s/{asked['organization']}/{asked['name']}"
        host, there = f"http://{self.headers['Host']}/", name in self.hub.repos
        if not there:
            repo = self.hub.repos[name] = Repo(asked.get("visibility") == "private")
            repo.commit("main", {".gitattributes": b"*.hdf5 filter=lfs\n"})
        payload = {"url": host + name.removeprefix("models/"), "id": name.partition("/")[2]}
        self._send(409 if there else 200, json.dumps(payload).encode(), {"Content-Type": "application/json"})

    def info(self, kind: str, name: str, revision: str | None, body: bytes) -> None:
        repo = self._repo(f"{kind}/{name}")
        commit = repo.at(revision or "main")
        if commit is None:
            raise RefusedError(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        names = [{"rfilename": path} for path in repo.commits[commit]]
        self._json({"id": name, "sha": commit, "private": repo.private, "siblings": names, "tags": []})

    def tree(self, kind: str, name: str, revision: str, body: bytes) -> None:
        repo = self._repo(f"{kind}/{name}")
        files = repo.commits.get(repo.at(revision) or "", {})
        self._json([{"type": "file", "path": p, "size": len(c), "oid": git_oid(c)} for p, c in files.items()])

    def branch(self, kind: str, name: str, branch: str, body: bytes) -> None:
        repo = self._repo(f"{kind}/{name}", write=True)
        if branch in repo.branches:
            raise RefusedError(409, "", "Reference already exists")
        repo.branches[branch] = repo.branches["main"][:]
        self._json({})

    def preupload(self, kind: str, name: str, revision: str, body: bytes) -> None:
        self._repo(f"{kind}/{name}", write=True)
        asked = [file["path"] for file in json.loads(body)["files"]]
        modes = [{"path": p, "uploadMode": "lfs" if p.endswith(LARGE) else "regular"} for p in asked]
        self._json({"files": [mode | {"shouldIgnore": False} for mode in modes]})

    def batch(self, name: str, body: bytes) -> None:
        self._repo(name if name.startswith("datasets/") else f"models/{name}", write=True)
        host, objects = f"http://{self.headers['Host']}", []
        for one in json.loads(body)["objects"]:
            if one["oid"] in self.hub.large:
                objects.append(one)
            else:
                objects.append(one | {"actions": {"upload": {"href": f"{host}/large/{one['oid']}"}}})
        self._json({"transfer": "basic", "objects": objects})

    def store(self, oid: str, body: bytes) -> None:
        if hashlib.sha256(body).hexdigest() != oid:
            raise RefusedError(400, "", "content does not match its name")
        self.hub.large[oid] = body
        self._send(200)

    def commit(self, kind: str, name: str, revision: str, body: bytes) -> None:
        repo = self._repo(f"{kind}/{name}", write=True)
        parent = repo.at(revision)
        files = dict(repo.commits[parent]) if parent else {}
        for line in body.decode().splitlines():
            entry = json.loads(line)
            value = entry["value"]
            if entry["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                files[value["path"]] = self.hub.large[value["oid"]]
            elif entry["key"] == "deletedFile":
                del files[value["path"]]
        oid = repo.commit(revision, files)
        address = f"http://{self.headers['Host']}/{kind}/{name}/commit/{oid}"
        self._json({"success": True, "commitOid": oid, "commitUrl": address})

    def yaml(self, body: bytes) -> None:
        self._json({"errors": [], "warnings": []})

    def file(self, name: str, revision: str, path: str, body: bytes) -> None:
        repo = self._repo(name if name.startswith("datasets/") else f"models/{name}")
        commit = repo.at(revision)
        if commit is None:
            raise RefusedError(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        content = repo.commits[commit].get(path)
        if content is None:
            raise RefusedError(404, "EntryNotFound", "Entry not found")
        digest = hashlib.sha256(content).hexdigest()
        headers = {"X-Repo-Commit": commit, "ETag": f'"{digest}"', "Accept-Ranges": "bytes"}
        if path in self.hub.damaged:
            content = bytes([content[0] ^ 1]) + content[1:]
        if wanted := re.fullmatch(r"bytes=(\d+)-", self.headers["Range"] or ""):
            start = int(wanted[1])
            headers["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
            return self._send(206, content[start:], headers)
        cut = self.command == "GET" and self.hub.cut[path] > 0
        self.hub.cut[path] -= cut
        return self._send(200, content, headers, cut)


_REPO = r"((?:datasets/)?[^/]+/[^/]+)"
_ROUTES = [
    (r"/api/repos/create", _Handler.create),
    (r"/api/validate-yaml", _Handler.yaml),
    (r"/api/(models|datasets)/([^/]+/[^/]+)(?:/revision/(.+))?", _Handler.info),
    (r"/api/(models|datasets)/([^/]+/[^/]+)/branch/(.+)", _Handler.branch),
    (r"/api/(models|datasets)/([^/]+/[^/]+)/tree/(.+)", _Handler.tree),
    (r"/api/(models|datasets)/([^/]+/[^/]+)/preupload/(.+)", _Handler.preupload),
    (r"/api/(models|datasets)/([^/]+/[^/]+)/commit/(.+)", _Handler.commit),
    (rf"/{_REPO}\.git/info/lfs/objects/batch", _Handler.batch),
    (r"/large/(.+)", _Handler.store),
    (rf"/{_REPO}/resolve/([^/]+)/(.+)", _Handler.file),
]

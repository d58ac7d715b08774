"""A small Hugging Face hub on the loopback, kept in memory: what the real client asks of one."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import httpx
import pytest
import yaml
from huggingface_hub import constants, set_client_factory
from huggingface_hub.utils._http import default_client_factory

WRITE_TOKEN = "hf_may_write"
READ_TOKEN = "hf_may_read"
LFS_SUFFIXES = (".mp4", ".parquet", ".png", ".safetensors")
BRANCH = "main"
POLL_SECONDS = 0.02

Files = dict[str, bytes]
Json = dict[str, Any]


class Refused(Exception):
    """An answer that is an error, with the code by which the client tells them apart."""

    def __init__(self, status: int, message: str, code: str = "") -> None:
        super().__init__(message)
        self.status, self.code = status, code


@dataclass
class Repo:
    """A repository: its commits by hash, each with all its files, and the branch and tags that name them."""

    private: bool
    commits: dict[str, Files] = field(default_factory=dict)
    refs: dict[str, str] = field(default_factory=dict)

    def commit(self, files: Files) -> str:
        """Put `files` at the head of the branch. → commit hash"""
        sha = hashlib.sha1(f"commit {len(self.commits)}".encode()).hexdigest()
        self.commits[sha], self.refs[BRANCH] = files, sha
        return sha

    def resolve(self, revision: str) -> tuple[str, Files]:
        """A branch, tag or commit hash → (commit hash, files)."""
        sha = self.refs.get(revision, revision)
        if sha not in self.commits:
            raise Refused(404, f"no revision {revision}", "RevisionNotFound")
        return sha, self.commits[sha]

    @property
    def head(self) -> Files:
        """Path → content of everything on the branch."""
        return self.commits[self.refs[BRANCH]]


@dataclass
class Hub:
    """Repositories by (kind, name), large files by hash, and the requests so far by method and path."""

    repos: dict[tuple[str, str], Repo] = field(default_factory=dict)
    large: dict[str, bytes] = field(default_factory=dict)
    requests: list[tuple[str, str]] = field(default_factory=list)
    url: str = ""

    def dataset(self, name: str) -> Repo:
        """The dataset called user/name."""
        return self.repos["datasets", name]

    def page(self, kind: str, name: str) -> str:
        """Where people find the repository."""
        return f"{self.url}/{name}" if kind == "models" else f"{self.url}/{kind}/{name}"


def is_large(path: str) -> bool:
    return path.endswith(LFS_SUFFIXES)


def object_id(path: str, content: bytes) -> str:
    """What the hub calls a file's content: sha256 of a large one, else git's own hash."""
    if is_large(path):
        return hashlib.sha256(content).hexdigest()
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def describe_file(path: str, content: bytes) -> Json:
    """A file's entry in a listing."""
    entry = {"type": "file", "path": path, "size": len(content), "oid": object_id(path, content)}
    if is_large(path):
        entry["lfs"] = {"oid": entry["oid"], "size": len(content), "pointerSize": 130}
    return entry


def list_tree(files: Files, folder: str, recursive: bool) -> list[Json]:
    """The entries below `folder`, or directly in it."""
    prefix = f"{folder}/" if folder else ""
    below = {path: content for path, content in files.items() if path.startswith(prefix)}
    if folder and not below:
        raise Refused(404, f"no folder {folder}", "EntryNotFound")
    folders = {path[: match.start()] for path in below for match in re.finditer("/", path)}
    entries = [describe_file(path, content) for path, content in below.items()]
    entries += [
        {"type": "directory", "path": path, "oid": "0" * 40, "size": 0}
        for path in sorted(folders)
        if path.startswith(prefix)
    ]
    return [entry for entry in entries if recursive or "/" not in entry["path"].removeprefix(prefix)]


class Handler(BaseHTTPRequestHandler):
    """One request: find its route, check its token, answer in JSON or with a file."""

    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the hub keeps the requests."""

    def answer(self, status: int, content: bytes, **headers: str) -> None:
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(content))} | headers).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def serve(self) -> None:
        """Any method."""
        self.body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        parts = urlsplit(self.path)
        self.query = parse_qs(parts.query)
        self.hub.requests.append((self.command, parts.path))
        try:
            for methods, pattern, function in ROUTES:
                match = re.fullmatch(pattern, parts.path)
                if match and self.command in methods:
                    function(self, **{name: unquote(text or "") for name, text in match.groupdict().items()})
                    return
            raise Refused(404, f"{self.command} {self.path}: nothing there")
        except Refused as error:
            content = json.dumps({"error": str(error)}).encode()
            self.answer(error.status, content, X_Error_Code=error.code, X_Error_Message=str(error))

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = serve

    def json(self) -> Any:
        return json.loads(self.body)

    def answer_json(self, content: Any) -> None:
        self.answer(200, json.dumps(content).encode(), Content_Type="application/json")

    @property
    def token(self) -> str:
        return self.headers.get("Authorization", "").removeprefix("Bearer ")

    def require_writer(self) -> None:
        if self.token not in (WRITE_TOKEN, READ_TOKEN):
            raise Refused(401, "Invalid username or password.")
        if self.token == READ_TOKEN:
            raise Refused(403, "You don't have the rights to write here")

    def repo(self, kind: str, name: str) -> Repo:
        """The repository, if the token may see it."""
        repo = self.hub.repos.get((kind, name))
        if repo is None or (repo.private and self.token not in (WRITE_TOKEN, READ_TOKEN)):
            raise Refused(401 if repo else 404, f"no {kind} {name}", "RepoNotFound")
        return repo

    def create(self) -> None:
        self.require_writer()
        asked = self.json()
        kind, name = f"{asked.get('type', 'model')}s", f"{asked['organization']}/{asked['name']}"
        known = (kind, name) in self.hub.repos
        if not known:
            repo = self.hub.repos[kind, name] = Repo(private=asked.get("visibility") == "private")
            rules = "".join(f"*{suffix} filter=lfs diff=lfs merge=lfs -text\n" for suffix in LFS_SUFFIXES)
            repo.commit({".gitattributes": rules.encode()})
        content = json.dumps({"url": self.hub.page(kind, name)}).encode()
        self.answer(409 if known else 200, content)

    def validate_yaml(self) -> None:
        """The front matter of a README.md must be a mapping."""
        match = re.match(r"---\n(.*?)\n---\n", self.json()["content"], re.DOTALL)
        valid = match and isinstance(yaml.safe_load(match[1]), dict)
        errors = [] if valid else [{"message": "no front matter"}]
        self.answer(400 if errors else 200, json.dumps({"errors": errors, "warnings": []}).encode())

    def info(self, kind: str, name: str, revision: str = "") -> None:
        repo = self.repo(kind, name)
        sha, files = repo.resolve(revision or BRANCH)
        siblings = [{"rfilename": path} for path in files]
        self.answer_json({"id": name, "sha": sha, "private": repo.private, "tags": [], "siblings": siblings})

    def refs(self, kind: str, name: str) -> None:
        refs = self.repo(kind, name).refs
        tags = [
            {"name": tag, "ref": f"refs/tags/{tag}", "targetCommit": sha}
            for tag, sha in refs.items()
            if tag != BRANCH
        ]
        branch = {"name": BRANCH, "ref": f"refs/heads/{BRANCH}", "targetCommit": refs[BRANCH]}
        self.answer_json({"branches": [branch], "tags": tags, "converts": []})

    def tree(self, kind: str, name: str, revision: str, folder: str) -> None:
        _, files = self.repo(kind, name).resolve(revision)
        self.answer_json(list_tree(files, folder, self.query.get("recursive") == ["true"]))

    def tag(self, kind: str, name: str, revision: str) -> None:
        """POST names a revision; DELETE takes a name back."""
        self.require_writer()
        repo = self.repo(kind, name)
        sha, _ = repo.resolve(revision)
        if self.command == "DELETE":
            del repo.refs[revision]
        else:
            repo.refs[self.json()["tag"]] = sha
        self.answer_json({})

    def preupload(self, kind: str, name: str, revision: str) -> None:
        """How each file is to come, and what the branch holds under its name."""
        self.require_writer()
        _, files = self.repo(kind, name).resolve(revision)
        answers = []
        for path in (file["path"] for file in self.json()["files"]):
            present = object_id(path, files[path]) if path in files else None
            mode = "lfs" if is_large(path) else "regular"
            answers.append({"path": path, "uploadMode": mode, "shouldIgnore": False, "oid": present})
        self.answer_json({"files": answers})

    def lfs_batch(self, **_: str) -> None:
        """Where to put each large file that is not here yet."""
        self.require_writer()
        objects = [{"oid": asked["oid"], "size": asked["size"]} for asked in self.json()["objects"]]
        for item in objects:
            if item["oid"] not in self.hub.large:
                item["actions"] = {"upload": {"href": f"{self.hub.url}/large/{item['oid']}"}}
        self.answer_json({"transfer": "basic", "objects": objects})

    def upload(self, oid: str) -> None:
        """A large file. Its address is its permission, as with signed addresses."""
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise Refused(400, f"{oid}: its content is another")
        self.hub.large[oid] = self.body
        self.answer(200, b"")

    def commit(self, kind: str, name: str, revision: str) -> None:
        """Lines of JSON: a header, files inline, large files by their hash, deletions."""
        self.require_writer()
        repo = self.repo(kind, name)
        files = dict(repo.resolve(revision)[1])
        for line in self.body.splitlines():
            entry = json.loads(line)
            value = entry["value"]
            if entry["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                files[value["path"]] = self.hub.large[value["oid"]]
            elif entry["key"] == "deletedFile":
                del files[value["path"]]
        sha = repo.commit(files)
        self.answer_json({"commitUrl": f"{self.hub.page(kind, name)}/commit/{sha}", "commitOid": sha})

    def download(self, kind: str, name: str, revision: str, path: str) -> None:
        sha, files = self.repo(kind.rstrip("/") or "models", name).resolve(revision)
        if path not in files:
            raise Refused(404, f"no file {path}", "EntryNotFound")
        self.answer(200, files[path], ETag=f'"{object_id(path, files[path])}"', X_Repo_Commit=sha)


NAME = r"(?P<name>[^/]+/[^/]+?)"
API = rf"/api/(?P<kind>models|datasets)/{NAME}"
PAGE = rf"/(?P<kind>(?:datasets/)?){NAME}"
REVISION = r"(?P<revision>[^/]+)"
ROUTES: list[tuple[tuple[str, ...], str, Callable[..., None]]] = [
    (("POST",), r"/api/repos/create", Handler.create),
    (("POST",), r"/api/validate-yaml", Handler.validate_yaml),
    (("GET",), API, Handler.info),
    (("GET",), rf"{API}/revision/{REVISION}", Handler.info),
    (("GET",), rf"{API}/refs", Handler.refs),
    (("GET",), rf"{API}/tree/{REVISION}/?(?P<folder>.*)", Handler.tree),
    (("POST", "DELETE"), rf"{API}/tag/{REVISION}", Handler.tag),
    (("POST",), rf"{API}/preupload/{REVISION}", Handler.preupload),
    (("POST",), rf"{API}/commit/{REVISION}", Handler.commit),
    (("POST",), rf"{PAGE}\.git/info/lfs/objects/batch", Handler.lfs_batch),
    (("PUT",), r"/large/(?P<oid>[0-9a-f]{64})", Handler.upload),
    (("GET", "HEAD"), rf"{PAGE}/resolve/{REVISION}/(?P<path>.+)", Handler.download),
]


@contextmanager
def running_hub() -> Iterator[Hub]:
    """An empty hub that answers at `hub.url` until the block ends."""
    hub = Hub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("HubHandler", (Handler,), {"hub": hub}))
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(POLL_SECONDS,), daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class ToLoopback(httpx.HTTPTransport):
    """Brings what is for the hub that the client knows to the one on the loopback."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self.target = httpx.URL(url)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        path = request.url.raw_path
        request.url = self.target.copy_with(raw_path=path)
        return super().handle_request(request)


@contextmanager
def hub_at_its_address(monkeypatch: pytest.MonkeyPatch, cache: Path) -> Iterator[Hub]:
    """An empty hub where the client expects the real one, with a cache of its own. Large files go as LFS."""
    with running_hub() as hub:
        mounts, hub.url = {constants.ENDPOINT: ToLoopback(hub.url)}, constants.ENDPOINT
        set_client_factory(lambda: httpx.Client(mounts=mounts, follow_redirects=True))
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
        monkeypatch.setenv("HF_TOKEN", WRITE_TOKEN)
        yield hub
        set_client_factory(default_client_factory)

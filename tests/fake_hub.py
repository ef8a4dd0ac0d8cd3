"""The part of the Hugging Face Hub's HTTP API that pushes and pulls of models use, on loopback.

Written after what huggingface_hub sends and expects: repositories with commits, files that are uploaded
within the commit, and large ones by Git LFS.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

LARGE = (".safetensors", ".mp4")


class FakeHub:
    """What the server holds.

    Attributes:
        repos: name to its commits, the latest last; each is path to content.
        private: names of private repositories.
        requests: method and path of every request.
    """

    def __init__(self):
        self.repos, self.private, self.requests, self.blobs = {}, set(), [], {}

    def put(self, repo, files):
        """Make a repository by hand; return the commit."""
        self.repos.setdefault(repo, [{}]).append(dict(files))
        return self.sha(repo, len(self.repos[repo]) - 1)

    def sha(self, repo, number):
        return hashlib.sha1(f"{repo} {number}".encode()).hexdigest()

    def at(self, repo, revision):
        """Number of the commit that a revision names."""
        shas = [self.sha(repo, k) for k in range(len(self.repos[repo]))]
        return len(shas) - 1 if revision in (None, "main") else shas.index(revision)


@contextlib.contextmanager
def serving():
    """A hub that serves, and its address."""
    hub = FakeHub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    hub.address = f"http://127.0.0.1:{server.server_port}"
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def answer(self, code=200, value=None, content=None, **headers):
        body = json.dumps(value).encode() if content is None else content
        self.send_response(code)
        self.send_header("Content-Length", str(len(body)))
        for name, text in headers.items():
            self.send_header(name.replace("_", "-"), text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def handle_request(self):
        path = unquote(urlsplit(self.path).path)
        self.hub.requests.append((self.command, path))
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        for method, pattern, route in _ROUTES:
            found = re.fullmatch(pattern, path)
            if found and self.command in method:
                repo = found.groupdict().get("repo")
                if repo is not None and repo not in self.hub.repos:
                    self.answer(404, {"error": "Repository not found"}, X_Error_Code="RepoNotFound")
                    return
                route(self, body, **found.groupdict())
                return
        self.answer(404, {"error": f"no route {self.command} {path}"})

    do_GET = do_HEAD = do_POST = do_PUT = handle_request  # noqa: N815 (as http.server has it)

    def create(self, body):
        asked = json.loads(body)
        name = f"{asked['organization']}/{asked['name']}" if asked.get("organization") else asked["name"]
        if name in self.hub.repos:
            self.answer(409, {"error": "exists", "url": f"{self.hub.address}/{name}"})
            return
        self.hub.repos[name] = [{}]
        if asked.get("visibility") == "private":
            self.hub.private.add(name)
        self.answer(200, {"url": f"{self.hub.address}/{name}"})

    def validate(self, body):
        text = json.loads(body)["content"]
        if text.startswith("---\n") and "license: nonsense" not in text:
            self.answer(200, {"errors": [], "warnings": []})
        else:
            self.answer(400, {"errors": [{"message": '"license" must be one of [...]'}], "warnings": []})

    def preupload(self, body, repo, revision):
        files = [
            {"path": one["path"], "shouldIgnore": False,
             "uploadMode": "lfs" if one["path"].endswith(LARGE) else "regular"}
            for one in json.loads(body)["files"]
        ]  # fmt: skip
        self.answer(200, {"files": files})

    def batch(self, body, repo):
        objects = [
            one | {"actions": {"upload": {"href": f"{self.hub.address}/blobs/{one['oid']}"}}}
            for one in json.loads(body)["objects"]
        ]
        self.answer(200, {"transfer": "basic", "objects": objects})

    def blob(self, body, oid):
        assert hashlib.sha256(body).hexdigest() == oid
        self.hub.blobs[oid] = body
        self.answer(200, {})

    def commit(self, body, repo, revision):
        files = dict(self.hub.repos[repo][-1])
        for line in body.splitlines():
            entry = json.loads(line)
            value = entry["value"]
            if entry["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                files[value["path"]] = self.hub.blobs[value["oid"]]
            elif entry["key"] == "deletedFile":
                del files[value["path"]]
        sha = self.hub.put(repo, files)
        self.answer(200, {"commitUrl": f"{self.hub.address}/{repo}/commit/{sha}", "commitOid": sha})

    def info(self, body, repo, revision=None):
        try:
            number = self.hub.at(repo, revision)
        except ValueError:
            self.answer(404, {"error": "Invalid rev id"}, X_Error_Code="RevisionNotFound")
            return
        names = [{"rfilename": name} for name in self.hub.repos[repo][number]]
        self.answer(200, {"id": repo, "sha": self.hub.sha(repo, number), "siblings": names})

    def tree(self, body, repo, revision):
        files = self.hub.repos[repo][self.hub.at(repo, revision)]
        folders = {name.rpartition("/")[0] for name in files if "/" in name}
        entries = [{"type": "directory", "path": name, "oid": "0" * 40} for name in sorted(folders)]
        entries += [
            {"type": "file", "path": name, "size": len(content), "oid": hashlib.sha1(content).hexdigest()}
            for name, content in files.items()
        ]
        self.answer(200, entries)

    def resolve(self, body, repo, revision, name):
        content = self.hub.repos[repo][self.hub.at(repo, revision)].get(name)
        if content is None:
            self.answer(404, {"error": "Entry not found"}, X_Error_Code="EntryNotFound")
            return
        commit = self.hub.sha(repo, self.hub.at(repo, revision))
        etag = f'"{hashlib.sha256(content).hexdigest()}"'
        self.answer(200, content=content, X_Repo_Commit=commit, ETag=etag)


_REPO = r"(?P<repo>[^/]+/[^/]+)"
_ROUTES = (
    ("POST", r"/api/repos/create", _Handler.create),
    ("POST", r"/api/validate-yaml", _Handler.validate),
    ("POST", rf"/api/models/{_REPO}/preupload/(?P<revision>[^/]+)", _Handler.preupload),
    ("POST", rf"/{_REPO}\.git/info/lfs/objects/batch", _Handler.batch),
    ("PUT", r"/blobs/(?P<oid>[0-9a-f]+)", _Handler.blob),
    ("POST", rf"/api/models/{_REPO}/commit/(?P<revision>[^/]+)", _Handler.commit),
    ("GET", rf"/api/models/{_REPO}", _Handler.info),
    ("GET", rf"/api/models/{_REPO}/revision/(?P<revision>[^/]+)", _Handler.info),
    ("GET", rf"/api/models/{_REPO}/tree/(?P<revision>[^/]+)", _Handler.tree),
    ("GET HEAD", rf"/{_REPO}/resolve/(?P<revision>[^/]+)/(?P<name>.+)", _Handler.resolve),
)

"""Downloads from a real server on this machine, licences, and the cache of models."""

from __future__ import annotations

import hashlib
import http.server
import json
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from toonifygb.assets import download as downloads
from toonifygb.assets import manifest, store
from toonifygb.assets.download import download
from toonifygb.errors import AssetError, InputError
from toonifygb.progress import Stopped

if TYPE_CHECKING:
    from collections.abc import Iterator

CONTENT = bytes(range(256)) * 4096
DIGEST = hashlib.sha256(CONTENT).hexdigest()
NAME = "styleganex-arcane"


@dataclass
class Behaviour:
    """What the server does, and what it was asked."""

    content: bytes = CONTENT
    tag: str = '"one"'
    takes_ranges: bool = True
    cut_after: list[int] = field(default_factory=list)
    """Bytes after which each of the next answers breaks off."""
    status: int = 200
    says_length: bool = True
    asked: list[tuple[str, str | None]] = field(default_factory=list)
    url: str = ""


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves one file as ``behaviour`` says."""

    behaviour: Behaviour

    def do_GET(self) -> None:
        act = self.behaviour
        span = self.headers.get("Range")
        act.asked.append((self.path, span))
        if act.status != 200:
            self.send_error(act.status)
            return
        if self.path.startswith("/moved/"):
            self.send_response(302)
            self.send_header("Location", self.path.removeprefix("/moved"))
            self.end_headers()
            return
        start = 0
        if span and act.takes_ranges and self.headers.get("If-Range") == act.tag:
            start = int(span.removeprefix("bytes=").removesuffix("-"))
        if start and start >= len(act.content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(act.content)}")
            self.end_headers()
            return
        body = act.content[start:]
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(act.content) - 1}/{len(act.content)}")
        if act.says_length:
            self.send_header("Content-Length", str(len(body)))
        if act.tag:
            self.send_header("ETag", act.tag)
        self.end_headers()
        if act.cut_after:
            body = body[: act.cut_after.pop(0)]
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Says nothing."""


@pytest.fixture
def server() -> Iterator[Behaviour]:
    """A server for one test."""
    behaviour = Behaviour()
    handler = type("OneHandler", (Handler,), {"behaviour": behaviour})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True).start()
        behaviour.url = f"http://127.0.0.1:{running.server_address[1]}/file.pt"
        yield behaviour
        running.shutdown()


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pieces far smaller than the file."""
    monkeypatch.setattr(downloads, "CHUNK", 64 * 1024)


@pytest.fixture
def target(tmp_path: Path) -> Path:
    """Where a download goes."""
    return tmp_path / "file.pt"


class Watcher:
    """Progress that is kept, and that stops after some bytes."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.seen: list[tuple[int, int | None]] = []
        self.stop_after = stop_after

    def update(self, done: int, total: int | None, **_: float) -> None:
        self.seen.append((done, total))
        if self.stop_after is not None and done >= self.stop_after:
            raise Stopped


def ranges(server: Behaviour) -> list[str | None]:
    return [span for _, span in server.asked]


def test_a_file_arrives_whole_and_alone(server: Behaviour, target: Path) -> None:
    watcher = Watcher()
    found = download(server.url, target, size_bytes=len(CONTENT), sha256=DIGEST, progress=watcher)
    assert found == DIGEST and target.read_bytes() == CONTENT
    assert list(target.parent.iterdir()) == [target]
    assert watcher.seen[-1] == (len(CONTENT), len(CONTENT)) and len(watcher.seen) > 8


def test_a_stopped_download_goes_on_where_it_was(server: Behaviour, target: Path) -> None:
    with pytest.raises(Stopped):
        download(server.url, target, progress=Watcher(stop_after=300_000))
    assert not target.exists()
    have = (target.parent / ".file.pt.part").stat().st_size
    assert download(server.url, target) == DIGEST
    assert ranges(server) == [None, f"bytes={have}-"] and have >= 300_000


def test_a_broken_connection_is_taken_up_again_at_once(server: Behaviour, target: Path) -> None:
    server.cut_after = [200_000, 100_000]
    assert download(server.url, target, sha256=DIGEST) == DIGEST
    assert ranges(server) == [None, "bytes=200000-", "bytes=300000-"]


def test_after_some_tries_it_is_left_for_later(server: Behaviour, target: Path) -> None:
    server.cut_after = [200_000, 100_000, 0]
    with pytest.raises(AssetError, match=r"stopped after 0 MB .*ended early") as caught:
        download(server.url, target)
    assert "goes on" in caught.value.hint
    assert download(server.url, target) == DIGEST
    assert ranges(server)[-1] == "bytes=300000-"


def test_a_changed_file_is_fetched_from_its_start(server: Behaviour, target: Path) -> None:
    with pytest.raises(Stopped):
        download(server.url, target, progress=Watcher(stop_after=300_000))
    server.tag, server.content = '"two"', CONTENT[::-1]
    download(server.url, target)
    assert target.read_bytes() == CONTENT[::-1]


@pytest.mark.parametrize("change", [{"takes_ranges": False}, {"tag": ""}, {"says_length": False}])
def test_servers_that_know_less(server: Behaviour, target: Path, change: dict) -> None:
    for name, value in change.items():
        setattr(server, name, value)
    with pytest.raises(Stopped):
        download(server.url, target, progress=Watcher(stop_after=300_000))
    assert download(server.url, target, sha256=DIGEST) == DIGEST


def test_a_part_that_is_the_whole_is_enough(server: Behaviour, target: Path) -> None:
    with pytest.raises(Stopped):
        download(server.url, target, progress=Watcher(stop_after=len(CONTENT)))
    assert download(server.url, target, sha256=DIGEST) == DIGEST
    server.content = CONTENT[:1000]
    (target.parent / ".file.pt.part").write_bytes(CONTENT)
    (target.parent / ".file.pt.tag").write_text(json.dumps({"url": server.url, "tag": server.tag}))
    download(server.url, target)
    assert target.read_bytes() == CONTENT[:1000]


@pytest.mark.parametrize("expected", [{"sha256": "0" * 64}, {"size_bytes": 5}], ids=["checksum", "size"])
def test_another_file_than_expected_is_thrown_away(server: Behaviour, target: Path, expected: dict) -> None:
    with pytest.raises(AssetError, match=r"another checksum|expected 5"):
        download(server.url, target, **expected)
    assert not list(target.parent.iterdir())


def test_redirections_keep_the_range(server: Behaviour, target: Path) -> None:
    url = server.url.replace("/file.pt", "/moved/file.pt")
    with pytest.raises(Stopped):
        download(url, target, progress=Watcher(stop_after=300_000))
    download(url, target, sha256=DIGEST)
    path, span = server.asked[-1]
    assert path == "/file.pt" and span is not None


def test_no_file_no_server_no_room(server: Behaviour, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(AssetError, match="not a web address"):
        download(f"file://{Path(__file__)}", target)
    server.status = 404
    with pytest.raises(AssetError, match="answers 404"):
        download(server.url, target)
    server.status = 200
    monkeypatch.setattr(downloads.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1000}))
    with pytest.raises(AssetError, match="GB free"):
        download(server.url, target)
    with pytest.raises(AssetError, match=r"127\.0\.0\.1 cannot be reached"):
        download("http://127.0.0.1:9/file.pt", target)
    assert not list(target.parent.iterdir())


# ---- the store


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of models."""
    folder = tmp_path / "cache"
    monkeypatch.setenv(store.CACHE_VARIABLE, str(folder))
    return folder


@pytest.fixture
def served(server: Behaviour, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Behaviour:
    """The manifest with one asset on our server."""
    asset = replace(manifest.manifest()[NAME], urls=(server.url,), sha256=DIGEST, size_bytes=len(CONTENT))
    monkeypatch.setattr(manifest, "manifest", lambda: {NAME: asset})
    monkeypatch.setattr(store, "manifest", manifest.manifest)
    return server


def reverse(source: Path, target: Path) -> None:
    """Stands for a conversion."""
    target.write_bytes(source.read_bytes()[::-1])


def agree(_: manifest.Asset) -> bool:
    return True


def refuse(_: manifest.Asset) -> bool:
    return False


def must_not_ask(_: manifest.Asset) -> bool:
    raise AssertionError("asked for a licence that was accepted before")


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_get_downloads_converts_and_leaves_no_rest(served: Behaviour, cache: Path) -> None:
    path = store.get(NAME, reverse, agree)
    assert path.read_bytes() == CONTENT[::-1] and path == store.model_path(NAME)
    assert files(cache) == {"licenses.json", f"models/{NAME}.safetensors", f"models/{NAME}.json"}
    assert store.verify(NAME) == hashlib.sha256(CONTENT[::-1]).hexdigest()
    (entry,) = store.entries()
    assert entry.path == path and entry.size_bytes == len(CONTENT)
    store.get(NAME, reverse, must_not_ask)
    assert len(served.asked) == 1


def test_a_licence_is_asked_for_once_and_before_anything_is_fetched(served: Behaviour, cache: Path) -> None:
    with pytest.raises(AssetError, match=r"S-Lab License 1\.0, which was not accepted"):
        store.get(NAME, reverse, refuse)
    assert not served.asked and not cache.exists()
    store.get(NAME, reverse, agree)
    assert store.is_accepted(manifest.find(NAME))
    (cache / "models" / f"{NAME}.json").unlink()
    store.get(NAME, reverse, must_not_ask)


def test_an_unconvertible_file_leaves_nothing(served: Behaviour, cache: Path) -> None:
    def fail(source: Path, target: Path) -> None:
        raise AssetError("not a network")

    with pytest.raises(AssetError, match="not a network"):
        store.get(NAME, fail, agree)
    assert files(cache) == {"licenses.json"}


def test_a_stopped_conversion_does_not_download_again(served: Behaviour, cache: Path) -> None:
    def stop(source: Path, target: Path) -> None:
        raise Stopped

    with pytest.raises(Stopped):
        store.get(NAME, stop, agree)
    store.get(NAME, reverse, agree)
    assert len(served.asked) == 1


def test_offline_says_how_to_do_it_by_hand(served: Behaviour, cache: Path) -> None:
    served.status = 503
    with pytest.raises(AssetError, match=r"could not be downloaded: .* answers 503") as caught:
        store.get(NAME, reverse, agree)
    assert "assets add styleganex-arcane styleganex_toonify_arcane.pt" in caught.value.hint
    assert "'paint' needs no model" in caught.value.hint


def test_add_takes_a_file_of_the_users(served: Behaviour, cache: Path, tmp_path: Path) -> None:
    mine = tmp_path / "download.pt"
    mine.write_bytes(CONTENT)
    store.add(NAME, mine, reverse, agree)
    assert store.model_path(NAME).read_bytes() == CONTENT[::-1] and mine.read_bytes() == CONTENT
    mine.write_bytes(CONTENT + b"more")
    with pytest.raises(AssetError, match=r"is not the published styleganex_toonify_arcane\.pt"):
        store.add(NAME, mine, reverse, agree)
    with pytest.raises(AssetError, match="does not exist"):
        store.add(NAME, tmp_path / "absent.pt", reverse, agree)
    assert not served.asked


def test_verify_notices_a_changed_file(served: Behaviour, cache: Path) -> None:
    with pytest.raises(AssetError, match="is not in") as caught:
        store.verify(NAME)
    assert "or use the style 'paint'" in caught.value.hint
    path = store.get(NAME, reverse, agree)
    path.write_bytes(CONTENT)
    with pytest.raises(AssetError, match="has changed"):
        store.verify(NAME)
    (cache / "models" / f"{NAME}.json").write_text("{")
    with pytest.raises(AssetError, match="is damaged"):
        store.verify(NAME)


def test_the_cache_is_in_the_home_folder_unless_told(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert store.cache_folder() == cache
    monkeypatch.delenv(store.CACHE_VARIABLE)
    assert store.cache_folder() == Path.home() / ".cache" / "toonifygb"


def test_the_manifest_is_complete() -> None:
    from toonifygb import stylize

    for name, asset in manifest.manifest().items():
        if asset.kind == "flame":
            assert asset.file.endswith(".pkl") and not asset.urls and asset.sign_up.startswith("https://")
            assert asset.nearest_head == "open" and asset.citation and "NON-COMMERCIAL" in asset.license.summary
            continue
        assert asset.name == name and asset.file.endswith(".pt") and asset.kind == "styleganex"
        assert asset.urls and all(url.startswith("https://") and url.endswith(asset.file) for url in asset.urls)
        assert asset.pages and asset.citation and "NON-COMMERCIAL" in asset.license.summary
        assert asset.nearest_style in stylize.available()
        assert asset.sha256 is None or len(asset.sha256) == 64


def test_unknown_names_are_answered_with_the_nearest() -> None:
    with pytest.raises(InputError, match="does not exist") as caught:
        manifest.find("styleganex-arcan")
    assert caught.value.hint == "did you mean 'styleganex-arcane'?"

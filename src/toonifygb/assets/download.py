"""Downloads that survive interruptions: what has arrived is kept, and the next try asks for the rest only."""

from __future__ import annotations

import hashlib
import http.client
import json
import shutil
import ssl
import urllib.error
import urllib.request
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from toonifygb.errors import AssetError
from toonifygb.progress import SILENT

if TYPE_CHECKING:
    from pathlib import Path

    from toonifygb.progress import Progress

CHUNK = 2**20
TIMEOUT_S = 30.0
TRIES = 3
"""Connections made for one download before it is left for later."""
RESUMABLE = "the same command goes on from there"
"""Hint of a download that was interrupted."""
_INTERRUPTIONS = (http.client.HTTPException, ConnectionError, TimeoutError, ssl.SSLError, urllib.error.URLError)


class _OutdatedError(Exception):
    """What has arrived is longer than what the server has now."""


@dataclass(frozen=True)
class _Answer:
    """What the server says about the bytes that follow."""

    start: int
    """Byte of the file at which they begin."""
    total: int | None
    """Length of the whole file."""
    tag: str
    """What identifies this version of the file; empty when the server gives nothing."""


def download(
    url: str,
    target: Path,
    *,
    size_bytes: int | None = None,
    sha256: str | None = None,
    progress: Progress = SILENT,
) -> str:
    """Brings ``url`` to ``target``, which appears when it is complete and right.

    What has arrived lies beside it as ``.NAME.part``, with the version's tag in ``.NAME.tag``.

    Args:
        url: http or https.
        target: the file to write.
        size_bytes: length to insist on.
        sha256: checksum to insist on.
        progress: counts bytes.

    Returns:
        The SHA-256 of the file.

    Raises:
        AssetError: no connection, no such file, no room, or not the file that was asked for.
        Stopped: the user asked to stop; the next call goes on.
    """
    if urlsplit(url).scheme not in ("http", "https"):
        raise AssetError(f"{url} is not a web address")
    target.parent.mkdir(parents=True, exist_ok=True)
    part, tag = target.with_name(f".{target.name}.part"), target.with_name(f".{target.name}.tag")
    total = _persist(url, part, tag, size_bytes, progress)
    if size_bytes is not None and total != size_bytes:
        _forget(part, tag)
        raise AssetError(f"{url} has {total} bytes; expected {size_bytes}", "the file there is another one")
    with part.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if sha256 is not None and found != sha256:
        _forget(part, tag)
        raise AssetError(
            f"{url} arrived with another checksum ({found[:12]}… instead of {sha256[:12]}…)", "try again"
        )
    part.replace(target)
    tag.unlink(missing_ok=True)
    return found


def _persist(url: str, part: Path, tag: Path, size_bytes: int | None, progress: Progress) -> int:
    """Brings ``part`` to its end over as many connections as that takes; returns its length."""
    attempt = 1
    while True:
        try:
            return _continue(url, part, tag, size_bytes, progress)
        except urllib.error.HTTPError as error:
            raise AssetError(f"{url} answers {error.code} {error.reason}") from error
        except _OutdatedError:
            _forget(part, tag)
        except _INTERRUPTIONS as error:
            arrived = part.stat().st_size if part.exists() else 0
            if attempt >= TRIES or not arrived:
                hint = RESUMABLE if arrived else "check the connection"
                raise AssetError(_broken(url, arrived, error), hint) from error
        attempt += 1


def _continue(url: str, part: Path, tag: Path, size_bytes: int | None, progress: Progress) -> int:
    """Fetches what is missing of ``part``; returns the length of the whole file."""
    request = urllib.request.Request(url, headers={"User-Agent": "toonifygb"})
    have, version = _begun(url, part, tag)
    if have:
        request.add_header("Range", f"bytes={have}-")
        request.add_header("If-Range", version)  # another version of the file is sent from its start
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and have:
            whole = error.headers.get("Content-Range", "").rpartition("/")[2]
            if whole == str(have):
                return have
            raise _OutdatedError from error
        raise
    with response:
        answer = _understood(response)
        total = answer.total if answer.total is not None else size_bytes
        _check_room(part, (total or 0) - answer.start)
        if answer.start not in (0, have):
            raise ConnectionError(f"the server sends bytes from {answer.start}, asked for {have}")
        with part.open("r+b" if answer.start else "wb") as file:
            file.seek(answer.start)
            file.truncate()
            tag.write_text(json.dumps({"url": url, "tag": answer.tag}), encoding="utf-8")
            done = answer.start
            while chunk := response.read(CHUNK):
                file.write(chunk)
                done += len(chunk)
                progress.update(done, total)
    if answer.total is not None and done < answer.total:
        raise ConnectionError("the connection ended early")
    return done


def _begun(url: str, part: Path, tag: Path) -> tuple[int, str]:
    """Bytes there are to go on from, and of which version; none where the version is not known."""
    try:
        begun = json.loads(tag.read_text(encoding="utf-8"))
        version = str(begun["tag"]) if begun["url"] == url else ""
    except (OSError, ValueError, KeyError, TypeError):
        version = ""
    have = part.stat().st_size if part.exists() and version else 0
    return have, version


def _understood(response: http.client.HTTPResponse) -> _Answer:
    """The answer's headers, read."""
    tag = response.headers.get("ETag") or response.headers.get("Last-Modified") or ""
    if tag.startswith("W/"):  # a weak tag does not promise equal bytes
        tag = response.headers.get("Last-Modified") or ""
    length = response.headers.get("Content-Length", "")
    total = int(length) if length.isdecimal() else None
    if response.status != http.HTTPStatus.PARTIAL_CONTENT:
        return _Answer(0, total, tag)
    span, _, whole = response.headers.get("Content-Range", "").removeprefix("bytes ").partition("/")
    start = span.partition("-")[0]
    if not start.isdecimal():
        raise ConnectionError("the server sends a part without saying which")
    return _Answer(int(start), int(whole) if whole.isdecimal() else None, tag)


def _check_room(part: Path, needed: int) -> None:
    free = shutil.disk_usage(part.parent).free
    if needed > free:
        raise AssetError(
            f"{part.parent} has {free / 1e9:.1f} GB free; the download needs {needed / 1e9:.1f} GB",
            "make room or set TOONIFYGB_CACHE to another folder",
        )


def _broken(url: str, arrived: int, error: BaseException) -> str:
    reason = getattr(error, "reason", error)
    if arrived:
        return f"the download of {url} stopped after {arrived / 1e6:.0f} MB ({reason})"
    return f"{urlsplit(url).hostname} cannot be reached ({reason})"


def _forget(*paths: Path) -> None:
    for path in paths:
        path.unlink(missing_ok=True)

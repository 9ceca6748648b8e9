"""The tuning page is open to who has its address, and to no other page, host or user."""

import http.client
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("viser", reason="the page is served with viser")

import viser
from shots import CLOTH, cloth_shot
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from physgraph_usd.studio.page import TunePage
from physgraph_usd.studio.session import TuneSession

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
FOREIGN = ("http://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1", "http://127.0.0.1")


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    shot = cloth_shot(tmp_path_factory.mktemp("tune") / "sheet.usda", size=(4, 4))
    with closing(TuneSession(shot, garments=[CLOTH])) as session, closing(TunePage(session, port=8300)) as page:
        yield page.url


def get(url: str, *, path: str | None = None, **headers: str) -> tuple[int, str]:
    """Status and the start of the answer to a request at an address, or at another path of it."""
    place = urlsplit(url)
    with closing(http.client.HTTPConnection(place.netloc, timeout=10)) as connection:
        connection.request("GET", place.path if path is None else path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read(200).decode()


def shake(url: str, *, path: str | None = None, origin: str | None = None, host: str | None = None) -> bytes:
    """The first message of a websocket, as the viewer's page opens it."""
    place = urlsplit(url)
    there = f"ws://{host or place.netloc}{place.path if path is None else path}"
    headers = {} if origin is None else {"Origin": origin}
    way = socket.create_connection((place.hostname, place.port), timeout=10)
    with connect(there, sock=way, subprotocols=[PROTOCOL], additional_headers=headers) as opened:
        message = opened.recv(timeout=10)
        assert isinstance(message, bytes)
        return message


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_who_has_the_address_gets_in(url: str, name: str):
    host = f"{name}:{urlsplit(url).port}"
    status, page = get(url, Host=host)
    assert (status, page.lstrip().lower()[:9]) == (200, "<!doctype")
    assert get(f"{url}/", Host=host)[0] == 200
    assert shake(url, origin=f"http://{host}", host=host)
    assert shake(url, host=host)


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_page_of_another_site_is_refused(url: str, origin: str):
    assert get(url, Origin=origin)[0] == 403
    with pytest.raises(InvalidStatus, match="403"):
        shake(url, origin=origin)


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "127.0.0.1@evil.example", "evil.example:8300"]
)
def test_a_foreign_host_is_refused(url: str, host: str):
    """A name that leads here, as a site has that would get round the browser's own rule."""
    assert get(url, Host=host)[0] == 403
    if "@" not in host:
        with pytest.raises(InvalidStatus, match="403"):
            shake(url, host=host, origin=f"http://{host}")


@pytest.mark.parametrize("path", ["", "/", "/index.html", "/x", "/?token", "//"])
def test_without_the_secret_nothing_is_there(url: str, path: str):
    status, said = get(url, path=path or "/")
    assert status == 403
    assert "open the one that physgraph-usd tune printed" in said
    with pytest.raises(InvalidStatus, match="403"):
        shake(url, path=path)


def test_each_session_has_its_own_secret(url: str, tmp_path: Path):
    shot = cloth_shot(tmp_path / "sheet.usda", size=(4, 4))
    with closing(TuneSession(shot, garments=[CLOTH])) as session, closing(TunePage(session, port=8300)) as page:
        mine, other = urlsplit(url), urlsplit(page.url)
        assert mine.port != other.port
        assert get(page.url, path=mine.path)[0] == 403
        assert len(other.path.strip("/")) >= 20

"""Who may look: where the page listens, and which requests it answers. Pure; no sockets.

A page on loopback is open to this machine's browsers, and to nothing that they load from elsewhere: the name
it is asked for by (`Host`) must be this machine's, or another site could have its own name resolved to
127.0.0.1 and read along; a WebSocket must come from the page itself (`Origin`). On any other address a token
goes before everything.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import parse_qs, urlencode, urlsplit

from cap4d.drive.open_live import is_loopback
from cap4d.drive.wire import same_token
from cap4d.errors import ArgumentError

MAX_PATH = 512  # characters of a request's path and query

OPEN_PATHS = frozenset({"/page.css", "/page.js", "/favicon.svg"})  # every installation's are the same
PAGE, SOCKET = "/", "/socket"


@dataclass(frozen=True)
class Refusal:
    """An answer in place of what was asked for: an HTTP status, and a line for the person who asked."""

    status: int
    text: str


NOT_FOUND = Refusal(404, "There is nothing here but the page at /.")
NOT_ALLOWED = Refusal(405, "This page can be looked at (GET), and nothing else.")
WRONG_HOST = Refusal(403, "This page answers to 127.0.0.1 and localhost only.")
WRONG_ORIGIN = Refusal(403, "Only the page itself may connect.")
NO_TOKEN = Refusal(403, "This page needs the token that cap4d-view printed: open the whole address.")


def parse_address(text: str) -> tuple[str, int]:
    """`127.0.0.1:8300`, `[::1]:8300`, `:8300` or `myhost:8300` -> (host, port); port 0 is any free one.

    Raises:
        ArgumentError: Anything else.
    """
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname or "127.0.0.1", parts.port
    except ValueError:
        host, port = "", None
    if port is None or text != parts.netloc or "@" in text:
        raise ArgumentError(f"serve: expected HOST:PORT such as 127.0.0.1:8300, got {text}")
    return host, port


class Door:
    """Answers for one address.

    Args:
        host: What is listened on.
        token: What a request must bear; None: nothing on loopback, one made up elsewhere.
    Raises:
        ArgumentError: The token is empty.
    """

    def __init__(self, host: str, token: str | None = None) -> None:
        if token == "":  # as from a shell variable that is not set: it would let everybody in
            raise ArgumentError("token: expected a word, got none")
        self.host, self.loopback = host, is_loopback(host)
        self.token = token if token is not None or self.loopback else secrets.token_urlsafe(16)

    def address(self, port: int) -> str:
        """What to open in a browser, token and all."""
        host = self.host
        if host in ("0.0.0.0", "::"):
            host = socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        query = "" if self.token is None else "?" + urlencode({"token": self.token})
        return f"http://{host}:{port}/{query}"

    def refusal(self, target: str, headers: Mapping[str, str]) -> Refusal | None:
        """Why a GET of `target` (path and query) with these headers is not answered; None: it is."""
        path, _, query = target.partition("?")
        if len(target) > MAX_PATH or path not in (PAGE, SOCKET, *OPEN_PATHS):
            return NOT_FOUND
        host, origin = headers.get("Host", ""), headers.get("Origin")
        if self.loopback and not _names_this_machine(host):
            return WRONG_HOST
        if path == SOCKET and origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return WRONG_ORIGIN
        if path not in OPEN_PATHS and not same_token(_token(query), self.token):
            return NO_TOKEN
        return None


def _names_this_machine(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False


def _token(query: str) -> str | None:
    try:
        return parse_qs(query, max_num_fields=8).get("token", [None])[-1]
    except ValueError:
        return None

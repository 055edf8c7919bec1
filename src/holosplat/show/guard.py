"""Access control of a live view: a token, this machine's own address, and no page of another server.

The address that is printed has the token in it. The first answer turns it into a cookie that scripts cannot read and
leads to the address without it; every later request, and the WebSocket, must bring the cookie.
"""

from __future__ import annotations

import hmac
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Literal
from urllib.parse import parse_qs, urlsplit

HOST = "127.0.0.1"
"""The address that the view is bound to: nothing outside of this machine reaches it."""
NAMES = (HOST, "localhost")
"""Names that a request may call this machine by. Another one may be a foreign page's, made to point here."""
REFUSED = "This view is private: open the address, with its token, that holosplat printed.\n"
Answer = Literal["pass", "enter", "refuse"]


@dataclass(frozen=True)
class Guard:
    """The token of a view."""

    token: str

    @property
    def cookie(self) -> str:
        """The name of its cookie, another one for each view: cookies do not tell ports apart."""
        return f"holosplat-{self.token[:6]}"

    def set_cookie(self) -> str:
        """The header that gives it."""
        return f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def answer(self, path: str, headers: Mapping[str, Sequence[str]]) -> Answer:
        """What a request of `path` gets: `pass`; `enter`, the cookie, where the token is in the address; or `refuse`.

        headers: by name in lower case, each with all its values. A request must name this machine as its host, and
        where it says which page it comes from, that must be of this very server.
        """
        hosts, origins = headers.get("host", ()), headers.get("origin", ())
        if len(hosts) != 1 or urlsplit(f"//{hosts[0]}").hostname not in NAMES:
            return "refuse"
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return "refuse"
        if any(self._is(token) for token in parse_qs(urlsplit(path).query).get("token", ())):
            return "enter"
        return "pass" if any(self._is(token) for token in self._cookies(headers)) else "refuse"

    def _cookies(self, headers: Mapping[str, Sequence[str]]) -> list[str]:
        found = []
        for text in headers.get("cookie", ()):
            try:
                cookies = SimpleCookie(text)
            except CookieError:
                continue
            found += [cookies[self.cookie].value] if self.cookie in cookies else []
        return found

    def _is(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())

"""POST /dive/start, stop, finish and new: what a pilot asks for over HTTP, and the answers."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from aquaflow.live.control import RefusedError, ServiceControl, ServiceRequest
from aquaflow.web.access import Access, path_of

PATHS = {f"/dive/{request.value}": request for request in ServiceRequest}
"""The address of each request."""
MOST_BYTES = 4096
"""Of a request's body, which means nothing and is read only to be rid of it."""

NOT_ALLOWED = {
    "error": "give the token in a header or from the service's own page; a link to another page, "
    "and an address with a token, do not do"
}
"""Answer to who may not ask."""


def answer(
    control: ServiceControl,
    access: Access,
    target: str,
    headers: Mapping[str, str],
    dive: str | None,
    peer: str = "",
) -> tuple[int, dict[str, Any]]:
    """Status and JSON of the answer to a POST; ``headers`` by lower-case name, ``dive``: the
    present one's name, ``peer``: the address that the request comes from."""
    request = PATHS.get(path_of(target) or "")
    if request is None:
        return HTTPStatus.NOT_FOUND, {"error": "there is nothing here"}
    if not access.may_change(headers, peer):
        return HTTPStatus.FORBIDDEN, NOT_ALLOWED
    try:
        phase = control.ask(request)
    except RefusedError as refused:
        return HTTPStatus.CONFLICT, {"error": str(refused)}
    return HTTPStatus.ACCEPTED, {"state": phase.value, "dive": dive}

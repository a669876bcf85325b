"""Who is let in: by token, by a trusted address, and never by way of a page of elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.config.service import ListenConfig
from aquaflow.config.stage import validate
from aquaflow.web.access import MOST_ADDRESSES, Access

TOKEN = "correct-horse-battery"
SURFACE = "192.168.2.1"
BEARER = {"authorization": f"Bearer {TOKEN}"}


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    return file


@pytest.fixture
def trusting(token_file: Path) -> Access:
    network = ["192.168.2.0/24", "fd00::/8"]
    config = {"host": "0.0.0.0", "port": 8230, "token_file": token_file, "trusted": network}
    return Access(validate(ListenConfig, config, "test"))


@pytest.fixture
def careful(token_file: Path) -> Access:
    return Access(ListenConfig(host="0.0.0.0", port=8230, token_file=token_file))


@pytest.mark.parametrize("peer", [SURFACE, f"::ffff:{SURFACE}", "fd00::7"])
@pytest.mark.parametrize("host", ["192.168.2.2:8230", "blueos.local", "[fd00::1]:8230", "vehicle"])
def test_a_trusted_network_needs_no_token(trusting: Access, peer: str, host: str) -> None:
    assert trusting.allows("/health", {"host": host}, peer)


@pytest.mark.parametrize("peer", ["192.168.3.1", "127.0.0.1", "fe80::1%eth0", "no address", ""])
def test_others_need_it(trusting: Access, peer: str) -> None:
    assert not trusting.allows("/health", {"host": "192.168.2.2:8230"}, peer)
    assert trusting.allows("/health", BEARER, peer)


def test_nobody_is_trusted_unless_the_config_says_so(careful: Access) -> None:
    assert not careful.allows("/health", {"host": "192.168.2.2:8230"}, SURFACE)


def test_a_name_of_the_internet_that_leads_here_is_no_trusted_request(trusting: Access) -> None:
    assert not trusting.allows("/health", {"host": "evil.example"}, SURFACE)


def test_only_a_proxy_of_the_config_states_its_clients(trusting: Access, token_file: Path) -> None:
    stated = {"host": "blueos.local", "x-real-ip": SURFACE}
    for peer in ("127.0.0.1", "::1", "10.0.0.5"):
        assert not trusting.allows("/health", stated, peer)
    config = {
        "host": "0.0.0.0", "port": 8230, "token_file": token_file,
        "trusted": ["192.168.2.0/24"], "proxies": ["127.0.0.1"],
    }  # fmt: skip
    behind = Access(validate(ListenConfig, config, "test"))
    assert behind.allows("/health", stated, "127.0.0.1")
    assert not behind.allows("/health", stated, "127.0.0.2")
    assert not behind.allows("/health", stated | {"x-real-ip": "10.0.0.5"}, "127.0.0.1")
    assert not behind.allows("/health", stated | {"x-real-ip": f"{SURFACE}, x"}, "127.0.0.1")


def test_a_trusted_network_still_asks_for_a_token_file_and_a_real_network() -> None:
    with pytest.raises(ConfigError, match="token_file"):
        validate(ListenConfig, {"host": "0.0.0.0", "port": 1, "trusted": ["10.0.0.0/8"]}, "test")
    with pytest.raises(ConfigError, match="trusted"):
        validate(ListenConfig, {"port": 1, "trusted": ["192.168.2.300"]}, "test")


def test_cookies_of_other_services_of_the_vehicle_hide_ours_in_no_way(careful: Access) -> None:
    cookies = f'settings={{"a": "b, c"}}; aquaflow_token={TOKEN}; x=y=z; é'
    assert careful.allows("/health", {"host": "vehicle", "cookie": cookies})
    assert not careful.allows("/health", {"host": "vehicle", "cookie": f"other={TOKEN}"})


@pytest.mark.parametrize("by", ["form", "header", "cookie", "address"])
def test_after_ten_wrong_tokens_an_address_waits_a_minute(token_file: Path, by: str) -> None:
    now = [0.0]
    config = ListenConfig(host="0.0.0.0", port=8230, token_file=token_file)
    access = Access(config, clock=lambda: now[0])

    def shows(token: str, peer: str) -> bool:
        if by == "form":
            return access.logs_in(token, {}, peer)
        if by == "address":
            return access.allows(f"/?token={token}", {}, peer)
        cookie = {"cookie": f"aquaflow_token={token}"}
        return access.allows("/", bearer(token) if by == "header" else cookie, peer)

    for _ in range(10):
        assert not access.must_wait({}, SURFACE)
        assert not shows("wrong", SURFACE)
    assert access.must_wait({}, SURFACE)
    assert not shows(TOKEN, SURFACE)
    assert not access.by_query(f"/?token={TOKEN}", {}, SURFACE)
    assert shows(TOKEN, "192.168.2.7")
    now[0] = 61.0
    assert shows(TOKEN, SURFACE)


def test_who_has_shown_the_token_is_not_locked_out_by_another_at_its_address(
    careful: Access,
) -> None:
    assert careful.allows("/", BEARER, SURFACE)
    for _ in range(50):
        assert not careful.allows("/", bearer("wrong"), SURFACE)
    assert careful.allows("/", BEARER, SURFACE)


def test_the_addresses_whose_guesses_are_counted_are_bounded(careful: Access) -> None:
    for number in range(3000):
        careful.logs_in("wrong", {}, f"10.0.{number // 256}.{number % 256}")
    assert len(careful._guesses._wrong) == MOST_ADDRESSES

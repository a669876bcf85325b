"""Who is let in: by token, by a trusted address, and never by way of a page of elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from aquaflow.base.errors import ConfigError
from aquaflow.config.service import ListenConfig
from aquaflow.config.stage import validated
from aquaflow.web.access import Access

TOKEN = "correct-horse-battery"
SURFACE = "192.168.2.1"
BEARER = {"authorization": f"Bearer {TOKEN}"}


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
    return Access(validated(ListenConfig, config, "test"))


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


def test_a_proxy_on_this_machine_states_its_clients_and_nobody_else_does(trusting: Access) -> None:
    stated = {"host": "blueos.local", "x-real-ip": SURFACE}
    assert trusting.allows("/health", stated, "127.0.0.1")
    assert not trusting.allows("/health", stated, "10.0.0.5")
    assert not trusting.allows("/health", stated | {"x-real-ip": "10.0.0.5"}, "127.0.0.1")


def test_a_trusted_network_still_asks_for_a_token_file_and_a_real_network() -> None:
    with pytest.raises(ConfigError, match="token_file"):
        validated(ListenConfig, {"host": "0.0.0.0", "port": 1, "trusted": ["10.0.0.0/8"]}, "test")
    with pytest.raises(ConfigError, match="trusted"):
        validated(ListenConfig, {"port": 1, "trusted": ["192.168.2.300"]}, "test")


def test_cookies_of_other_services_of_the_vehicle_hide_ours_in_no_way(careful: Access) -> None:
    cookies = f'settings={{"a": "b, c"}}; aquaflow_token={TOKEN}; x=y=z; é'
    assert careful.allows("/health", {"host": "vehicle", "cookie": cookies})
    assert not careful.allows("/health", {"host": "vehicle", "cookie": f"other={TOKEN}"})

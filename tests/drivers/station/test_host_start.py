"""How long a simulated host is waited for: first until it begins, then until it serves."""

import pytest

from drivers import hosting
from drivers.config import StationConfig
from drivers.errors import NotConnected
from drivers.hosting import HostProcess

CONFIG = StationConfig.model_validate({"name": "bench", "world": {}, "devices": {}})
SAYS = "import sys; sys.stdin.readline(); sys.stdout.write({said!r}); sys.stdout.flush(); sys.stdin.read()"


@pytest.fixture
def host(tmp_path, monkeypatch):
    """A host that says something, and then nothing until its standard input ends."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(said):
        (tmp_path / "talking_host.py").write_text(SAYS.format(said=said))
        return HostProcess(CONFIG, "talking_host")

    return make


def test_a_host_that_begins_and_is_ready_in_one_breath_is_ready(host):
    with host('{"begun": 1}\n{"ready": 1}\n') as started:
        assert started.pid > 0


def test_a_host_that_has_begun_is_waited_for_longer_and_not_for_ever(host, monkeypatch):
    monkeypatch.setattr(hosting, "HOST_READY", 0.25)
    with pytest.raises(NotConnected, match=r"not ready within 0\.25 s"), host('{"begun": 1}\n'):
        pass


def test_a_host_that_does_not_begin_is_given_up_sooner(host, monkeypatch):
    monkeypatch.setattr(hosting, "HOST_START", 0.25)
    with pytest.raises(NotConnected, match=r"not ready within 0\.25 s"), host(""):
        pass

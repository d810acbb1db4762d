"""Prometheus metrics of the status."""

import re
import urllib.request
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from ahrsd.telemetry.metrics import METRICS, MetricsServer

STATUS = {
    "link": {"open": True, "bytes": 1234},
    "stream": {
        "messages": 100,
        "rejected": 2,
        "skipped_bytes": 7,
        "samples": 98,
        "rate_hz": 40.0,
        "gaps": 1,
        "restarts": 0,
        "faults": 0,
    },
    "estimate": {
        "heading_sigma_deg": 0.5,
        "converged": True,
        "hard_iron_gauss": [0.1, -0.2, 0.3],
        "gyro_bias_rad_s": [1e-3, 2e-3, 3e-3],
    },
    "gates": [{"gate": "rate", "ok": True}, {"gate": "field.mean", "ok": False}],
    "write_back": {"state": "TRIAL", "locked": None, "flashes": 3},
    "capture": {"error": ""},
    "viewer": {"dropped": 4},
    "shares": [
        {
            "port": "/run/ahrsd/vn100",
            "open": True,
            "send": "",
            "readers": None,
            "lost_bytes": 12,
            "turned_away": 0,
            "ignored_bytes": 0,
            "commands": 9,
            "answered": 6,
            "refused": 1,
            "absorbed": 2,
            "dropped": 0,
            "unanswered": 0,
        },
        {
            "port": "tcp 127.0.0.1:2101",
            "open": False,
            "send": "raw",
            "readers": 0,
            "lost_bytes": 0,
            "turned_away": 3,
            "ignored_bytes": 77,
        },
    ],
}


@pytest.fixture
def scraped():
    """A function that scrapes a server with a status."""
    server = MetricsServer(0)

    def scrape(status):
        if status is not None:
            server.status(status)
        with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/metrics") as answer:
            text = answer.read().decode()
        return {
            (sample.name, tuple(sample.labels.values())): sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
        }

    yield scrape
    server.close()


def test_metrics_have_values_and_labels(scraped):
    found = scraped(STATUS)
    assert found["ahrsd_samples_total", ()] == 98.0
    assert found["ahrsd_link_up", ()] == 1.0
    assert found["ahrsd_hard_iron_gauss", ("y",)] == -0.2
    assert found["ahrsd_gate_open", ("field.mean",)] == 0.0
    assert found["ahrsd_state", ("TRIAL",)] == 1.0
    assert found["ahrsd_state", ("OBSERVING",)] == 0.0
    assert found["ahrsd_flash_writes_total", ()] == 3.0
    pty, tcp = "/run/ahrsd/vn100", "tcp 127.0.0.1:2101"
    assert found["ahrsd_share_open", (pty,)] == 1.0
    assert found["ahrsd_share_commands_total", ("absorbed", pty)] == 2.0
    assert ("ahrsd_share_commands_total", ("answered", tcp)) not in found
    assert found["ahrsd_share_readers", (tcp,)] == 0.0
    assert ("ahrsd_share_readers", (pty,)) not in found
    assert found["ahrsd_share_turned_away_total", (tcp,)] == 3.0
    assert {name.removesuffix("_total") for name, _ in found} == {row.name for row in METRICS}


def test_metrics_of_the_estimate_are_absent_before_it(scraped):
    assert scraped(None) == {}
    found = scraped(STATUS | {"estimate": None, "stream": STATUS["stream"] | {"rate_hz": None}})
    assert ("ahrsd_heading_sigma_degrees", ()) not in found
    assert ("ahrsd_sample_rate_hertz", ()) not in found
    assert found["ahrsd_messages_total", ()] == 100.0


def test_occupied_port_raises_an_error(scraped):
    server = MetricsServer(0)
    with pytest.raises(OSError, match="in use"):
        MetricsServer(server.port)
    server.close()


def test_every_metric_is_documented():
    page = Path(__file__).parents[2] / "docs" / "reference" / "socket.md"
    text = page.read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| `(ahrsd_\w+)[^`]*` \| (\w+) \|", text, re.MULTILINE))
    suffix = {"counter": "_total", "gauge": ""}
    assert listed == {row.name + suffix[row.kind]: row.kind for row in METRICS}

"""The units as systemd itself reads them, and the daemon under a real one."""

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from patience import PATIENCE_S
from real_systemd import RealSystemd, why_not

PROJECT = Path(__file__).parents[2]
UNITS = PROJECT / "systemd"
ANALYZE = shutil.which("systemd-analyze")
analyzed = pytest.mark.skipif(ANALYZE is None, reason="systemd-analyze is not installed")


@analyzed
@pytest.mark.parametrize("unit", ["ahrsd.service", "ahrsd@.service"])
def test_the_unit_verifies_and_is_hardened(unit, tmp_path):
    instance = unit.replace("@.", "@vn100-FT000000.")
    text = (UNITS / unit).read_text().replace("/opt/ahrsd/bin/ahrsd", "/bin/true")
    (tmp_path / instance).write_text(text)
    checked = subprocess.run(
        [ANALYZE, "verify", "--man=no", str(tmp_path / instance)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (checked.returncode, checked.stderr) == (0, "")
    secure = [ANALYZE, "security", "--offline=true", "--threshold=15", str(tmp_path / instance)]
    judged = subprocess.run(secure, capture_output=True, text=True, check=False)
    assert judged.returncode == 0, judged.stdout
    score = re.search(r"exposure level for \S+: ([0-9.]+)", judged.stdout)
    assert float(score[1]) <= 1.0


@analyzed
def test_the_unit_of_the_page_verifies_and_is_hardened(tmp_path):
    text = (UNITS / "ahrsd-page.service").read_text().replace("/opt/ahrsd/bin/ahrsd", "/bin/true")
    (tmp_path / "ahrsd-page.service").write_text(text)
    unit = str(tmp_path / "ahrsd-page.service")
    checked = subprocess.run(
        [ANALYZE, "verify", "--man=no", unit], capture_output=True, text=True, check=False
    )
    assert (checked.returncode, checked.stderr) == (0, "")
    secure = [ANALYZE, "security", "--offline=true", unit]
    judged = subprocess.run(secure, capture_output=True, text=True, check=False)
    score = re.search(r"exposure level for \S+: ([0-9.]+)", judged.stdout)
    assert float(score[1]) <= 1.3  # it has the loopback, which the daemon has not


def test_the_template_differs_from_the_unit_only_where_an_instance_must():
    plain = (UNITS / "ahrsd.service").read_text().splitlines()
    template = (UNITS / "ahrsd@.service").read_text().splitlines()
    extra = [line for line in template if line not in plain]
    assert all("%i" in line or line.startswith("#") for line in extra)
    missing = [line for line in plain if line not in template]
    assert all("ahrsd" in line or line.startswith("Description") for line in missing)


def test_the_rules_touch_no_adapter_that_is_not_named():
    for line in (UNITS / "60-ahrsd.rules").read_text().splitlines():
        assert line.startswith("#")
        if "SYMLINK" in line or "ATTR{" in line or "ENV{ID_MM" in line:
            assert "FT000000" in line


# What a development environment needs beyond the unit: it lies in folders that the unit hides, and
# the device is a pty.
_DROP_IN = """[Service]
ExecStart=
ExecStart={program} -v run --wait --config /etc/ahrsd.toml
ProtectHome=tmpfs
BindReadOnlyPaths={paths}
DeviceAllow=char-pts rw
Environment=PYTHONDONTWRITEBYTECODE=1
WatchdogSec=6
"""


# A person's word instead of the page; it fails where captures can be read.
_WORD = """[Service]
Type=oneshot
Restart=no
ExecStart=
ExecStart={program} operator lock "from the page" --state-directory /var/lib/ahrsd
ExecStart=/bin/sh -c "! ls /var/lib/ahrsd/captures"
"""


def _approving_drop_in():
    """The drop-in for approving, as the guide gives it."""
    guide = (PROJECT / "docs" / "guide" / "page.md").read_text()
    (found,) = [
        block for block in re.findall(r"```ini\n(.*?)```", guide, re.DOTALL) if "User=" in block
    ]
    return found


# TIOCEXCL goes with the last close of a port; a pty whose master is open never sees its last close.
_UNLOCK = "import fcntl, termios; fcntl.ioctl(open('/run/vn100'), termios.TIOCNXCL)"
_CONFIG = """mode = "observe"
[device]
port = "/run/vn100"
baud = 115200
configure_stream = true
rate_hz = 50.0
[capture]
keep_megabytes = 64
part_megabytes = 8
"""


@pytest.fixture(scope="module")
def machine():
    """A booted systemd that has our unit."""
    if reason := why_not():
        pytest.skip(f"no real systemd here: {reason}")
    program = Path(sys.executable).parent / "ahrsd"
    if not program.exists():
        pytest.skip("ahrsd is not installed beside this Python")
    hidden = {sys.prefix, sys.base_prefix, str(PROJECT)}
    closed = [path for path in hidden if Path(path).stat().st_mode & 0o005 != 0o005]
    if closed:
        pytest.skip(f"the service's own user may not read {', '.join(closed)}")
    paths = " ".join(sorted(hidden))
    drop_in = _DROP_IN.format(program=program, paths=paths)
    page_unit = (UNITS / "ahrsd-page.service").read_text()
    page_unit = page_unit.replace("/opt/ahrsd/bin/ahrsd", str(program))
    page_options = f"[Service]\nProtectHome=tmpfs\nBindReadOnlyPaths={paths}\n"
    approves = _approving_drop_in().replace("/opt/ahrsd/bin/ahrsd", str(program))
    # credentials need a mount that this boot cannot make: the folder is named instead
    loaded = "LoadCredential=token:/etc/ahrsd-token"
    assert loaded in approves
    approves = approves.replace(loaded, "Environment=CREDENTIALS_DIRECTORY=/etc/ahrsd-credentials")
    approves = approves.replace("%d", "/etc/ahrsd-credentials")
    units = {
        "ahrsd-page.service": page_unit,
        "ahrsd-page.service.d/test.conf": page_options,
        "approve.conf": approves,
        "ahrsd-word.service": page_unit,
        "ahrsd-word.service.d/1-test.conf": page_options,
        "ahrsd-word.service.d/2-approve.conf": approves,
        "ahrsd-word.service.d/3-word.conf": _WORD.format(program=program),
        "ahrsd-token": "a1b2c3d4e5f6a7b8\n",
        "ahrsd.service": (UNITS / "ahrsd.service").read_text(),
        "ahrsd.service.d/test.conf": drop_in,
        "ahrsd.toml": _CONFIG,
    }
    with RealSystemd(units) as booted:
        booted.run("cp", "/etc/systemd/system/ahrsd.toml", "/etc/ahrsd.toml")
        booted.program = str(program)
        yield booted


def emulate(machine):
    """An emulated VN-100 inside, whose pty everybody may open."""
    process = subprocess.Popen(
        machine.command(machine.program, "emulate", "--link", "/run/vn100"),
        stdout=subprocess.PIPE,
        text=True,
    )
    port = process.stdout.readline().split()[-1]
    machine.run("chmod", "666", port)
    return process


def unplug(machine, device):
    """The emulator ends at once, and its pty with it; nsenter ends with its child."""
    machine.run("pkill", "-KILL", "-f", "ahrsd emulate", check=False)
    device.wait(PATIENCE_S)
    device.stdout.close()


@pytest.mark.timeout(240)
def test_the_daemon_under_a_real_systemd(machine):
    status = lambda: machine.show("ahrsd", "StatusText")  # noqa: E731
    machine.run("systemctl", "start", "ahrsd")  # returns when READY=1 came
    assert machine.show("ahrsd", "ActiveState") == "active"
    assert "waiting for the device" in status()

    device = emulate(machine)
    try:
        machine.until(lambda: status().startswith("OBSERVING"), 40, "a device that is seen")
        pid = machine.show("ahrsd", "MainPID")
        owner = machine.run("stat", "-c", "%u", f"/proc/{pid}").stdout.strip()
        assert 61184 <= int(owner) <= 65519  # DynamicUser's range
        captures = machine.run("ls", "/var/lib/ahrsd/captures").stdout
        assert ".mcap" in captures
        assert machine.run("stat", "-c", "%G %a", "/run/ahrsd/socket").stdout.split() == [
            "dialout",
            "660",
        ]
        asked = machine.run(machine.program, "status", "--socket", "/run/ahrsd/socket").stdout
        assert "stream: " in asked

        # a loop that is stuck is killed and comes back
        machine.run("kill", "-STOP", pid)
        machine.until(lambda: machine.show("ahrsd", "NRestarts") == "1", 60, "a restart")
        machine.run(sys.executable, "-c", _UNLOCK)
        machine.until(lambda: status().startswith("OBSERVING"), 40, "a device that is seen again")
        assert machine.show("ahrsd", "MainPID") != pid

        # a device that is gone is waited for: longer than the watchdog's patience
        pid = machine.show("ahrsd", "MainPID")
        unplug(machine, device)
        machine.until(lambda: "waiting for the device" in status(), 20, "the loss being told")
        time.sleep(8.0)
        assert machine.show("ahrsd", "MainPID") == pid
        assert machine.show("ahrsd", "ActiveState") == "active"
    finally:
        unplug(machine, device)
    began = time.monotonic()
    machine.run("systemctl", "stop", "ahrsd")
    assert time.monotonic() - began <= 3.0
    assert machine.show("ahrsd", "Result") == "success"


_SHARES = (
    _CONFIG
    + """
[[share]]
tcp = "127.0.0.1:2101"
[[share]]
tcp = "127.0.0.1:2102"
send = "corrected"
"""
)


@pytest.mark.timeout(240)
def test_network_shares_need_the_drop_in_of_the_operating_page(machine):
    page = (PROJECT / "docs" / "guide" / "operating.md").read_text(encoding="utf-8")
    drop_in = re.search(r"```\n(\[Service\]\n.*?)```", page, re.DOTALL)[1]
    write = "import sys; open(sys.argv[1], 'w').write(sys.argv[2])"
    more = "/etc/systemd/system/ahrsd.service.d/network.conf"
    machine.run(sys.executable, "-c", write, "/etc/ahrsd.toml", _SHARES)
    device = emulate(machine)
    try:
        machine.run("systemctl", "start", "ahrsd", check=False)
        failed = lambda: machine.show("ahrsd", "ActiveState") == "failed"  # noqa: E731
        machine.until(failed, 40, "a start that is refused")
        assert machine.show("ahrsd", "ExecMainStatus") == "2"  # and so not tried again and again
        said = machine.run("journalctl", "--no-pager", "-u", "ahrsd").stdout
        assert (
            "share.tcp = 127.0.0.1:2101: this process may have no such socket; under systemd"
            in said
        )

        machine.run(sys.executable, "-c", write, more, drop_in)
        machine.run("systemctl", "daemon-reload")
        machine.run("systemctl", "reset-failed", "ahrsd")
        machine.run("systemctl", "start", "ahrsd")
        status = lambda: machine.show("ahrsd", "StatusText")  # noqa: E731
        machine.until(lambda: status().startswith("OBSERVING"), 40, "a device that is seen")
        # whether a packet passes IPAddressAllow is erratic in namespaces on a host with cgroups of
        # both versions, so what is looked at is who listens in the network that all see
        listening = machine.run("cat", "/proc/net/tcp").stdout
        assert [f"0100007F:{port:04X} 00000000:0000 0A" in listening for port in (2101, 2102)] == [
            True,
            True,
        ]
    finally:
        machine.run("systemctl", "stop", "ahrsd", check=False)
        machine.run("rm", "-f", more)
        machine.run("systemctl", "daemon-reload")
        machine.run("cp", "/etc/systemd/system/ahrsd.toml", "/etc/ahrsd.toml")
        unplug(machine, device)


_ASK = """import sys, urllib.request
print(urllib.request.urlopen("http://127.0.0.1:9191/").read().decode())"""


def user_of(machine, unit):
    pid = machine.show(unit, "MainPID")
    return machine.run("stat", "-c", "%u", f"/proc/{pid}").stdout.strip()


def page(machine):
    return machine.run(sys.executable, "-c", _ASK, check=False).stdout


@pytest.mark.timeout(240)
def test_page_unit_runs_with_the_daemon(machine):
    """It reads as an unprivileged client; with the drop-in it may send operator commands."""
    machine.run("ip", "link", "set", "lo", "up")
    machine.run("systemctl", "start", "ahrsd", "ahrsd-page")
    device = emulate(machine)
    try:
        machine.until(lambda: "OBSERVING" in page(machine), 60, "a page that shows the device")
        assert "<form" not in page(machine)
        assert user_of(machine, "ahrsd-page") != user_of(machine, "ahrsd")

        # the page is stopped in the middle of everything: the daemon does not notice
        before = machine.show("ahrsd", "NRestarts"), machine.show("ahrsd", "MainPID")
        machine.run("kill", "-STOP", machine.show("ahrsd-page", "MainPID"))
        time.sleep(3.0)
        machine.run("kill", "-KILL", machine.show("ahrsd-page", "MainPID"))
        assert machine.show("ahrsd", "StatusText").startswith("OBSERVING")
        assert (machine.show("ahrsd", "NRestarts"), machine.show("ahrsd", "MainPID")) == before

        system = "/etc/systemd/system"
        token = "/etc/ahrsd-credentials/token"
        machine.run("install", "-D", "-m", "644", f"{system}/ahrsd-token", token)
        machine.run("cp", f"{system}/approve.conf", f"{system}/ahrsd-page.service.d/approve.conf")
        machine.run("systemctl", "daemon-reload")
        machine.run("systemctl", "restart", "ahrsd-page")
        machine.until(lambda: "OBSERVING" in page(machine), 60, "a page that shows the device")
        assert 'id="approve"' in page(machine)
        assert user_of(machine, "ahrsd-page") == user_of(machine, "ahrsd")
        # a word from the same sandbox and user, where what the daemon recorded is not there
        machine.run("systemctl", "start", "ahrsd-word")
        machine.until(lambda: "LOCKED" in page(machine), 20, "a lock that is shown")
    finally:
        machine.run("systemctl", "stop", "ahrsd-page", "ahrsd", check=False)
        machine.run("rm", "-f", "/etc/systemd/system/ahrsd-page.service.d/approve.conf")
        machine.run("systemctl", "daemon-reload")
        unplug(machine, device)

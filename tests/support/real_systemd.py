"""A real systemd, as PID 1 of namespaces of its own, on an overlay of this machine's root.

Nothing of the machine is written: the overlay's upper layer is a tmpfs that goes with the
namespaces. Needs root, `unshare`, `nsenter` and systemd; `why_not()` says which of them is missing.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from patience import PATIENCE_S

_MASKED = """
systemd-binfmt systemd-firstboot systemd-logind systemd-machine-id-commit systemd-modules-load
systemd-networkd systemd-pcrphase systemd-random-seed systemd-remount-fs systemd-resolved
systemd-sysctl systemd-timesyncd systemd-tmpfiles-clean systemd-tmpfiles-setup
systemd-tmpfiles-setup-dev systemd-udev-trigger systemd-udevd systemd-update-utmp console-getty
e2scrub_all fstrim
"""

# $1: working folder (a tmpfs); $2: folder with the unit files
_BOOT = r"""
set -e
PATH="$PATH:/usr/sbin:/sbin"  # chroot is there
mount --make-rprivate /
mkdir -p $1/upper $1/work $1/root
mount -t overlay overlay -o lowerdir=/,upperdir=$1/upper,workdir=$1/work $1/root
R=$1/root
mount -t proc proc $R/proc
mount --rbind /sys $R/sys
mount -t cgroup2 cgroup2 $R/sys/fs/cgroup
mount -t tmpfs -o mode=755 run $R/run
mount -t tmpfs -o mode=755 dev $R/dev
for d in "null 1 3" "zero 1 5" "full 1 7" "random 1 8" "urandom 1 9" "tty 5 0"; do
  set -- $1 $2 $d; mknod -m 666 $R/dev/$3 c $4 $5
done
mkdir -p $R/dev/pts $R/dev/shm
mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts $R/dev/pts
mount -t tmpfs shm $R/dev/shm
ln -s pts/ptmx $R/dev/ptmx
ln -s /proc/self/fd $R/dev/fd
: > $R/etc/fstab
for unit in MASKED; do ln -sf /dev/null $R/etc/systemd/system/$unit.service; done
for file in $R/lib/systemd/system/*.timer; do
  ln -sf /dev/null $R/etc/systemd/system/$(basename $file)
done
cp -r $2/. $R/etc/systemd/system/
cat > $R/etc/systemd/system/test.target <<END
[Unit]
Requires=sysinit.target
Wants=systemd-journald.service dbus.socket
AllowIsolate=yes
END
exec chroot $R env -i container=test PATH=/usr/sbin:/usr/bin:/sbin:/bin \
  /lib/systemd/systemd --system --unit=test.target --log-target=null --show-status=0
"""


def why_not() -> str:
    """Why a real systemd cannot be started here; empty where it can."""
    if os.geteuid() != 0:
        return "needs root"
    missing = [tool for tool in ("unshare", "nsenter", "systemctl") if shutil.which(tool) is None]
    if missing or not Path("/lib/systemd/systemd").exists():
        return f"{', '.join(missing) or 'systemd'} is not installed"
    tried = subprocess.run(
        ["unshare", "--mount", "--pid", "--fork", "--cgroup", "true"],
        capture_output=True,
        check=False,
    )
    return "" if tried.returncode == 0 else f"unshare: {tried.stderr.decode().strip()}"


class RealSystemd:
    """`with RealSystemd(units) as machine`: boots, and is gone at the end.

    units: text of each file below /etc/systemd/system, by its path there
    """

    def __init__(self, units: dict[str, str]) -> None:
        self.units = units
        self._process: subprocess.Popen[bytes] | None = None
        self._init = 0

    def __enter__(self) -> RealSystemd:
        self._folder = Path(tempfile.mkdtemp(prefix="ahrsd-systemd-", dir="/run"))
        units = self._folder / "units"
        for name, text in self.units.items():
            file = units / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        boot = self._folder / "boot.sh"
        boot.write_text(_BOOT.replace("MASKED", " ".join(_MASKED.split())))
        upper = self._folder / "tmpfs"
        upper.mkdir()
        command = f"mount -t tmpfs -o size=512m tmpfs {upper} && exec bash {boot} {upper} {units}"
        namespaces = ("--mount", "--pid", "--fork", "--uts", "--ipc", "--net", "--cgroup")
        self.log = self._folder / "log"
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                ["unshare", *namespaces, "bash", "-c", command],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._wait_for_boot()
        return self

    def _wait_for_boot(self) -> None:
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            if self._process is None or self._process.poll() is not None:
                break
            children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
            if pids := children.read_text().split():
                self._init = int(pids[0])
                found = self.run("systemctl", "is-system-running", check=False).stdout.strip()
                if found in ("running", "degraded"):
                    return
            time.sleep(0.2)
        text = self.log.read_text(errors="replace")
        self.__exit__()
        raise RuntimeError(f"systemd did not boot: {text[-2000:]}")

    def command(self, *words: str) -> list[str]:
        """What runs `words` inside."""
        where = ("nsenter", "-t", str(self._init), "-m", "-p", "-u", "-i", "-n", "-C", "-r", "-w")
        return [*where, *words]

    def run(self, *words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a command inside and wait for it."""
        return subprocess.run(
            self.command(*words), capture_output=True, text=True, check=check, timeout=60
        )

    def show(self, unit: str, key: str) -> str:
        """One property of a unit."""
        return self.run("systemctl", "show", "-p", key, "--value", unit).stdout.strip()

    def until(self, condition: object, seconds: float, what: str) -> None:
        """Wait until `condition()` is true."""
        end = time.monotonic() + seconds
        while not condition():  # type: ignore[operator]
            if time.monotonic() > end:
                said = self.run("journalctl", "--no-pager", "-n", "30", check=False).stdout
                raise AssertionError(f"{what} did not happen within {seconds:.0f} s:\n{said}")
            time.sleep(0.1)

    def __exit__(self, *_: object) -> None:
        if self._init:
            with contextlib.suppress(ProcessLookupError):  # it may have ended by itself
                os.kill(self._init, signal.SIGKILL)  # PID 1 of the namespace: all in it ends
        if self._process is not None:
            self._process.kill()
            self._process.wait(PATIENCE_S)
        subprocess.run(
            ["umount", "-l", str(self._folder / "tmpfs")], capture_output=True, check=False
        )
        shutil.rmtree(self._folder, ignore_errors=True)

"""`pytest --cpu-by-test FILE`: the processor's seconds of every test, as a table, dearest first.

Counted are this process and those of its children that have ended; what a fixture of a module or
of the session costs is in the setup of the first test that asks for it. With pytest-xdist the
workers send their seconds along with their reports, and one table comes of all.
"""

from __future__ import annotations

import csv
import resource
from collections import Counter
from collections.abc import Generator
from pathlib import Path

import pytest

PHASES = ("setup", "call", "teardown")
PROPERTY = "cpu_s"


def cpu_s() -> float:
    """What this process and its children that have ended took so far."""
    of = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, of))


class CpuByTest:
    """Marks each report with the seconds since the one before, and adds up what the reports say."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.spent_s: dict[str, Counter[str]] = {}
        self._last_s = cpu_s()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self) -> Generator[None, object, object]:
        """What comes between two tests is of none."""
        self._last_s = cpu_s()
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_makereport(
        self,
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """The seconds of one phase."""
        report = yield
        now_s = cpu_s()
        report.user_properties.append((PROPERTY, now_s - self._last_s))
        self._last_s = now_s
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A test that is run a second time has cost both."""
        spent_s = self.spent_s.setdefault(report.nodeid, Counter())
        spent_s[report.when] += dict(report.user_properties).get(PROPERTY, 0.0)

    def by_folder_s(self) -> Counter[str]:
        """Seconds of all tests of a folder, those of folders in it counted there."""
        sums_s: Counter[str] = Counter()
        for test, spent_s in self.spent_s.items():
            sums_s[str(Path(test.split("::")[0]).parent)] += spent_s.total()
        return sums_s

    def write(self) -> None:
        """The table."""
        with self.file.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(["cpu_s", *(f"{phase}_s" for phase in PHASES), "test"])
            for test, spent_s in sorted(self.spent_s.items(), key=lambda one: -one[1].total()):
                numbers = (spent_s.total(), *(spent_s[phase] for phase in PHASES))
                table.writerow([*(f"{number:.3f}" for number in numbers), test])

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """The table is written where all reports are; the folders' sums are printed."""
        self.write()
        terminalreporter.section("processor's seconds by folder")
        sums_s = self.by_folder_s()
        for folder, seconds in sums_s.most_common():
            terminalreporter.write_line(f"{seconds:9.1f}  {folder}")
        terminalreporter.write_line(f"{sums_s.total():9.1f}  in all; by test in {self.file}")


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option."""
    parser.addoption(
        "--cpu-by-test", type=Path, metavar="FILE", help="write each test's processor seconds there"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Nothing is counted unless asked for."""
    if file := config.getoption("--cpu-by-test"):
        config.pluginmanager.register(CpuByTest(file), "cpu-by-test")

"""The shape of the code: who imports whom, what is pure, how long things are."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import grimp
import pytest
from importlinter.cli import lint_imports

PROJECT = Path(__file__).parent.parent
SOURCES = sorted(
    path for folder in ("ahrsd", "drivers") for path in (PROJECT / folder).rglob("*.py")
)

SUPERVISOR = "estimation_queue"  # whatever breaks off in the estimator is a state, never an end
IO_MODULES = {
    "asyncio", "fcntl", "logging", "multiprocessing", "os", "pathlib", "random", "select", "signal",
    "socket", "subprocess", "tempfile", "termios", "threading", "time",
}  # fmt: skip

# Modules that touch the world; every other one is pure and takes time as an argument.
SHELL = (
    "ahrsd.__main__",
    "ahrsd.challenge",
    "ahrsd.cli",
    "ahrsd.config",
    "ahrsd.daemon",
    "ahrsd.demo",
    "ahrsd.foreign_file",
    "ahrsd.montecarlo.runs",
    "ahrsd.offline",
    "ahrsd.recording",
    "ahrsd.report",
    "ahrsd.telemetry.client",
    "ahrsd.telemetry.metrics",
    "ahrsd.telemetry.public",
    "ahrsd.telemetry.sd_notify",
    "ahrsd.telemetry.server",
    "ahrsd.viewer",
    "drivers.port_holders",
    "drivers.serial_port",
    "drivers.usb",
    "drivers.vn100.device",
    "drivers.vn100.emulator.process",
    "drivers.vn100.emulator.pty",
)


@cache
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("ahrsd", "drivers", include_external_packages=True, cache_dir=None)


def is_shell(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in SHELL)


def test_the_import_contracts_hold(capsys, monkeypatch):
    # the linter's own logging would switch off every logger that exists, for all later tests
    monkeypatch.setattr("logging.config.dictConfig", lambda _: None)
    code = lint_imports(str(PROJECT / "pyproject.toml"), no_cache=True)
    assert code == 0, capsys.readouterr().out


def test_pure_modules_do_no_input_output_not_even_through_others():
    internal = {name for name in graph().modules if name.split(".")[0] in ("ahrsd", "drivers")}
    impure = {
        module: sorted(reached)
        for module in internal
        if not is_shell(module) and (reached := graph().find_upstream_modules(module) & IO_MODULES)
    }
    assert impure == {}


def test_the_driver_never_imports_the_daemon():
    assert [
        name
        for name in graph().modules
        if name.split(".")[0] == "drivers"
        and any(up.split(".")[0] == "ahrsd" for up in graph().find_upstream_modules(name))
    ] == []


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PROJECT)))
def test_files_and_functions_are_short_and_catch_what_they_name(path):
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    assert text.count("\n") <= 900
    assert path.stem not in ("utils", "helpers", "common", "misc")
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or 0) - node.lineno + 1
            assert length <= 60, f"{node.name} has {length} lines"
        if isinstance(node, ast.ExceptHandler) and path.stem != SUPERVISOR:
            assert not is_broad(node), f"broad except in line {node.lineno}"


def is_broad(handler: ast.ExceptHandler) -> bool:
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return any(
        kind is None or (isinstance(kind, ast.Name) and kind.id in ("Exception", "BaseException"))
        for kind in kinds
    )


def test_the_checks_would_notice():
    broad = ast.parse("try:\n    pass\nexcept (ValueError, Exception):\n    pass").body[0]
    narrow = ast.parse("try:\n    pass\nexcept ValueError:\n    pass").body[0]
    assert is_broad(broad.handlers[0])
    assert not is_broad(narrow.handlers[0])
    assert graph().find_upstream_modules("ahrsd.daemon.journal") & IO_MODULES == {"os", "pathlib"}


def test_no_machine_path_in_what_is_published():
    published = [
        *SOURCES,
        *(PROJECT / "docs").rglob("*.md"),
        *(PROJECT / "systemd").glob("*"),
        *(path for path in PROJECT.glob("*.md")),
        PROJECT / "pyproject.toml",
    ]
    wrong = ["/" + "work/", "/" + "root/", "/tmp/" + "dev"]
    found = [path.name for path in published if any(w in path.read_text() for w in wrong)]
    assert found == []

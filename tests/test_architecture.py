"""The shape of the code: who imports whom, what is pure, how much one part needs to know."""

from __future__ import annotations

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
from importlinter.cli import lint_imports

PROJECT = Path(__file__).parent.parent
SOURCES = sorted(
    path for folder in ("ahrsd", "drivers") for path in (PROJECT / folder).rglob("*.py")
)

# whatever breaks off in the estimator is a state, and whatever a task raises is its answer: no end
SUPERVISORS = {"estimation", "processes"}
IO_MODULES = {
    "asyncio", "fcntl", "logging", "multiprocessing", "os", "pathlib", "random", "select", "signal",
    "socket", "subprocess", "tempfile", "termios", "threading", "time",
}  # fmt: skip

# Modules that touch the world; every other one is pure and takes time as an argument.
SHELL = (
    "ahrsd.__main__",
    "ahrsd.cli",
    "ahrsd.config",
    "ahrsd.daemon",
    "ahrsd.demo",
    "ahrsd.fleet.archive",
    "ahrsd.fleet.processes",
    "ahrsd.fleet.page",
    "ahrsd.fleet.store",
    "ahrsd.fleet.questions",
    "ahrsd.fleet.run",
    "ahrsd.foreign_file",
    "ahrsd.montecarlo.runs",
    "ahrsd.offline",
    "ahrsd.page.app",
    "ahrsd.recording",
    "ahrsd.report",
    "ahrsd.telemetry.metrics",
    "ahrsd.telemetry.public",
    "ahrsd.telemetry.sd_notify",
    "ahrsd.telemetry.unix_socket",
    "ahrsd.viewer",
    "drivers.serial_port",
    "drivers.vn100.device",
    "drivers.vn100.emulator.pty",
)

# What a reader has to hold in mind: `pytest -s -k figures`. The diagnosis has its own plan.
ENGINE = "ahrsd.diagnosis"
MOST_AT_THE_ROOT = 14  # modules beside the packages of ahrsd
MOST_LINES_OF_A_FUNCTION = 60
MOST_ENTRIES_OF_A_FOLDER = 15  # longer listings are printed
MOST_IMPORTS = 15  # other modules of the project that one module imports
LONGEST_CHAIN = 12  # modules, each of which imports the next


@cache
def graph() -> grimp.ImportGraph:
    return grimp.build_graph("ahrsd", "drivers", include_external_packages=True, cache_dir=None)


@cache
def trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in SOURCES}


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


def test_modules_are_named_for_what_they_do():
    vague = ("utils", "helpers", "common", "misc")
    assert [str(path.relative_to(PROJECT)) for path in SOURCES if path.stem in vague] == []


def test_functions_are_short_and_catch_what_they_name():
    long, broad = [], []
    for path, tree in trees().items():
        name = path.relative_to(PROJECT)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                if lines_of(node) > MOST_LINES_OF_A_FUNCTION:
                    long.append(f"{name}: {node.name} has {lines_of(node)} lines")
            elif (
                isinstance(node, ast.ExceptHandler)
                and path.stem not in SUPERVISORS
                and is_broad(node)
            ):
                broad.append(f"{name}: broad except in line {node.lineno}")
    assert (long, broad) == ([], [])


def lines_of(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return (node.end_lineno or 0) - node.lineno + 1


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


def test_no_class_outside_the_diagnosis_shares_its_name():
    places: dict[str, list[str]] = {}
    for path, tree in trees().items():
        if not path.is_relative_to(PROJECT / "ahrsd" / "diagnosis"):
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef):
                    places.setdefault(node.name, []).append(str(path.relative_to(PROJECT)))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def imports() -> dict[str, set[str]]:
    """What each module outside the diagnosis imports of the project."""
    own = {name for name in graph().modules if name.split(".")[0] in ("ahrsd", "drivers")}
    return {
        name: graph().find_modules_directly_imported_by(name) & own
        for name in own
        if not f"{name}.".startswith(f"{ENGINE}.")
    }


def longest_chain(imported: dict[str, set[str]]) -> list[str]:
    """From the module at the top down to the last one; CycleError where imports run in a circle."""
    chains: dict[str, list[str]] = {}
    for name in TopologicalSorter(imported).static_order():
        below = [chains[other] for other in sorted(imported.get(name, ()))]
        chains[name] = [name, *max(below, key=len, default=[])]
    return max(chains.values(), key=len)


def entries(folder: Path) -> list[str]:
    return [
        path.name for path in folder.iterdir() if not path.name.startswith(("__pycache__", "."))
    ]


def test_figures_of_modules_at_the_root_and_of_functions():
    modules = sorted(path.name for path in (PROJECT / "ahrsd").glob("*.py"))
    print(f"\n{len(modules)} modules at the root of ahrsd: {', '.join(modules)}")
    longest = max(
        (lines_of(node), f"{path.relative_to(PROJECT)}: {node.name}")
        for path, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    )
    print("longest function: {} lines, {}".format(*longest))
    folders = [PROJECT / top for top in ("ahrsd", "drivers", "tests", "docs")]
    listings = sorted(
        ((len(entries(folder)), str(folder.relative_to(PROJECT)))
         for top in folders for folder in [top, *(path for path in top.rglob("*") if path.is_dir())]
         if folder.name != "__pycache__"),
        reverse=True,
    )  # fmt: skip
    print(f"folders with more than {MOST_ENTRIES_OF_A_FOLDER} entries:")
    for number, folder in listings:
        if number > MOST_ENTRIES_OF_A_FOLDER:
            print(f"  {number} {folder}")
    assert len(modules) <= MOST_AT_THE_ROOT
    assert longest[0] <= MOST_LINES_OF_A_FUNCTION


def test_figures_of_imports_outside_the_diagnosis():
    numbers = {name: len(others) for name, others in imports().items()}
    over = {name: number for name, number in numbers.items() if number > MOST_IMPORTS}
    print(f"\n{len(numbers)} modules; {len(over)} import more than {MOST_IMPORTS} of the project:")
    for name, number in sorted(over.items(), key=lambda item: -item[1]):
        print(f"  {number} {name}")
    assert over == {}


def test_figures_of_the_longest_chain_outside_the_diagnosis():
    known = imports()
    chain = longest_chain({name: others & known.keys() for name, others in known.items()})
    print(f"\nlongest chain of imports, {len(chain)} modules: {' > '.join(chain)}")
    assert len(chain) <= LONGEST_CHAIN


def test_the_longest_chain_is_the_longest():
    assert longest_chain({"a": {"b", "d"}, "b": {"c"}, "c": {"d"}, "d": set()}) == list("abcd")

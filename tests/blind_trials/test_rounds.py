"""Generation, run and scoring of a round with a trivial tool, and detection of manipulation."""

import json
import os
import sys
from pathlib import Path

import psutil
import pytest
from blind_trials import making, running, sealing
from blind_trials.commands import command
from blind_trials.running import command_of, run
from blind_trials.scoring import score
from blind_trials.sealing import open_round
from click.testing import CliRunner

from ahrsd.errors import AhrsdError

FAKE = """
import json, pathlib, sys
case, spec, out = sys.argv[1:]
assert json.loads(pathlib.Path(spec).read_text())["rate_hz"] == 25.0
if pathlib.Path(case).parent.name == "bad00000":
    sys.exit("cannot")
names = {"null0000": [], "step0000": ["hard_iron_step"]}[pathlib.Path(case).parent.name]
findings = [{"effect": n, "confidence": 1.0} for n in names]
pathlib.Path(out).write_text(json.dumps({"mismatch": bool(names), "findings": findings}))
"""


def case(name, kind, *effects):
    return {
        "id": name,
        "kind": kind,
        "noise_law": "white",
        "allowed": [],
        "motion": "wam",
        "duration_s": 400.0,
        "withheld": None,
        "oracle_gain_nats_per_sample": 0.0,
        "effects": [
            {
                "effect": e,
                "source": e,
                "right": [e],
                "parents": [],
                "multiple": 3.0,
                "snr": 20.0,
                "frame": "sensor",
                "frames": ["sensor"],
                "either_half": False,
                "parameters": [],
                "onset_s": None,
                "intervals_s": [],
            }
            for e in effects
        ],
    }


@pytest.fixture
def sealed(tmp_path):
    """(round, key's path, the fake tool's command) of three sealed cases."""
    folder, key_path = tmp_path / "round", tmp_path / "key.json"
    cases = [
        case("null0000", "null"),
        case("step0000", "single", "hard_iron_step"),
        case("bad00000", "single", "gyro_scale"),
    ]
    for entry in cases:
        (folder / entry["id"]).mkdir(parents=True)
        (folder / entry["id"] / "case.csv.gz").write_bytes(entry["id"].encode())
        (folder / entry["id"] / "spec.json").write_text('{"rate_hz": 25.0}')
    key = {"schema": "ahrsd.challenge.key/1", "ring": "full", "seed": 1, "cases": cases}
    key_path.write_text(json.dumps(key))
    fake = tmp_path / "fake.py"
    fake.write_text(FAKE)
    tool = f"{sys.executable} {fake} {{case}} {{spec}} {{json}}"
    return sealing.seal(folder, key_path), key_path, tool


def test_a_round_from_sealing_to_the_report(sealed, tmp_path):
    trial, key_path, tool = sealed
    seen = []
    digest = run(trial, tool, name="fake", jobs=2, done=lambda n, of: seen.append((n, of)))
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert trial.tools() == ["fake"]
    results = score(trial, key_path, tmp_path / "out")
    assert [(v.case, v.word) for v in results[0].verdicts] == [
        ("bad00000", "no answer"),
        ("null0000", "quiet"),
        ("step0000", "right"),
    ]
    written = json.loads((tmp_path / "out" / "score.json").read_text())
    assert written["answers_sha256"] == {"fake": digest}
    assert written["tools"][0]["mistakes"]["value"] == pytest.approx(1 / 3)
    page = (tmp_path / "out" / "report.html").read_text()
    text = (tmp_path / "out" / "report.md").read_text()
    for name in ("bad00000", "null0000", "step0000"):
        assert name in page and name in text
    assert page.index("bad00000") < page.index("null0000")
    # scoring again is no second chance, and no harm
    again = score(trial, key_path, tmp_path / "out")[0]
    assert again.verdicts[0].word == "no answer"


def test_a_stopped_run_goes_on(sealed):
    trial, _, tool = sealed
    kept = trial.answers("fake")
    kept.mkdir(parents=True)
    (kept / "bad00000.json").write_text('{"case": "bad00000", "answer": {"findings": []}}')
    run(trial, tool, name="fake")
    assert json.loads((kept / "bad00000.json").read_text())["answer"] == {"findings": []}
    assert json.loads((kept / "step0000.json").read_text())["exit"] == 0


@pytest.mark.slow
def test_a_tool_that_hangs_on_a_case_is_ended_and_has_no_answer_to_it(
    sealed, tmp_path, monkeypatch
):
    trial, _, _ = sealed
    slow = tmp_path / "slow.py"
    slow.write_text(f"""
import os, pathlib, sys, time
if "null0000" in sys.argv[1]:
    pathlib.Path({str(tmp_path / "process")!r}).write_text(str(os.getpid()))
    time.sleep(600)
pathlib.Path(sys.argv[2]).write_text('{{"mismatch": false}}')
""")
    monkeypatch.setattr(running, "TIMEOUT_S", 3.0)
    run(trial, f"{sys.executable} {slow} {{case}} {{json}}", name="slow", jobs=2)
    lost = json.loads((trial.answers("slow") / "null0000.json").read_text())
    assert (lost["exit"], lost["answer"], lost["failure"]) == (None, None, "stopped after 3 s")
    assert 3.0 <= lost["seconds"] < 60.0
    done = json.loads((trial.answers("slow") / "step0000.json").read_text())
    assert (done["exit"], done["failure"], done["answer"]) == (0, None, {"mismatch": False})
    process = int((tmp_path / "process").read_text())
    if psutil.pid_exists(process):  # it ends as soon as its parent has
        psutil.Process(process).wait(timeout=10)


def test_a_changed_case_a_changed_key_and_a_changed_answer_are_found(sealed, tmp_path):
    trial, key_path, tool = sealed
    run(trial, tool, name="fake")
    other = tmp_path / "other.json"
    key = json.loads(key_path.read_text())
    key["cases"][0]["kind"] = "single"
    other.write_text(json.dumps(key))
    with pytest.raises(AhrsdError, match="is not the key that was sealed"):
        score(trial, other, tmp_path)
    answer = trial.answers("fake") / "null0000.json"
    before = answer.read_text()
    answer.write_text(before.replace("null0000", "nil00000"))
    with pytest.raises(AhrsdError, match="changed after the answers were closed"):
        score(trial, key_path, tmp_path)
    answer.write_text(before)
    assert score(trial, key_path, tmp_path)[0].mistakes.cases == 3
    trial.case("null0000").write_bytes(b"another")
    with pytest.raises(AhrsdError, match="is not what was sealed"):
        open_round(trial.folder)


def test_no_answer_counts_once_the_key_was_opened(sealed, tmp_path):
    trial, key_path, tool = sealed
    run(trial, tool, name="fake")
    score(trial, key_path, tmp_path)
    with pytest.raises(AhrsdError, match="its key was opened on 20"):
        run(trial, tool, name="late")
    answer = trial.answers("fake") / "null0000.json"
    answer.write_text(answer.read_text() + "\n")
    sealing.close_answers(trial, "fake")  # closed anew, with a right hash of its own
    with pytest.raises(AhrsdError, match="not those that were closed when the key was opened"):
        score(trial, key_path, tmp_path)


def test_the_same_key_under_another_salt_has_another_hash(sealed):
    _, key_path, _ = sealed
    key = json.loads(key_path.read_text())
    assert len(key["salt"]) == 64
    assert sealing.key_sha256(key) != sealing.key_sha256(key | {"salt": "00" * 32})


@pytest.fixture
def without_pysindy(tmp_path, monkeypatch):
    """Processes that are started find no pysindy, as on a machine where it is not installed."""
    shadow = tmp_path / "shadow"
    shadow.mkdir()
    (shadow / "pysindy.py").write_text(
        "raise ModuleNotFoundError(\"No module named 'pysindy'\", name='pysindy')\n"
    )
    before = os.environ.get("PYTHONPATH")
    tree = Path(__file__).parents[2]  # that is tested
    paths = [str(shadow), str(tree), str(tree / "tests" / "tools"), *([before] if before else [])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))


def test_a_rival_without_its_package_is_refused_before_the_first_case(sealed, without_pysindy):
    trial, _, _ = sealed
    ran = CliRunner().invoke(command, ["run", str(trial.folder), "--tool", "stlsq"])
    assert isinstance(ran.exception, AhrsdError)
    assert ran.exception.exit_code == 2
    assert str(ran.exception) == (
        "--tool stlsq cannot run here: stlsq needs pysindy; "
        "install it in the checkout: pip install -e '.[trials]'"
    )
    assert not (trial.folder / "answers").exists()


def test_a_program_that_is_not_there_is_refused_before_the_first_case(sealed):
    trial, _, _ = sealed
    with pytest.raises(AhrsdError, match=r"no program mytool-of-nobody here; install it"):
        run(trial, "mytool-of-nobody {case} {json}")
    assert not (trial.folder / "answers").exists()


def test_a_tool_that_lacks_a_package_is_stopped_and_its_answers_are_not_closed(sealed, tmp_path):
    trial, _, _ = sealed
    lacking = tmp_path / "lacking.py"
    lacking.write_text("import a_package_of_nobody")
    with pytest.raises(AhrsdError, match=r"mine cannot run here: ModuleNotFoundError: No module"):
        run(trial, f"{sys.executable} {lacking} {{case}} {{json}}", name="mine")
    assert trial.tools() == []
    assert list(trial.answers("mine").iterdir()) == []


def test_tool_without_any_answer_is_not_scored(sealed, tmp_path):
    """No list of words: a module that is not there, a library, a licence, a crash on every case."""
    trial, key_path, _ = sealed
    silent = tmp_path / "silent.py"
    silent.write_text("import sys; sys.exit('licence expired')")
    tool = f"{sys.executable} {silent} {{case}} {{json}}"
    with pytest.raises(AhrsdError, match=r"^mine cannot run here: licence expired; no answers"):
        run(trial, tool, name="mine")
    assert trial.tools() == []
    working = f"{sys.executable} {tmp_path / 'fake.py'} {{case}} {{spec}} {{json}}"
    run(trial, working, name="mine")  # what failed is asked again
    records = {
        case: sealing.read_object(trial.answers("mine") / f"{case}.json") for case in trial.cases
    }
    assert {case for case, record in records.items() if record["answer"]} == {
        "null0000",
        "step0000",
    }
    folder = trial.answers("older")
    folder.mkdir()
    for case in trial.cases:  # as earlier versions closed them
        record = {"case": case, "exit": 1, "failure": "licence expired", "answer": None}
        sealing.write_object(folder / f"{case}.json", record)
    sealing.close_answers(trial, "older")
    assert [one.tool for one in score(trial, key_path, tmp_path / "out")] == ["mine"]
    written = json.loads((tmp_path / "out" / "score.json").read_text())
    why = "it could not run on 3 of 3 cases: licence expired"
    assert written["not_scored"] == {"older": why}


def test_tool_that_fails_ten_cases_is_stopped(tmp_path):
    folder, key_path, asked = tmp_path / "round", tmp_path / "key.json", tmp_path / "asked"
    cases = [case(f"null{k:04}", "null") for k in range(25)]
    for entry in cases:
        (folder / entry["id"]).mkdir(parents=True)
        (folder / entry["id"] / "case.csv.gz").write_bytes(entry["id"].encode())
        (folder / entry["id"] / "spec.json").write_text("{}")
    key = {"schema": "ahrsd.challenge.key/1", "ring": "full", "seed": 1, "cases": cases}
    key_path.write_text(json.dumps(key))
    silent = tmp_path / "silent.py"
    silent.write_text(f"open({str(asked)!r}, 'a').write('x'); raise SystemExit('segmentation')")
    trial = sealing.seal(folder, key_path)
    with pytest.raises(AhrsdError, match="silent cannot run here: segmentation"):
        run(trial, f"{sys.executable} {silent} {{case}} {{json}}", name="silent")
    assert 10 <= len(asked.read_text()) <= 12


def test_answers_of_a_tool_that_could_not_run_are_never_scored(sealed, tmp_path):
    """As earlier versions left them: closed, every case with what the rival lacks."""
    trial, key_path, tool = sealed
    run(trial, tool, name="fake")
    folder = trial.answers("stlsq")
    folder.mkdir()
    lacks = "stlsq needs pysindy; install it in the checkout: pip install -e '.[trials]'"
    for name in trial.cases:
        sealing.write_object(
            folder / f"{name}.json", {"case": name, "exit": 2, "failure": lacks, "answer": None}
        )
    sealing.close_answers(trial, "stlsq")
    asked = ["score", str(trial.folder), "--key", str(key_path), "-o", str(tmp_path / "out")]
    scored = CliRunner().invoke(command, asked)
    assert scored.exit_code == 1, scored.output  # fake missed a wanted score
    assert f"stlsq: not scored: it could not run on 3 of 3 cases: {lacks}\n" in scored.stderr
    assert "stlsq" not in scored.stdout
    written = json.loads((tmp_path / "out" / "score.json").read_text())
    assert [one["tool"] for one in written["tools"]] == ["fake"]
    assert written["not_scored"] == {"stlsq": f"it could not run on 3 of 3 cases: {lacks}"}
    assert "stlsq is not scored" in (tmp_path / "out" / "report.md").read_text()


def test_round_without_a_working_tool_is_not_scored(sealed, tmp_path):
    trial, key_path, _ = sealed
    folder = trial.answers("stlsq")
    folder.mkdir(parents=True)
    for name in trial.cases:
        record = {"case": name, "exit": 127, "failure": "No such file", "answer": None}
        sealing.write_object(folder / f"{name}.json", record)
    sealing.close_answers(trial, "stlsq")
    with pytest.raises(AhrsdError, match="stlsq: not scored"):
        score(trial, key_path, tmp_path)
    assert trial.opened is None  # the key was not read: the tool may be run again
    run(trial, f"{sys.executable} {tmp_path / 'fake.py'} {{case}} {{spec}} {{json}}", name="stlsq")
    assert score(trial, key_path, tmp_path)[0].tool == "stlsq"


@pytest.mark.parametrize("tool", ["gradient-boosting", "mytool {case}"])
def test_an_unknown_tool_is_one_line(tool):
    with pytest.raises(AhrsdError, match=r"no tool .*ahrsd, stlsq, lasso-bic, ruptures"):
        command_of(tool)


def test_a_key_among_the_cases_and_a_folder_in_use_are_refused(tmp_path):
    with pytest.raises(AhrsdError, match="lies among the cases"):
        making.make(tmp_path / "r", tmp_path / "r" / "key.json", "nulls", 1)
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "x").touch()
    with pytest.raises(AhrsdError, match="is not empty"):
        making.make(tmp_path / "r", tmp_path / "key.json", "nulls", 1)


@pytest.mark.slow
def test_the_command_makes_runs_and_scores(tmp_path):
    """End to end with the real generator and a tool that finds nothing."""
    folder, key_path = tmp_path / "nulls", tmp_path / "keys" / "key.json"
    made = CliRunner().invoke(
        command,
        ["make", "--cases", "1", "--ring", "nulls", "-o", str(folder), "--key", str(key_path)],
    )
    assert made.exit_code == 0, made.output
    assert open_round(folder).sha256 in made.output
    quiet = tmp_path / "quiet.py"
    quiet.write_text("import sys; open(sys.argv[2], 'w').write('{\"mismatch\": false}')")
    ran = CliRunner().invoke(
        command,
        [
            "run",
            str(folder),
            "--tool",
            f"{sys.executable} {quiet} {{case}} {{json}}",
            "--name",
            "q",
        ],
    )
    assert ran.exit_code == 0, ran.output
    scored = CliRunner().invoke(command, ["score", str(folder), "--key", str(key_path)])
    assert scored.exit_code == 0, scored.output
    assert "q: 0.0% mistakes in 1 case\n" in scored.output
    assert Path(folder / "report.html").is_file()


def test_the_rings_are_the_generators():
    from blind_trials.commands import _RINGS
    from blind_trials.world.rings import RINGS

    assert tuple(RINGS) == _RINGS[:-1]

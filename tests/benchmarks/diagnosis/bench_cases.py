"""The diagnosis of recordings: real with known truth, real untouched, blind.  One table.

    python tests/benchmarks/diagnosis/bench_cases.py --kept ANSWERS.json [--only PART ...]
        [--seed N --cases RING=N ...] [--world NAME] [--again] [--listed]

A case is answered once and kept in the file; `--again` answers those anew that `--only` leaves.
The blind cases are drawn anew from the seed and judged as `ahrsd challenge score` does.

known:     what was put on or flows is named, at its time; a delay of the magnetometer beside it,
           and an unknown where something stands in the room, are no mistakes
untouched: nothing named but a delay, and no unknown
blind:     `nulls`, `singles`, `pairs`, `withheld`, `outside` of the generator of sealed trials
worlds:    `--world workboat` or `road_and_air`: `null`, `single`, `pair`, `withheld`, `outside` of
           generators by other authors (tests/tools/generators)
CPU is that of the diagnosis in one process, without the start of Python.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_remainder_priors import RECORDINGS, untouched
from blind_trials.answers import read_answer
from blind_trials.judge import ORDER, judge
from blind_trials.making import make
from blind_trials.sealing import read_object
from generators.truths import KINDS, WORLDS, made

from ahrsd.diagnosis.inference.diagnose import diagnose_logged
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.offline.diagnose import load_spec, load_track

Json = dict[str, Any]

DELAYS = frozenset({"mag_time_lag", "mag_low_pass", "gyro_time_lag", "gyro_integration"})
CURRENT = ("motor_current_a", "throttle", "battery_v")
#: verdicts that are no mistakes
FINE = ("right", "quiet")
#: how near in time a step must be, s: a hand takes one to three
NEAR_S = 4.0


@dataclass(frozen=True)
class Known:
    """What is known of a real recording.

    onsets_s:  of steps of the hard iron;  names: of what else is there;  hidden: columns withheld
    unknown: None where it is no mistake either way
    """

    file: str
    onsets_s: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()
    unknown: bool | None = None


#: times: where the field's magnitude, its median over a second, goes over;  currents: by the other
#: compass, and on MAG by the field's magnitude (bench_known_values.py)
KNOWN = {
    "MAG2, current shown": Known("arducopter/log171_MAG2_10hz", (), ("motor_current_field",)),
    "MAG2, current hidden": Known("arducopter/log171_MAG2_10hz", (), (), CURRENT, unknown=True),
    "MAG": Known("arducopter/log171_MAG_10hz", (), ("motor_current_field",)),
    "BROAD 32, magnet at 1 cm": Known("broad/32_disturbed_attached_magnet_1cm", (38.0, 95.0)),
    "BROAD 33, magnet at 2 cm": Known("broad/33_disturbed_attached_magnet_2cm", (42.0, 99.0)),
    "BROAD 34, magnet at 3 cm": Known("broad/34_disturbed_attached_magnet_3cm", (45.0, 99.7)),
    "BROAD 36, magnet at 5 cm": Known("broad/36_disturbed_attached_magnet_5cm", (37.0, 98.7)),
}


@dataclass(frozen=True)
class Case:
    """One recording to be answered, and what is known of it: one of known, truth, or neither."""

    part: str
    name: str
    track: Track
    spec: Spec
    known: Known | None = None
    truth: Json | None = None


def real_cases(words: Sequence[str]) -> Iterator[Case]:
    for name, one in KNOWN.items():
        if not any(word in f"known: {name}" for word in words):
            continue
        track, _ = load_track(RECORDINGS / f"{one.file}.csv.gz")
        kept = {k: v for k, v in track.covariates.items() if k not in one.hidden}
        yield Case("known", name, replace(track, covariates=kept), Spec(), one)
    for name, path in untouched([""]):
        known = any(one.file == name for one in KNOWN.values())
        if not known and any(word in f"untouched: {name}" for word in words):
            yield Case("untouched", name, load_track(path)[0], Spec())


def blind_cases(seed: int, drawn: Sequence[str]) -> Iterator[Case]:
    for ring, count in (one.split("=") for one in drawn):
        with tempfile.TemporaryDirectory() as scratch:
            folder, key = Path(scratch) / "cases", Path(scratch) / "key.json"
            trial = make(folder, key, ring, int(count), seed=seed)
            for truth in read_object(key)["cases"]:
                name = str(truth["id"])
                spec, _ = load_spec(trial.spec(name))
                track, _ = load_track(trial.case(name), spec=spec)
                planted = " ".join(
                    f"{one['effect']} x{one['multiple']:.1f}" for one in truth["effects"]
                )
                said = f"{seed} {ring} {name[:6]} {planted or truth['noise'].get('law', '')}"
                yield Case(ring, said, track, spec, truth=truth)


def world_cases(world: str, seed: int, drawn: Sequence[str]) -> Iterator[Case]:
    counts = {kind: int(count) for kind, count in (one.split("=") for one in drawn)}
    if unheard := set(counts) - set(KINDS):
        sys.exit(f"{world} has no {', '.join(unheard)}; it has {', '.join(KINDS)}")
    with tempfile.TemporaryDirectory() as scratch:
        for one in made(world, Path(scratch), seed, counts):
            spec = Spec() if one.spec is None else load_spec(one.spec)[0]
            track, _ = load_track(one.table, spec=spec)
            planted = " ".join(f"{e['effect']} {e['multiple']:.0f}" for e in one.truth["effects"])
            kind = one.truth["kind"]
            said = f"{seed} {kind} {one.truth['id']} {planted or one.truth['noise']['law']}"
            yield Case(f"{world} {kind}", said, track, spec, truth=one.truth)


def answered(case: Case) -> Json:
    """What is said of a case, and its seconds of CPU."""
    begin = time.process_time()
    try:
        found = diagnose_logged(case.track, case.spec, recording=case.name)
        answer, failure = found.to_json(), None
    except ValueError as why:
        answer, failure = None, str(why)
    spent = time.process_time() - begin
    kept = ("mismatch", "findings", "unexplained", "posterior_predictive")
    short = None if answer is None else {key: answer[key] for key in kept}
    return {"answer": short, "failure": failure, "cpu_seconds": spent, "said": ""}


def verdict(case: Case, record: Json) -> tuple[str, str]:
    """One word, and what was said."""
    answer = read_answer(record)
    said = [_short(one) for one in _findings(record)]
    said += [f"unknown in {answer.unexplained_frame}"] * answer.unexplained
    words = ", ".join(said) or (answer.failure or "nothing")
    if case.truth is not None:
        return judge(case.truth, answer).word, words
    known = case.known or Known("", unknown=False)
    steps = [at for one in _findings(record) for at in _moments(one)]
    dated = [any(abs(at - t) < NEAR_S for at in steps) for t in known.onsets_s]
    there = [name in answer.names for name in known.names]
    own = {*DELAYS, *known.names, *(["hard_iron_step"] if known.onsets_s else [])}
    more = [name for name in answer.names if name not in own]
    more += ["hard_iron_step"] * max(0, len(steps) - len(known.onsets_s)) * bool(known.onsets_s)
    wrong = known.unknown is not None and answer.unexplained != known.unknown
    if answer.failure or more:
        return ("no answer" if answer.failure else "false name"), words
    if not all([*dated, *there]):
        return "missed", words
    return (("unknown" if answer.unexplained else "missed") if wrong else "right"), words


def _findings(record: Json) -> list[Json]:
    found: list[Json] = (record["answer"] or {}).get("findings", [])
    return found


def _moments(finding: Json) -> list[float]:
    """When the hard iron steps, s: a magnet that is put on and taken off may be one finding."""
    setting = finding.get("setting") or {}
    told = [setting.get(name) for name in ("onset_s", "end_s")]
    return [float(at) for at in told if at is not None and finding["effect"] == "hard_iron_step"]


def _short(finding: Json) -> str:
    setting = finding.get("setting") or {}
    onset, end = (setting.get(name) for name in ("onset_s", "end_s"))
    until = "" if end is None else f" to {end:.0f} s"
    at = "" if onset is None else f" at {onset:.0f} s{until}"
    return f"{finding['effect']}{at} ({finding.get('evidence_nats') or 0.0:.0f})"


def table(cases: Sequence[tuple[Case, Json]], *, listed: bool) -> None:
    """Verdicts counted by part; each case that is not right, or all."""
    counted: dict[str, Counter[str]] = defaultdict(Counter)
    spent: dict[str, list[float]] = defaultdict(list)
    for case, record in cases:
        word, said = verdict(case, record)
        counted[case.part][word] += 1
        spent[case.part].append(record["cpu_seconds"])
        if listed or word not in FINE:
            print(f"{case.part}: {case.name}")
            print(f"    {word:10s} {said}")
    print()
    print("| cases | verdicts | CPU s: median, 95 % |")
    print("|---|---|---|")
    order = [*FINE, *(word for word in reversed(ORDER) if word not in FINE)]
    for part, words in counted.items():
        told = sorted(words.items(), key=lambda item: order.index(item[0]))
        verdicts = ", ".join(f"{count} {word}" for word, count in told)
        cpu = np.quantile(spent[part], [0.5, 0.95])
        print(f"| {part} | {verdicts} | {cpu[0]:.1f}, {cpu[1]:.1f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kept", type=Path, required=True, help="answers, kept from run to run")
    parser.add_argument("--only", nargs="*", default=[""], help="parts of 'PART: NAME'")
    parser.add_argument("--seed", type=int, default=1, help="of the blind cases")
    parser.add_argument("--cases", nargs="*", default=[], help="blind cases, as singles=22")
    parser.add_argument("--world", choices=sorted(WORLDS), help="whose cases; else the trials' own")
    parser.add_argument("--again", action="store_true", help="answer what is kept once more")
    parser.add_argument("--listed", action="store_true", help="list every case")
    given = parser.parse_args()
    known: dict[str, Json] = json.loads(given.kept.read_text()) if given.kept.exists() else {}
    done = []
    drawn = (
        blind_cases(given.seed, given.cases)
        if given.world is None
        else world_cases(given.world, given.seed, given.cases)
    )
    cases = itertools.chain(real_cases(given.only), drawn)
    for case in cases:
        title = f"{case.part}: {case.name}"
        if not any(word in title for word in given.only):
            continue
        if given.again or title not in known:
            known[title] = answered(case)
            given.kept.write_text(json.dumps(known) + "\n", encoding="utf-8")
            word, said = verdict(case, known[title])
            print(f"{title}: {word}: {said} ({known[title]['cpu_seconds']:.1f} s)", flush=True)
        done.append((case, known[title]))
    table(done, listed=given.listed)


if __name__ == "__main__":
    main()
